"""Where one can walk, written after the scene: the same grid, under the name that was promised."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsvis.errors import FormatError
from gsvis.export.later_walk import promise_walk, write_walk
from gsvis.export.static import StaticOptions, write_static
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.walk import find_walk
from gsvis.scene.procedural import builtin_scene


def walk_of(folder: Path) -> str:
    return json.loads((folder / "scene.json").read_text())["files"]["walk"]["name"]


def test_the_promised_file_holds_the_grid(tmp_path: Path) -> None:
    made = builtin_scene("box_in_room")
    write_static(tmp_path, made.gaussians, StaticOptions("room"))
    promise_walk(tmp_path)
    assert not (tmp_path / walk_of(tmp_path)).exists()
    path = write_walk(tmp_path, made.gaussians, made.navigable)
    assert path == tmp_path / walk_of(tmp_path)
    grid = find_walk(made.gaussians, CellGrid.over(made.navigable))
    assert grid is not None
    assert path.read_bytes() == grid.to_bytes()


def test_where_nobody_can_walk_the_file_is_empty(tmp_path: Path) -> None:
    made = builtin_scene("box_in_room")
    write_static(tmp_path, made.gaussians, StaticOptions("room"))
    promise_walk(tmp_path)
    assert write_walk(tmp_path, made.gaussians[:0], made.navigable).exists()


def test_names_differ_and_one_promise_is_enough(tmp_path: Path) -> None:
    made = builtin_scene("box_in_room")
    names = set()
    for folder in (tmp_path / "a", tmp_path / "b"):
        write_static(folder, made.gaussians[:100], StaticOptions("room"))
        promise_walk(folder)
        names.add(walk_of(folder))
    assert len(names) == 2
    with pytest.raises(FormatError, match="without one of walking"):
        promise_walk(tmp_path / "a")
