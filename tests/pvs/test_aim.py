"""Directions in which something may lie: nothing lies in others, draws are uniform, and the plain twin agrees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsvis.pvs.aim import Aim, share_of_centers
from gsvis.pvs.reference import marked_reference
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene

F64 = NDArray[np.float64]


def scattered(seed: int, count: int = 40) -> Tracer:
    rng = np.random.default_rng(seed)
    g = random_scene(rng, count)
    return Tracer(EllipsoidProxies.from_scene(Gaussians(g.means, g.quats, 0.3 * g.scales, g.opacities, g.sh0)))


def leaf_boxes(tracer: Tracer) -> F64:
    """(N, 2, 3) the boxes of single Gaussians in the hierarchy."""
    h = tracer.hierarchy
    leaf = (h.children < 0) & np.isfinite(h.boxes[:, 0])
    return np.stack([h.boxes[:, :3].transpose(0, 2, 1)[leaf], h.boxes[:, 3:].transpose(0, 2, 1)[leaf]], axis=1).astype(
        np.float64
    )


def box_of(seed: int) -> tuple[F64, F64]:
    """Eyes beside the scene, or amid it; a point at times."""
    rng = np.random.default_rng(seed)
    middle = rng.normal(size=3) * rng.choice([2.0, 12.0])
    half = rng.uniform(0.0, 1.0, 3) * rng.choice([0.0, 1.5])
    return middle - half, middle + half


@given(st.integers(0, 200), st.integers(0, 10_000), st.sampled_from([4, 9, 16]))
def test_what_is_marked_is_what_the_plain_twin_marks(scene: int, eyes: int, size: int) -> None:
    tracer, (low, high) = scattered(scene), box_of(eyes)
    aim, plain = Aim.of_box(tracer, low, high, size), marked_reference(leaf_boxes(tracer), low, high, size)
    if plain is None:
        assert aim.share == 1.0
    else:
        differ = aim.marked != plain  # edges of boxes on edges of pixels, by rounding
        assert differ.mean() <= 0.01
        assert aim.share == aim.marked.mean()


@given(st.integers(0, 200), st.integers(0, 10_000), st.sampled_from([0.05, 0.25, 0.6]))
def test_marking_ends_with_enough_pixels_and_not_before(scene: int, eyes: int, enough: float) -> None:
    tracer, (low, high) = scattered(scene), box_of(eyes)
    whole = Aim.of_box(tracer, low, high, 16)
    some = Aim.of_box(tracer, low, high, 16, enough=enough)
    assert (some.marked <= whole.marked).all()
    assert some.share == whole.share if whole.share < enough else some.share >= enough


def pixel_of(directions: F64, size: int) -> tuple[NDArray[np.int64], ...]:
    """Face, row and column of unit vectors (R, 3)."""
    axis = np.abs(directions).argmax(axis=1)
    rows = np.arange(len(directions))
    along = directions[rows, axis]
    u, v = (
        directions[rows, np.where(axis == skip, other, k)] / np.abs(along) for skip, other, k in ((0, 1, 0), (2, 1, 2))
    )
    column, row = (np.minimum((0.5 * size * (each + 1.0)).astype(np.int64), size - 1) for each in (u, v))
    return 2 * axis + (along < 0.0), row, column


@pytest.mark.parametrize("seed", range(6))
def test_a_ray_in_another_direction_meets_nothing(seed: int) -> None:
    tracer, (low, high), rng = scattered(seed), box_of(seed), np.random.default_rng(seed)
    aim = Aim.of_box(tracer, low, high, 16)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = tracer.contributions(rng.uniform(low, high, (4000, 3)), directions)
    met = np.diff(hits.ray_offsets) > 0
    assert aim.marked[pixel_of(directions, 16)][met].all()


@pytest.mark.parametrize("size", [2, 16])
def test_draws_are_uniform_over_what_is_marked(size: int) -> None:
    rng = np.random.default_rng(0)
    marked = rng.random((6, size, size)) < 0.3
    drawn = Aim(marked, float(marked.mean())).draw(40_000, rng)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0, atol=1e-12)
    assert marked[pixel_of(drawn, size)].mean() > 0.999  # but for rounding at edges
    uniform = rng.normal(size=(400_000, 3))
    uniform = uniform[marked[pixel_of(uniform, size)]]
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    for moment in (lambda d: d, lambda d: d * d, lambda d: d * np.roll(d, 1, axis=1)):
        apart = moment(drawn).mean(axis=0) - moment(uniform).mean(axis=0)
        assert np.abs(apart).max() < 5.0 / np.sqrt(40_000)


def test_from_within_all_directions_count_and_in_a_void_too() -> None:
    tracer = scattered(0)
    inside = tracer.proxies.gaussians.means[0].astype(np.float64)
    assert Aim.of_box(tracer, inside, inside, 8).share == 1.0
    nothing = Aim.of_box(Tracer(EllipsoidProxies.from_scene(Gaussians.empty())), np.zeros(3), np.ones(3), 8)
    assert nothing.share == 0.0
    assert nothing.draw(5, np.random.default_rng(0)).shape == (5, 3)


@given(st.integers(0, 1000), st.sampled_from([4, 16, 32]))
def test_the_share_of_centers_is_that_of_their_directions(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    eye, ways = rng.normal(size=3), rng.normal(size=(50, 3))
    share = share_of_centers(eye + ways, eye, size)
    assert 50 / (6 * size * size) * 0.1 < share <= min(1.0, 50 * 9 / (6 * size * size))
    assert share_of_centers(eye + rng.uniform(0.1, 9.0, (50, 1)) * ways, eye, size) == pytest.approx(share, abs=0.02)
    turned = ways[:, [1, 2, 0]] * [1.0, -1.0, 1.0]
    assert share_of_centers(turned, np.zeros(3), size) == pytest.approx(share, abs=0.02)


def test_centers_on_one_side_fill_little_and_all_around_everything() -> None:
    ball = np.random.default_rng(0).normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    assert share_of_centers(ball, np.zeros(3), 16) > 0.99
    assert share_of_centers(ball, np.array([-30.0, 0.0, 0.0]), 16) <= 16 / (6 * 16 * 16)
    assert share_of_centers(np.zeros((3, 3)), np.zeros(3), 16) == 0.0


@given(st.integers(0, 1000), st.sampled_from([0.02, 0.1, 0.25]))
def test_the_share_of_centers_ends_with_enough_and_not_before(seed: int, enough: float) -> None:
    centers = np.random.default_rng(seed).normal(size=(60, 3))
    whole = share_of_centers(centers, np.zeros(3), 16)
    some = share_of_centers(centers, np.zeros(3), 16, enough=enough)
    assert some == whole if whole < enough else enough <= some <= whole
