"""Streamed SOG in one zip: packed and unpacked it is the same; commands read it and leave nothing."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from gsvis.cli import main
from gsvis.errors import FormatError
from gsvis.io.scenes import load_scene
from gsvis.io.streamed_zip import is_streamed_zip, pack_streamed, unpack_streamed
from tests.io.scene_files import random_scene, sog_files, streamed_files, write_files, zip_bytes

SCENE = random_scene(40, 1)


@pytest.fixture
def streamed(tmp_path: Path) -> Path:
    return write_files(tmp_path / "streamed", streamed_files({0: SCENE, 1: SCENE[:10]}))


def files_of(folder: Path) -> dict[str, bytes]:
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_what_is_packed_comes_back(streamed: Path, tmp_path: Path) -> None:
    size = pack_streamed(streamed, tmp_path / "a.ssog")
    assert size == (tmp_path / "a.ssog").stat().st_size
    assert is_streamed_zip(tmp_path / "a.ssog")
    assert unpack_streamed(tmp_path / "a.ssog", tmp_path / "out") == tmp_path / "out" / "lod-meta.json"
    assert files_of(tmp_path / "out") == files_of(streamed)
    pack_streamed(streamed, tmp_path / "again.ssog")
    assert (tmp_path / "again.ssog").read_bytes() == (tmp_path / "a.ssog").read_bytes()


def test_a_zip_of_the_folder_itself(streamed: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files_of(streamed).items():
            archive.writestr(f"city/{name}", data)
        archive.writestr("notes.txt", b"about it")
    path = unpack_streamed(tmp_path / "a.zip", tmp_path / "out")
    assert files_of(tmp_path / "out") == files_of(streamed)
    assert len(load_scene(path, 1)) == 10


@pytest.mark.parametrize("name", ["../evil", "/evil", "a/../../evil"])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.zip").write_bytes(zip_bytes({"lod-meta.json": b"{}", name: b"x"}))
    with pytest.raises(FormatError, match="names that leave the folder are refused"):
        unpack_streamed(tmp_path / "a.zip", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_zip_that_expands_too_much_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("lod-meta.json", b"{}")
        archive.writestr("zeros.webp", bytes(1 << 29))
    with pytest.raises(FormatError, match="made to exhaust memory"):
        unpack_streamed(tmp_path / "a.zip", tmp_path / "out")


def test_what_is_no_streamed_zip(tmp_path: Path, streamed: Path) -> None:
    (tmp_path / "a.sog").write_bytes(zip_bytes(sog_files(SCENE)))
    (tmp_path / "broken.zip").write_bytes(b"PK\x03\x04 and nothing")
    paths = (tmp_path / "a.sog", tmp_path / "broken.zip", tmp_path / "none.zip", streamed, streamed / "lod-meta.json")
    assert not any(map(is_streamed_zip, paths))


def test_commands_read_it_and_leave_nothing(
    streamed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    pack_streamed(streamed, tmp_path / "city.zip")
    assert main(["convert", str(tmp_path / "city.zip"), str(tmp_path / "a.ply"), "--lod", "1"]) == 0
    assert len(load_scene(tmp_path / "a.ply")) == 10
    capsys.readouterr()
    assert main(["clean", str(tmp_path / "city.zip")]) == 2
    assert "got the zip" in capsys.readouterr().err
    assert list((tmp_path / "temporary").iterdir()) == []


def test_export_never_replaces_the_zip_that_it_reads(
    streamed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "city.zip"
    pack_streamed(streamed, path)
    before = path.read_bytes()
    words = ["export", str(path), "-o", f"{tmp_path}/./city.zip", "--format", "streamed-sog", "--overwrite"]
    assert main(words) == 2
    assert "--out: expected another file than SCENE" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_export_writes_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rooms.ssog"
    words = ["export", "builtin:two_rooms", "-o", str(out), "--format", "streamed-sog", "--leaf", "65536"]
    assert main(words) == 0
    assert "Upload it to SuperSplat" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["rooms.ssog"]
    assert len(load_scene(unpack_streamed(out, tmp_path / "out"))) == 40_026
    assert main(words) == 2
    assert "expected a new file" in capsys.readouterr().err
