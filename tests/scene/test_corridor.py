"""The space along a walk: every clear voxel near it and no other, in little memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from gsvis.scene import corridor
from gsvis.scene.corridor import fill_in, space_along
from gsvis.scene.procedural import two_rooms

SCENE = two_rooms(8_000, sh_degree=0)
EYES = SCENE.navigable.sample_viewpoints(2, np.random.default_rng(0))
WALK = fill_in(EYES, 0.1)


def test_the_space_along_a_walk_is_every_clear_voxel_near_it() -> None:
    space = space_along(SCENE.gaussians, WALK, 0.5, resolution=48, up=SCENE.up)
    centers = space.origin + space.voxel_size * (np.argwhere(np.ones(space.free.shape, bool)) + 0.5)
    near = (cKDTree(WALK).query(centers)[0] <= 0.5).reshape(space.free.shape)
    assert np.array_equal(space.free, near & ~ndimage.binary_dilation(space.occupied))


def test_layers_together_are_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    before = space_along(SCENE.gaussians, WALK, 0.5, resolution=48, up=SCENE.up)
    monkeypatch.setattr(corridor, "_AT_ONCE", 1)
    after = space_along(SCENE.gaussians, WALK, 0.5, resolution=48, up=SCENE.up)
    assert np.array_equal(before.free, after.free)


def test_the_space_along_a_walk_takes_30_bytes_a_voxel() -> None:
    """So much is counted for a tile of a world, whatever eyes follow (gsvis/world/memory.py)."""
    space_along(SCENE.gaussians, WALK, 0.5, resolution=48, up=SCENE.up)
    tracemalloc.start()
    try:
        space = space_along(SCENE.gaussians, WALK, 0.5, resolution=256, up=SCENE.up)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak <= 30 * space.free.size + 48 * 2**20
