"""A name of a file may hold any bytes: no command fails for it, and no control byte reaches a terminal or a page."""

from __future__ import annotations

import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsvis.cli import main
from tests import warm_start
from tests.cli.every_command import COMMANDS, at_their_smallest, make_world, words_of

pytestmark = [
    pytest.mark.usefixtures("blank_plots"),
    pytest.mark.skipif(sys.platform != "linux", reason="file systems elsewhere take UTF-8 alone"),
]
NAME = os.fsdecode(b"caf\xe9 \x1b]0;owned\x07\x1b[2J\x9b31m\r\n\t" + "\x9b\u202e [b]:car:#100%?&<i>'\"日".encode())
READING = {
    "inspect": "inspect {ply}",
    "inspect package": "inspect {package}",
    "verify": "verify {package}",
    "export html": "export {ply} -o {out}/a.html --format html",
    "export streamed-sog": "export {ply} -o {out}/sog --format streamed-sog",
    "export 3dtiles": "export {ply} -o {out}/tiles --format 3dtiles",
    "export glb": "export {ply} -o {out}/a.glb --format glb",
    "a page": "convert {ply} {out}/a.html",
}
EVERY = COMMANDS | READING
TEXT = (".html", ".json", ".csv", ".txt", ".md", ".svg", ".js")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("world") / NAME
    photos = tmp_path_factory.mktemp("photos") / NAME
    folder.mkdir()
    photos.mkdir()
    return make_world(folder, photos, NAME)


@pytest.fixture(scope="module", autouse=True)
def _smallest(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with at_their_smallest(tmp_path_factory.mktemp("viewer")):
        yield


def unreadable(text: str) -> str:
    """What a terminal obeys, what no UTF-8 holds, and what turns the direction of text."""
    return "".join(re.findall("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]", text))


@pytest.mark.parametrize("name", EVERY)
def test_every_command_takes_any_name(
    name: str,
    world: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out, temporary = tmp_path / NAME, tmp_path / "temporary"
    for folder in (out, temporary):
        folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    places = {**world, "out": out}
    assert main(words_of(EVERY[name], **places)) == 0, capsys.readouterr().err
    assert unreadable("".join(capsys.readouterr())) == ""
    for path in out.rglob("*"):
        is_journal = any(part.endswith(".work") for part in path.parts)
        if path.suffix in TEXT and path.is_file() and not is_journal:
            assert unreadable(path.read_bytes().decode("utf-8")) == "", path
    assert list(temporary.iterdir()) == []


def test_json_names_the_file_exactly(world: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(world["package"]), "--json"]) == 0
    text = capsys.readouterr().out
    assert unreadable(text) == ""
    assert json.loads(text)["package"] == str(world["package"])


@pytest.mark.parametrize("command", ["inspect", "verify", "render", "serve", "view", "prepare"])
def test_errors_quote_names_on_one_line(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["-o", str(tmp_path / "out")] if command in ("render", "prepare") else []
    assert main([command, str(tmp_path / NAME), *out]) == 2
    printed, err = capsys.readouterr()
    assert printed == ""
    assert err.count("\n") == 1
    assert unreadable(err) == ""
    assert "\\udce9" in err
    assert "\\x1b" in err


def test_a_terminal_gets_colors_and_nothing_from_names(world: dict[str, Path], tmp_path: Path) -> None:
    """Progress bars move the cursor and tables have colors, so the terminal itself obeys escapes."""
    ours, theirs = os.openpty()
    command = [sys.executable, "-m", "gsvis", "convert", str(world["ply"]), str(tmp_path / f"{NAME}.spz")]
    with warm_start.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env={**os.environ, "TERM": "xterm"}
    ) as p:
        os.close(theirs)
        printed = b""
        while piece := read_from(ours):
            printed += piece
    assert p.returncode == 0
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", printed.decode("utf-8"))
    assert unreadable(text.replace("\r", "")) == ""
    assert "\x1b[31m" not in printed.decode()
    assert "\\udce9" in text.replace("\r\n", "")


def read_from(terminal: int) -> bytes:
    """What was printed; nothing after the end, which Linux reports as an error."""
    try:
        return os.read(terminal, 1 << 16)
    except OSError:
        return b""
