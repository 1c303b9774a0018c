"""Conversion batch by batch: the same bytes as in memory, whatever the batches, and one error where nothing is left."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from gsvis.errors import SceneError
from gsvis.io import batches, convert_scene, load_scene, merge_scenes, save_scene
from gsvis.io.batches import list_batches
from gsvis.io.convert_batches import convert_batches
from gsvis.io.ply import save_ply_parts
from tests.io.scene_files import random_scene, splat_bytes, streamed_files, write_files

PLACED = {"up": ("-y", "+z"), "scale": 1.7, "rotate": (10.0, 20.0, 30.0), "translate": (1.0, 2.0, 3.0)}


@pytest.mark.parametrize("rows", [1, 7, 64])
@pytest.mark.parametrize("options", [{}, PLACED, {"min_opacity": 0.4, "max_sh_degree": 1, **PLACED}])
def test_batches_give_the_bytes_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int, options: dict[str, Any]
) -> None:
    save_scene(random_scene(90, 1, 1), tmp_path / "a.ply")
    save_scene(random_scene(50, 3, 2), tmp_path / "b.ply")
    write_files(tmp_path / "s", streamed_files({0: random_scene(40, 0)}))
    (tmp_path / "c.splat").write_bytes(splat_bytes(random_scene(30)))
    paths = [tmp_path / name for name in ("a.ply", "b.ply", "s", "c.splat")]
    convert = partial(convert_scene, **options)
    save_scene(convert(merge_scenes([load_scene(path) for path in paths])), tmp_path / "whole.ply")
    monkeypatch.setattr(batches, "ROWS", rows)
    made = convert_batches(
        [list_batches(path) for path in paths], tmp_path / "parts.ply", convert,
        drops="min_opacity" in options, max_sh_degree=options.get("max_sh_degree", 3),
    )  # fmt: skip
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert made.counts == (90, 50, 40, 30)
    assert made.sh_degrees == (1, 3, 0, 0)
    assert made.gaussians == len(load_scene(tmp_path / "whole.ply"))


def test_a_scene_of_which_nothing_is_left_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    save_scene(random_scene(90), tmp_path / "a.ply")
    with pytest.raises(SceneError, match="leave none of 90 Gaussians"):
        convert_batches(
            [list_batches(tmp_path / "a.ply")], tmp_path / "b.ply", partial(convert_scene, min_opacity=1.0), drops=True
        )
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.parametrize(("count", "degree"), [(89, 3), (91, 3), (90, 2)])
def test_parts_that_are_not_what_was_said_leave_no_file(tmp_path: Path, count: int, degree: int) -> None:
    with pytest.raises(ValueError, match="expected"):
        save_ply_parts([random_scene(90, 3)], tmp_path / "a.ply", count, degree)
    assert not (tmp_path / "a.ply").exists()
