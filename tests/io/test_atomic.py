"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from gsvis.io.atomic import atomic_folder, atomic_path


def everything(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


def test_a_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "scene.ply"
    with atomic_path(target) as partial:
        assert partial.suffix == ".ply"
        assert partial.parent == target.parent
        partial.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert everything(tmp_path) == ["deep", "deep/scene.ply"]


@pytest.mark.parametrize("crash", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_crash_leaves_the_old_file_and_nothing_else(tmp_path: Path, crash: type[BaseException]) -> None:
    target = tmp_path / "a.json"
    target.write_text("old")
    with pytest.raises(crash), atomic_path(target) as partial:
        partial.write_text("half")
        raise crash
    assert target.read_text() == "old"
    assert everything(tmp_path) == ["a.json"]


def test_a_block_may_make_the_file_anew_or_clean_up_itself(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a") as partial:
        partial.unlink()
        partial.write_text("new")
    assert (tmp_path / "a").read_text() == "new"
    with pytest.raises(ValueError, match="gave up"), atomic_path(tmp_path / "b") as partial:
        partial.unlink()
        raise ValueError("gave up")
    assert everything(tmp_path) == ["a"]


@pytest.mark.skipif(os.name != "posix", reason="POSIX file modes")
@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_files_have_the_rights_of_any_new_file(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        with atomic_path(tmp_path / "a") as partial:
            partial.write_text("")
        with atomic_folder(tmp_path / "f") as folder:
            (folder / "a").write_text("")
    finally:
        os.umask(before)
    for path, full in ((tmp_path / "a", 0o666), (tmp_path / "f", 0o777), (tmp_path / "f" / "a", 0o666)):
        assert stat.S_IMODE(path.stat().st_mode) == full & ~umask


def test_two_writers_do_not_meet(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a") as first, atomic_path(tmp_path / "a") as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert everything(tmp_path) == ["a"]


def test_a_folder_is_filled_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "mine.txt").write_text("kept")
    (target / "report.json").write_text("old")
    with atomic_folder(target) as partial:
        (partial / "plots").mkdir()
        (partial / "plots" / "cdf.png").write_text("png")
        (partial / "report.json").write_text("new")
        assert (target / "report.json").read_text() == "old"
    assert everything(tmp_path) == ["out", "out/mine.txt", "out/plots", "out/plots/cdf.png", "out/report.json"]
    assert (target / "report.json").read_text() == "new"


def test_a_crash_leaves_the_old_folder_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt), atomic_folder(target) as partial:
        (partial / "half").write_text("")
        raise KeyboardInterrupt
    assert everything(tmp_path) == []
    target.mkdir()
    (target / "old").write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_folder(target) as partial:
        (partial / "old").write_text("half")
        raise KeyboardInterrupt
    assert everything(tmp_path) == ["out", "out/old"]
    assert (target / "old").read_text() == "old"
