"""Tiles: known shares of small squares, what is listed, and the plain sum over their rays."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from gsvis.pvs.tiles import TILE, TileProbe, probe_tiles
from gsvis.raycast import TAU, EllipsoidProxies, Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import two_rooms

F64 = NDArray[np.float64]
FAR = 1e5
"""Distance of a wall whose edge divides a tile."""


def disc(center: list[float], normal: int, side: float) -> Gaussians:
    """An opaque disc across an axis."""
    scales = np.full((1, 3), side)
    scales[0, normal] = 1e-3
    return Gaussians([center], [[1, 0, 0, 0]], scales, [1.0], np.zeros((1, 1, 3)))


@cache
def rooms() -> Tracer:
    return Tracer(EllipsoidProxies.from_scene(two_rooms(1200, sh_degree=0).gaussians))


def probed(tracer: Tracer, ids: list[int] | NDArray[np.int64], rays_o: ArrayLike, rays_d: ArrayLike) -> TileProbe:
    held = np.zeros(len(tracer.proxies.gaussians), bool)
    held[ids] = True
    return probe_tiles(tracer, held, rays_o, rays_d, TAU)


def walls() -> Tracer:
    """An endless wall at z = 2 and one at z = -2."""
    g = Gaussians.concatenate([disc([0, 0, 2], 2, 1e6), disc([0, 0, -2], 2, 1e6)])
    return Tracer(EllipsoidProxies.from_scene(g))


def test_a_tile_on_a_missing_wall_misses_all_and_on_a_held_one_nothing() -> None:
    found = probed(walls(), [0], np.zeros((3, 3)), [[0, 0, 1], [0, 0, -1], [0.6, 0, -0.8]])
    assert found.missed == pytest.approx([0.0, 1.0, 1.0], abs=1e-3)
    assert found.ids.tolist() == [1]
    assert found.id_weights == pytest.approx([1.0], abs=1e-3)
    assert found.id_origins.tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_a_tile_of_which_a_part_is_missing_misses_this_part(share: float) -> None:
    # Looking along the horizon between two walls that begin far away: up is held, down is missing.
    eye = np.array([[0.0, 0.0, 0.0]])
    tilt = (0.5 - share) * TILE
    found = probed(walls(), [0], eye, [[np.cos(tilt), 0.0, np.sin(tilt)]])
    assert found.missed == pytest.approx([share], abs=1e-3)


def test_a_tile_is_as_wide_as_sixteen_pixels() -> None:
    assert pytest.approx(16.0 * (np.pi / 2) / 1920.0) == TILE
    for direction in np.array([[1.0, 0, 0], [0, 0, 1.0], [0.6, -0.64, 0.48], [-0.36, 0.48, 0.8]]):
        centers = 1000.0 * direction + np.zeros((1, 3))
        near, far = 0.49 * TILE * 1000.0, 0.51 * TILE * 1000.0 * np.sqrt(2)
        # A ball within the tile leaves some rays free, one around the tile none.
        balls = [Gaussians(centers, [[1, 0, 0, 0]], [[r / 3.33] * 3], [1.0], np.zeros((1, 1, 3))) for r in (near, far)]
        small, large = (
            probed(Tracer(EllipsoidProxies.from_scene(ball)), [], np.zeros((1, 3)), direction[None]).missed[0]
            for ball in balls
        )
        assert 0.0 < small < large < 1.0


def test_it_is_the_mean_over_the_rays_of_the_tile() -> None:
    tracer, rng = rooms(), np.random.default_rng(0)
    count = len(tracer.proxies.gaussians)
    ids = np.flatnonzero(rng.random(count) < 0.5)
    eyes = two_rooms(1200, sh_degree=0).navigable.sample_viewpoints(5, rng)
    toward = rng.normal(size=(5, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    found = probed(tracer, ids, eyes, toward)
    assert ((found.missed >= 0.0) & (found.missed <= 1.0)).all()
    largest: dict[int, float] = {}
    for tile, (eye, middle) in enumerate(zip(eyes, toward, strict=True)):
        right = np.cross(middle, np.eye(3)[np.abs(middle).argmin()])
        right /= np.linalg.norm(right)
        above = np.cross(right, middle)
        lost = 0.0
        for row in range(8):
            for column in range(8):
                along = middle + TILE * (((column + 0.5) / 8 - 0.5) * right + ((row + 0.5) / 8 - 0.5) * above)
                hits = tracer.contributions(eye[None], along[None])
                for k, weight in zip(hits.gaussian_ids.tolist(), hits.weights.tolist(), strict=True):
                    if k not in ids:
                        lost += weight
                        largest[k] = max(largest.get(k, 0.0), weight)
        assert found.missed[tile] == pytest.approx(lost / 64, abs=1e-5)
    listed = sorted(k for k, weight in largest.items() if weight >= np.float32(TAU))
    assert found.ids.tolist() == listed
    assert found.id_weights == pytest.approx([largest[k] for k in listed], rel=1e-4)
    assert {tuple(each) for each in found.id_origins.tolist()} <= {tuple(eye) for eye in eyes.tolist()}


def test_a_larger_set_never_misses_more_and_all_of_the_scene_nothing() -> None:
    tracer, rng = rooms(), np.random.default_rng(1)
    count = len(tracer.proxies.gaussians)
    eyes = two_rooms(1200, sh_degree=0).navigable.sample_viewpoints(4, rng)
    toward = np.eye(3)[[0, 1, 2, 0]] * np.array([[1], [-1], [1], [-1]])
    few = np.flatnonzero(rng.random(count) < 0.3)
    more = np.union1d(few, np.flatnonzero(rng.random(count) < 0.5))
    sets = [few, more, np.arange(count)]
    missed = [probed(tracer, ids, eyes, toward).missed for ids in sets]
    assert (missed[1] <= missed[0]).all()
    assert missed[2].tolist() == [0.0] * 4
    better = probed(tracer, np.union1d(few, probed(tracer, few, eyes, toward).ids), eyes, toward)
    assert len(better.ids) == 0
    assert (better.missed < 64 * TAU).all()


def test_no_ray_is_no_tile() -> None:
    found = probed(walls(), [0], np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(found.missed) == len(found.ids) == len(found.id_weights) == 0
    assert found.id_origins.shape == (0, 3)


def test_the_shape_of_rays_is_checked() -> None:
    for name, rays in (("rays_o", (np.zeros((2, 2)), np.zeros((2, 3)))), ("rays_d", (np.zeros((2, 3)), [1.0, 0, 0]))):
        with pytest.raises(ValueError, match=name):
            probed(walls(), [0], *rays)
