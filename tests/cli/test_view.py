"""`gsvis view`: a scene as it is from files, a large one in part at first, a package as a stream, and changes over."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsvis.cli import main, view
from gsvis.cli.arguments import Prepare, View
from gsvis.cli.options import PLACING, Reading, Shown, leaves
from gsvis.export import write_static
from gsvis.io import sources
from gsvis.io.ply import save_ply
from gsvis.scene.procedural import two_rooms
from gsvis.serve.scenes import Scenes, open_scene
from tests import warm_start
from tests.serve.servers import PATIENCE, has_all, patient, until
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
    command = [sys.executable, "-m", "gsvis", "view", *map(str, arguments), "--port", "0", "--json"]
    running = warm_start.Popen(
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
        assert found["remarks"] == []
        root = found["url"].partition("/view/")[0] + "/"
        (row,) = json.loads(fetched(root))["scenes"]
        assert (row["name"], row["stream"], row["static"]) == ("two_rooms", None, "scenes/two_rooms/scene.json")
        about = json.loads(fetched(root + row["static"]))
        assert (about["format"], about["gaussians"]) == ("gsvis-static", row["gaussians"])
        for kind, file in about["files"].items():
            alone = file["name"].endswith(".bin")
            names = [file["name"]] if alone else [f"{file['name']}-{k}.bin" for k in range(file["count"])]
            nbytes = sum(len(fetched(f"{root}scenes/two_rooms/{name}")) for name in names)
            assert nbytes > 0 if kind == "walk" else nbytes == file["bytes"]  # walking is found meanwhile
        running.send_signal(signal.SIGINT)
        running.communicate(timeout=PATIENCE)
    assert running.returncode == 0
    assert list(temporary.iterdir()) == []


def test_the_browser_gets_the_token_and_nobody_else(package: Path, tmp_path: Path) -> None:
    note = tmp_path / "opened"
    browser = f"{sys.executable} -c \"import sys; open({str(note)!r}, 'w').write(sys.argv[1])\" %s"
    with viewing(package, GSVIS_TOKEN="s3cret word", BROWSER=browser) as (running, found):
        until(lambda: running.poll() is not None or (note.exists() and note.read_text() != ""))
        assert note.read_text() == found["url"] + "?token=s3cret%20word"
        running.send_signal(signal.SIGTERM)
        _, said = running.communicate(timeout=PATIENCE)
    assert "s3cret" not in json.dumps(found) + said


CHILD = """
import pathlib, shutil, sys, time
while not pathlib.Path("go").exists():
    time.sleep(0.01)
if sys.argv[1] == "fails":
    sys.exit("no room")
shutil.copytree(sys.argv[1], "made.gsvis")
"""


@pytest.fixture
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scenes]:
    """A static scene; the work folder is a new one."""
    monkeypatch.chdir(tmp_path)
    write_static("shown", two_rooms(1000).gaussians)
    with Scenes([open_scene("shown", "room")]) as found:
        yield found


def preparing(monkeypatch: pytest.MonkeyPatch, scenes: Scenes, package: object) -> AbstractContextManager[None]:
    """Prepare by a stand-in that waits for the file `go`, and then copies a package."""
    start = subprocess.Popen

    def stand_in(words: list[str], **options: Any) -> subprocess.Popen[bytes]:
        assert words[1:] == ["-m", "gsvis", "prepare", "shown", "-o", "made.gsvis"]
        return start([sys.executable, "-c", CHILD, str(package)], **options)

    monkeypatch.setattr(view.subprocess, "Popen", stand_in)
    return view._preparing(View("shown", prepare="made.gsvis"), scenes, "room")


def test_a_prepared_package_takes_the_place_of_its_scene(
    package: Path, scenes: Scenes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with preparing(monkeypatch, scenes, package):
        assert (scenes["room"].preparing, scenes["room"].opened) == (True, None)
        Path("go").touch()
        until(lambda: scenes["room"].opened is not None)
        assert (scenes["room"].preparing, scenes["room"].site) == (False, None)


def test_a_scene_is_prepared_as_it_is_shown(monkeypatch: pytest.MonkeyPatch, scenes: Scenes) -> None:
    """Options that say how the scene is read hold for both."""
    started = list[list[str]]()

    def stand_in(words: list[str], **options: Any) -> subprocess.Popen[bytes]:
        started.append(words[3:])
        return subprocess.Popen([sys.executable, "-c", ""])

    seen = Shown(cameras="c.json", cameras_frame="scene", kind="rooms", up=" -y", around=(1.0, -2.0, 0.5, 3.0))
    start = View("shown", prepare="made.gsvis", lod=1, where=seen, output=Reading(drop_invalid=True))
    with monkeypatch.context() as patch:
        patch.setattr(view, "subprocess", SimpleNamespace(Popen=stand_in, DEVNULL=subprocess.DEVNULL))
        with view._preparing(start, scenes, "room"):
            pass
    assert started[0][:6] == ["prepare", "shown", "-o", "made.gsvis", "--lod", "1"]
    expected = "--lod 1 --up -y --around 1 -2 0.5 3 --cameras c.json --cameras-frame scene --kind rooms --drop-invalid"
    assert sorted(started[0][4:]) == sorted(expected.split())
    shared = {leaf.name for leaf in leaves(View)} & {leaf.name for leaf in leaves(Prepare)}
    own = {"scene", "show", "json", "debug"}
    assert shared - own == {"lod", *PLACING, "drop_invalid"} - own


def test_a_scene_that_cannot_be_prepared_stays(
    scenes: Scenes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with preparing(monkeypatch, scenes, "fails"):
        Path("go").touch()
        until(lambda: not scenes["room"].preparing)
        assert scenes["room"].site is not None
    assert "was not prepared" in capsys.readouterr().err


def test_preparation_ends_with_the_server_and_says_nothing(
    scenes: Scenes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with preparing(monkeypatch, scenes, "fails"):
        pass
    assert scenes["room"].site is not None
    assert capsys.readouterr().err == ""


@pytest.fixture
def large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with more Gaussians than are shown at once."""
    monkeypatch.setattr(view, "_LARGE", 900)
    monkeypatch.setattr(sources, "SOME", 100)
    path = tmp_path / "hall.ply"
    save_ply(two_rooms(1000).gaussians[:1000], path)
    return path


