"""`gsvis view` as a process: a scene as it is from files, a package as a stream, and one that changes over."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gsvis.cli import main
from tests.serve.servers import PATIENCE, has_all, patient
from tests.stream.worlds import package_of

PLAIN = {key: value for key, value in os.environ.items() if key != "GSVIS_TOKEN"} | {"PYTHONWARNINGS": "error"}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewed") / "room.gsvis"
    package_of(folder, 3000, stores=False).close()
    return folder


@contextmanager
def viewing(*arguments: object, **environment: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    """A running command and the document that it prints."""
    command = [sys.executable, "-m", "gsvis.cli", "view", *map(str, arguments), "--port", "0", "--json"]
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=PLAIN | environment
    )
    try:
        assert running.stdout is not None
        text = ""
        while not text.endswith("}\n"):
            line = running.stdout.readline()
            assert line, running.stderr.read() if running.stderr else ""
            text += line
        yield running, json.loads(text)
    finally:
        running.kill()
        running.communicate()


def fetched(url: str) -> bytes:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=PATIENCE) as answer:
        return bytes(answer.read())


def test_a_package_is_streamed(package: Path) -> None:
    with viewing(package, "--no-browser") as (running, found):
        assert (found["scene"], found["url"].endswith("/view/room")) == ("room", True)
        client, _ = patient(found["stream"], package)
        assert has_all(client.receiver, package)
        running.send_signal(signal.SIGTERM)
        _, said = running.communicate(timeout=PATIENCE)
    assert (running.returncode, said) == (0, "")


def test_a_scene_is_shown_as_it_is_and_leaves_nothing(tmp_path: Path) -> None:
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    with viewing("builtin:two_rooms", "--no-browser", TMPDIR=str(temporary)) as (running, found):
        root = found["url"].partition("/view/")[0] + "/"
        (row,) = json.loads(fetched(root))["scenes"]
        assert (row["name"], row["stream"], row["static"]) == ("two_rooms", None, "scenes/two_rooms/scene.json")
        about = json.loads(fetched(root + row["static"]))
        assert (about["format"], about["gaussians"]) == ("gsvis-static", row["gaussians"])
        for file in about["files"].values():
            assert len(fetched(f"{root}scenes/two_rooms/{file['name']}")) == file["bytes"]
        running.send_signal(signal.SIGINT)
        running.communicate(timeout=PATIENCE)
    assert running.returncode == 0
    assert list(temporary.iterdir()) == []


def test_the_browser_gets_the_token_and_nobody_else(package: Path, tmp_path: Path) -> None:
    note = tmp_path / "opened"
    browser = f"{sys.executable} -c \"import sys; open({str(note)!r}, 'w').write(sys.argv[1])\" %s"
    with viewing(package, GSVIS_TOKEN="s3cret word", BROWSER=browser) as (running, found):
        while not (note.exists() and note.read_text()):
            assert running.poll() is None
        assert note.read_text() == found["url"] + "?token=s3cret%20word"
        running.send_signal(signal.SIGTERM)
        _, said = running.communicate(timeout=PATIENCE)
    assert "s3cret" not in json.dumps(found) + said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("none.ply",), "no such file"),
        (("builtin:two_roms",), "builtin:two_rooms"),
        (("PACKAGE", "--lod", "0"), "--lod: expected none for a package"),
        (("PACKAGE", "--prepare", "x.gsvis"), "--prepare: expected none for a package"),
        (("builtin:two_rooms", "--up", "z"), "--up: expected one of"),
    ],
)
def test_what_cannot_be_shown_says_why(
    package: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], said: str
) -> None:
    words = [str(package) if word == "PACKAGE" else word for word in arguments]
    assert main(["view", *words, "--no-browser"]) == 2
    assert said in capsys.readouterr().err
