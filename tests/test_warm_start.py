"""A warm process is what a cold one is: words, streams, descriptors, environment, folder, parent, exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests import warm_start

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere all start cold")
LOOK = """
import json, os, sys
import __main__
told = os.read(int(sys.argv[1]), 9).decode()
print("said", file=sys.stderr)
print(json.dumps({
    "argv": sys.argv, "path": sys.path[0], "folder": os.getcwd(), "token": os.environ.get("GSVIS_TOKEN"),
    "leads": os.getsid(0) == os.getpid(), "parent": os.getppid(), "told": told, "typed": sys.stdin.read(),
    "main": __main__.__dict__ is globals(), "open": sorted(map(int, os.listdir("/proc/self/fd")))[:-1],
    "streams": [sys.stdin.encoding, sys.stdout.encoding, sys.stderr.errors, sys.stdout.line_buffering],
}))
"""


def look(start: type[subprocess.Popen[Any]], folder: Path) -> tuple[int, dict[str, Any], str]:
    """What a process sees, started in one of two ways."""
    reading, writing = os.pipe()
    os.write(writing, b"from afar")
    process = start(
        [sys.executable, "-c", LOOK, str(reading), "a word"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        pass_fds=(reading,), start_new_session=True, cwd=folder, env={**os.environ, "GSVIS_TOKEN": "secret"},
    )  # fmt: skip
    out, err = process.communicate("typed")
    for end in (reading, writing):
        os.close(end)
    return process.returncode, json.loads(out), err


def test_it_sees_what_a_cold_one_sees(tmp_path: Path) -> None:
    warm = look(warm_start.Popen, tmp_path)
    assert warm == look(subprocess.Popen, tmp_path)
    assert (warm[1]["parent"], warm[1]["told"]) == (os.getpid(), "from afar")


@pytest.mark.parametrize(
    ("program", "code"), [("", 0), ("import sys; sys.exit(3)", 3), ("raise ValueError('wrong')", 1)]
)
def test_it_ends_as_a_cold_one_ends(program: str, code: int) -> None:
    done = warm_start.run([sys.executable, "-c", f"import gsvis.cli\n{program}"], capture_output=True, text=True)
    assert (done.returncode, "ValueError: wrong\n" in done.stderr) == (code, code == 1)


def test_it_is_killed() -> None:
    with warm_start.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as process:
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL


def test_it_has_imported_commands_and_others_have_not() -> None:
    command = [sys.executable, "-c", "import sys; print('gsvis.cli.serve' in sys.modules)"]
    same = dict(warm_start._BEGAN)  # that of this worker may have changed since
    others = {**same, "GSVIS_CACHE": "elsewhere"}
    found = [warm_start.run(command, stdout=subprocess.PIPE, text=True, env=each).stdout for each in (same, others)]
    assert found == ["True\n", "False\n"]