def opened_as(command: View, stack: ExitStack) -> view._Opened:
    """Return what a command serves."""
    return view._open(command, view._read_sample(command), stack)


def test_a_large_file_is_shown_in_part_until_the_whole_is_there(large: Path) -> None:
    with ExitStack() as stack:
        opened = opened_as(View(str(large)), stack)
        assert opened.in_part
        assert "of 1,000 Gaussians; all of them follow" in opened.remarks[-1]
        sample = opened.serve()
        assert (sample.preparing, sample.gaussians) == (True, opened.in_part)
        assert 50 < opened.in_part < 150
        with Scenes([sample]) as scenes:
            assert opened.later is not None
            opened.later(scenes)
            assert sample.gaussians == opened.in_part
            whole = scenes["hall"]
            assert (whole.gaussians, whole.preparing) == (1000, False)
            starts = [json.loads((each.path / "scene.json").read_text())["poses"] for each in (sample, whole)]
            assert starts[0] == starts[1]


def test_a_large_file_that_is_damaged_further_on_stays_in_part(large: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = bytearray(large.read_bytes())
    start = data.index(b"end_header\n") + 11
    second = start + (len(data) - start) // 1000  # a row that the sample leaves out
    data[second : second + 4] = np.float32(np.nan).tobytes()
    large.write_bytes(data)
    with ExitStack() as stack:
        opened = opened_as(View(str(large)), stack)
        sample = opened.serve()
        with Scenes([sample]) as scenes:
            assert opened.later is not None
            opened.later(scenes)
            assert scenes["hall"] is sample
            assert sample.gaussians == opened.in_part
            assert not sample.preparing
    assert "is shown in part" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda data: data[: len(data) * 2 // 3], "truncated"),
        (lambda data: data[:40], "end_header"),
        (lambda data: data[:-4] + np.float32(np.nan).tobytes(), "finite"),
    ],
)
def test_a_large_file_that_is_damaged_where_it_is_sampled_ends_in_one_line(
    large: Path, spoil: Callable[[bytes], bytes], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    large.write_bytes(spoil(large.read_bytes()))
    assert main(["view", str(large), "--no-browser", "--json", "--port", "0"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert said in printed.err
    assert len(printed.err.strip().splitlines()) == 1


def test_a_sample_that_cannot_be_written_ends_the_command_in_one_line(
    large: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "scene.json")

    monkeypatch.setattr("gsvis.export.static.write_static", fail)
    assert main(["view", str(large), "--no-browser", "--json", "--port", "0"]) == 2
    said = capsys.readouterr()
    assert json.loads(said.out)["scene"] == "hall"
    assert "scene.json: no space left" in said.err
    assert len(said.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("copies_0.6M.ply", "copies_0.6M"),
        ("biker.compressed.ply", "biker"),
        ("old.splat.gz", "old"),
        ("v1.2.spz", "v1.2"),
        ("plain", "plain"),
    ],
)
def test_a_title_is_the_name_of_the_file_without_its_ending(tmp_path: Path, name: str, title: str) -> None:
    (tmp_path / name).touch()
    assert sources.title_of(str(tmp_path / name)) == title


def test_a_large_file_that_is_prepared_meanwhile_is_read_whole(large: Path) -> None:
    with ExitStack() as stack:
        assert not opened_as(View(str(large), prepare="made.gsvis"), stack).in_part


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("none.ply",), "no such file"),
        (("builtin:two_roms",), "builtin:two_rooms"),
        (("PACKAGE", "--lod", "0"), "--lod: expected none for a package"),
        (("PACKAGE", "--prepare", "x.gsvis"), "--prepare: expected none for a package"),
        (("PACKAGE", "--kind", "rooms"), "--kind: expected none for a package"),
        (("PACKAGE", "--show", "x.png"), "--show: expected none for a package"),
        (("builtin:two_rooms", "--show", "x.jpg"), "--show: expected the name of a .png"),
        (
            ("builtin:two_rooms", "--kind", "rooms", "--box", "1", "1", "1", "2", "2", "2"),
            "--kind: expected none with --box",
        ),
        (("builtin:two_rooms", "--up", "z"), "--up: expected one of"),
        (("builtin:two_rooms", "--prepare", "PACKAGE"), "--prepare: expected a new folder"),
        (("DAMAGED",), "expected JSON"),
    ],
)
def test_what_cannot_be_shown_says_why(
    package: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], said: str
) -> None:
    (tmp_path / "manifest.json").write_text("{")
    known = {"PACKAGE": str(package), "DAMAGED": str(tmp_path)}
    words = [known.get(word, word) for word in arguments]
    assert main(["view", *words, "--no-browser"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.strip().splitlines()) == 1
