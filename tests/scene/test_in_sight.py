"""In sight: walls of voxels hide what is behind them, and nothing that a camera sees plainly is left out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from gsvis.render import view_weights
from gsvis.scene._kernels.in_sight import grow
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.in_sight import InSight
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms


def row(xs: list[float], scale: float = 0.05) -> Gaussians:
    """Gaussians on the x axis."""
    n = len(xs)
    means = np.stack([np.array(xs), np.zeros(n), np.zeros(n)], axis=1)
    return Gaussians(means, [[1, 0, 0, 0]] * n, [[scale] * 3] * n, [0.9] * n, np.ones((n, 1, 3)))


def walled(thickness: int = 6) -> NavigableSpace:
    """A box of 40 x 20 x 20 voxels of side 0.5 about the origin, with a wall across x = 0."""
    free = np.ones((40, 20, 20), bool)
    occupied = np.zeros_like(free)
    occupied[20 : 20 + thickness] = True
    return NavigableSpace(np.array([-10.0, -5.0, -5.0]), 0.5, free, np.array([0.0, 0.0, 1.0]), occupied)


def along(x: float, to: float) -> Cameras:
    return Cameras.look_at([[x, 0, 0]], [[to, 0, 0]], up=[0, 0, 1], width=32, height=24, fov=60.0)


def test_a_wall_hides_what_is_behind_it_and_the_image_what_is_beside_it() -> None:
    sight = InSight.from_scene(row([-9.0, -4.0, 0.2, 8.0, 30.0]), walled())
    assert sight.of(along(-6.0, 0.0)).tolist() == [False, True, True, False, True]  # beyond the grid: always in sight
    assert sight.of(along(6.0, 0.0)).tolist() == [False, False, False, False, True]  # the wall's far side
    assert sight.of(along(-6.0, -9.0)).tolist() == [True, False, False, False, True]
    assert sight.of(along(-16.0, 0.0)).tolist() == [True, True, True, False, True]  # an eye outside of the grid


def test_a_large_gaussian_reaches_into_sight() -> None:
    space = walled()
    for scale, seen in ((0.05, False), (1.5, True), (4.0, True)):  # the voxel of its center is behind the wall
        assert InSight.from_scene(row([4.4], scale), space).of(along(-6.0, 0.0)).tolist() == [seen]


def test_a_space_without_walls_hides_nothing() -> None:
    space = NavigableSpace.from_box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    assert InSight.from_scene(row([-9.0, 0.5, 9.0]), space).of(along(0.0, 5.0)).all()
    assert InSight.from_scene(Gaussians.empty(), space).of(along(0.0, 5.0)).shape == (0,)


def test_some_of_the_gaussians_are_in_sight_as_among_all() -> None:
    rng = np.random.default_rng(5)
    n = 300
    means = rng.uniform(-12.0, 12.0, (n, 3)) * [1.0, 0.5, 0.5]
    scales = np.repeat(rng.uniform(0.01, 3.0, (n, 1)), 3, axis=1)
    g = Gaussians(means, [[1, 0, 0, 0]] * n, scales, [0.9] * n, np.ones((n, 1, 3)))
    sight = InSight.from_scene(g, walled())
    chosen = rng.permutation(n)[:120]
    seen = sight.of(along(-6.0, 0.0))
    assert 0 < seen.sum() < n
    np.testing.assert_array_equal(sight.only(chosen).of(along(-6.0, 0.0)), seen[chosen])


@pytest.mark.parametrize("seed", [1, 2])
def test_nearly_all_light_of_rooms_is_in_sight_and_most_gaussians_are_not(seed: int) -> None:
    scene = two_rooms(8_000, sh_degree=0)
    g, space = scene.gaussians, NavigableSpace.from_scene(scene.gaussians, up=scene.up)
    sight = InSight.from_scene(g, space)
    cameras = space.sample_cameras(6, np.random.default_rng(seed), width=64, height=48)
    for index in range(len(cameras)):
        seen = sight.of(cameras[[index]])
        weights = view_weights(g, cameras[[index]]).summed[0]
        assert weights[seen].sum() > 0.97 * weights.sum()
        assert seen.mean() < 0.9


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 1), (17, 3, 8), (20, 21, 22), (3, 2, 64), (4, 5, 150)])
def test_what_lies_near_is_what_lies_in_the_cube_around(shape: tuple[int, int, int]) -> None:
    mask = np.random.default_rng(0).random(shape) < 0.02
    words = np.zeros((*shape[:2], -(-shape[2] // 64)), np.uint64)
    for x, y, z in np.argwhere(mask):
        words[x, y, z // 64] |= np.uint64(1) << np.uint64(z % 64)
    grown = 0
    for reach in (1, 2, 4, 8):
        out = np.empty_like(words)
        grow(words, reach - grown, np.empty_like(words), out)
        words, grown = out, reach
        bits = np.unpackbits(words.view(np.uint8), axis=2, bitorder="little")[:, :, : shape[2]]
        np.testing.assert_array_equal(bits, ndimage.maximum_filter(mask, 2 * reach + 1, mode="constant"))
