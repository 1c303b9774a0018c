"""Scenes by address: what comes is what the host has, all of it, and nothing outside of the folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.errors import FormatError
from gsvis.io.ply import save_ply
from gsvis.io.remote import fetch_scene, is_address
from gsvis.io.scenes import load_scene
from tests.io.scene_files import random_scene, sog_files, streamed_files, write_files

SCENE = random_scene(40, 1)


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder without a log; of `short.ply` it says more bytes than it sends."""

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        if self.path != "/short.ply":
            return super().do_GET()
        self.send_response(200)
        self.send_header("Content-Length", "1000")
        self.end_headers()
        self.wfile.write(b"ply\n")
        self.close_connection = True
        return None


@pytest.fixture
def host(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """The address of a host, and the folder that it serves."""
    root = tmp_path / "root"
    root.mkdir()
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(root))) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}", root
        server.shutdown()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "fetched").mkdir()
    return tmp_path / "fetched"


def test_a_file_comes_whole_with_its_name_and_its_progress(host: tuple[str, Path], folder: Path) -> None:
    address, root = host
    save_ply(SCENE, root / "my scene.ply")
    steps: list[tuple[str, int, int]] = []
    path = fetch_scene(f"{address}/my%20scene.ply?token=a/b", folder, progress=lambda *each: steps.append(each))
    assert path == folder / "my scene.ply"
    assert path.read_bytes() == (root / "my scene.ply").read_bytes()
    size = path.stat().st_size
    assert steps[0] == ("fetching", 0, size)
    assert steps[-1] == ("fetching", size, size)


def test_of_a_streamed_scene_one_level_comes(host: tuple[str, Path], folder: Path) -> None:
    address, root = host
    write_files(root / "city", streamed_files({0: SCENE, 1: SCENE[:10]}))
    path = fetch_scene(f"{address}/city/lod-meta.json", folder, 1)
    assert len(load_scene(path, 1)) == 10
    with pytest.raises(FormatError, match="LODs present: 1"):
        load_scene(path, 0)
    with pytest.raises(FormatError, match="expected a LOD 7"):
        fetch_scene(f"{address}/city/lod-meta.json", folder, 7)


def test_the_planes_of_a_sog_come_with_its_json(host: tuple[str, Path], folder: Path) -> None:
    address, root = host
    write_files(root / "sog", sog_files(SCENE))
    assert len(load_scene(fetch_scene(f"{address}/sog/meta.json", folder))) == len(SCENE)


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "a/../../b"])
def test_names_that_leave_the_folder_are_refused(host: tuple[str, Path], folder: Path, name: str) -> None:
    address, root = host
    (root / "lod-meta.json").write_text(json.dumps({"filenames": [name], "tree": {}}))
    with pytest.raises(FormatError, match="names that leave the folder are refused"):
        fetch_scene(f"{address}/lod-meta.json", folder)
    assert [each.name for each in folder.iterdir()] == ["lod-meta.json"]


def test_what_cannot_be_fetched_is_said_in_a_line(host: tuple[str, Path], folder: Path) -> None:
    address, _ = host
    with pytest.raises(FormatError, match="expected a file, got 404"):
        fetch_scene(f"{address}/none.ply", folder)
    with pytest.raises(FormatError, match="1,000 bytes, got 4"):
        fetch_scene(f"{address}/short.ply", folder)
    with pytest.raises(FormatError, match="expected a host that answers"):
        fetch_scene("http://127.0.0.1:9/scene.ply", folder)


def test_storages_of_fsspec(folder: Path) -> None:
    fsspec = pytest.importorskip("fsspec", reason="needs fsspec, of the extra cluster")
    save_ply(SCENE, folder / "a.ply")
    fsspec.filesystem("memory").pipe_file("/scenes/a.ply", (folder / "a.ply").read_bytes())
    (folder / "new").mkdir()
    assert len(load_scene(fetch_scene("memory://scenes/a.ply", folder / "new"))) == len(SCENE)
    with pytest.raises(FormatError, match="that fsspec can open"):
        fetch_scene("memory://scenes/none.ply", folder / "new")


def test_commands_take_addresses_and_leave_nothing(
    host: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    address, root = host
    save_ply(SCENE, root / "a.ply")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    assert main(["convert", f"{address}/a.ply", str(tmp_path / "b.ply")]) == 0
    np.testing.assert_array_equal(load_scene(tmp_path / "b.ply").means, SCENE.means)
    assert main(["inspect", f"{address}/a.ply", "--json"]) == 0
    assert list((tmp_path / "temporary").iterdir()) == []
    capsys.readouterr()
    assert main(["clean", f"{address}/a.ply"]) == 2
    assert "got the address" in capsys.readouterr().err


def test_what_is_an_address() -> None:
    assert is_address("https://example.org/a.spz")
    assert not any(map(is_address, ("a.ply", "builtin:flat", "./a://b.ply", "c:\\scenes\\a.ply", Path("/a"))))
