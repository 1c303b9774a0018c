"""The scene that a package was made from: another one is refused when it cannot be the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.io import save_scene
from gsvis.io.sources import load_source
from gsvis.package.made_from import KEY, made_from_of
from gsvis.package.original import about_source, find_original, load_original
from gsvis.scene.procedural import random_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    save_scene(random_scene(np.random.default_rng(0), 60), path)
    return path


def test_a_given_scene_of_another_size_is_refused_in_one_line(scene: Path, tmp_path: Path) -> None:
    """Another level of detail would be compared silently, and every figure would be wrong."""
    package = str(tmp_path / "scene.gsvis")
    provenance = about_source(str(scene), load_source(str(scene), None), package)
    found, remark = load_original(find_original(package, provenance, [(str(scene), None)]), given=True)
    assert found is not None
    assert (len(found), remark) == (60, "")
    other = tmp_path / "other.ply"
    save_scene(random_scene(np.random.default_rng(0), 50), other)
    wanted = r"^other\.ply: expected the 60 Gaussians of scene\.ply, from which the package was made, got 50; name that"
    with pytest.raises(ValueError, match=wanted):
        load_original(find_original(package, provenance, [(str(other), None)]), given=True)


def test_the_level_of_detail_is_named(scene: Path, tmp_path: Path) -> None:
    rows = [{**about_source(str(scene), load_source(str(scene), None), "p")[KEY][0], "lod": 1, "gaussians": 70}]
    original = find_original(str(tmp_path / "p"), {KEY: rows}, [(str(scene), None)])
    assert made_from_of({KEY: rows})[0].lod == 1
    with pytest.raises(ValueError, match=r"the 70 Gaussians of scene\.ply, level of detail 1, from which"):
        load_original(original, given=True)


def test_a_scene_of_the_same_size_may_be_compared_with_a_remark(scene: Path, tmp_path: Path) -> None:
    package = str(tmp_path / "scene.gsvis")
    provenance = about_source(str(scene), load_source(str(scene), None), package)
    other = tmp_path / "other.ply"
    save_scene(random_scene(np.random.default_rng(1), 60), other)
    found, remark = load_original(find_original(package, provenance, [(str(other), None)]), given=True)
    assert found is not None
    assert "its content differs" in remark
