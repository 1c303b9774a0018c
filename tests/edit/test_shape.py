"""Shapes: lonely groups are no surface, surfaces are, and grids stay affordable."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.edit import Shape, core_of
from gsvis.edit.shape import FEW, Surfaces, affordable_resolution, find_surfaces
from gsvis.scene.density import Density
from gsvis.scene.gaussians import Gaussians
from tests.edit.worlds import dots


def corner(count: int = 60) -> Gaussians:
    """Gaussians that touch each other, on a floor 6 wide and a wall 3 high and 1 wide."""
    places = np.linspace(0.0, 1.0, count)
    x, y = (each.ravel() for each in np.meshgrid(places, places))
    floor, wall = np.stack([6 * x, y, np.zeros_like(x)], axis=1), np.stack([np.zeros_like(x), x, 3 * y], axis=1)
    return dots(np.concatenate([floor, wall]), 6.0 / count, 0.9)


def clump(count: int, at: tuple[float, float, float]) -> Gaussians:
    """Small Gaussians in one place."""
    rng = np.random.default_rng(count)
    return dots(np.asarray(at) + 0.02 * rng.normal(size=(count, 3)), 0.02, 0.9)


@pytest.mark.parametrize(("count", "lonely"), [(1, True), (FEW - 4, True), (4 * FEW, False)])
def test_a_small_group_in_the_air_is_lonely(count: int, lonely: bool) -> None:
    scene = Gaussians.concatenate([corner(), clump(count, (3.0, 0.5, 2.0))])
    found = Shape.from_scene(scene).lonely
    assert not found[:-count].any()
    assert found[-count:].all() == found[-count:].any() == lonely
    assert len(core_of(scene)) == len(scene) - count * lonely


def test_a_group_at_a_floor_belongs_to_it() -> None:
    scene = Gaussians.concatenate([corner(), clump(5, (3.0, 0.5, 0.1))])
    assert not Shape.from_scene(scene).lonely.any()


def test_lonely_groups_hide_things_all_the_same() -> None:
    shape = Shape.from_scene(Gaussians.concatenate([corner(), clump(5, (3.0, 0.5, 2.0))]))
    assert shape.core.all()
    assert np.array_equal(shape.surfaces, ~shape.lonely)


def test_a_scene_in_one_point_has_no_grid() -> None:
    assert not Shape.from_scene(dots(np.zeros((3, 3)), 0.1, 0.9)).lonely.any()


def test_more_strength_never_finds_more_surface() -> None:
    scene = Gaussians.concatenate([corner(), clump(FEW + 10, (3.0, 0.5, 2.0))])
    density = Density.from_scene(scene, (-1, -1, -1), (7, 2, 4), 96)
    surfaces = [Surfaces(density, find_surfaces([scene], density, strength)) for strength in (0.3, 1.0, 2.0)]
    for weak, strong in pairwise(surfaces):
        assert not (strong.mask & ~weak.mask).any()
        assert not (weak.lonely(scene.means) & ~strong.lonely(scene.means)).any()
    assert [found.lonely(scene.means)[-1] for found in surfaces] == [False, False, True]


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (9.0, 9.0, 1.0), (1.0, 1e-9, 0.0), (1e-6, 2e-6, 3e-6)])
@pytest.mark.parametrize("wanted", [8, 384, 512])
def test_grids_stay_affordable(sides: tuple[float, float, float], wanted: int) -> None:
    box: NDArray[np.float64] = np.array(sides)
    found = affordable_resolution(box, wanted)
    voxels = np.prod(np.maximum(np.ceil(box / box.max() * found), 1.0))
    assert 8 <= found <= wanted
    assert voxels <= 1.02 * 2**24
    assert found == wanted or voxels > 0.9 * 2**24
