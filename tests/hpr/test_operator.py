"""Hidden point removal: Open3D's set on clouds of many kinds, the laws of the operator, and its degenerate cases."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import get_num_threads
from numpy.typing import NDArray

from gsvis.hpr import hidden_point_removal, operator
from gsvis.hpr.reference import hidden_point_removal_reference
from gsvis.io import load_scene
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

KINDS = ("ball", "box", "shell", "shell from outside", "plane", "room", "float32", "line of balls", "far outlier")


def cloud(kind: str, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and an eye (3,)."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    eye = np.array([0.1, 0.2, 0.3])
    if kind == "box":
        points = rng.uniform(-1, 1, (n, 3))
    elif kind.startswith("shell"):
        points /= np.linalg.norm(points, axis=1)[:, None]
        eye = eye if kind == "shell" else np.array([3.0, 0.2, 0.3])
    elif kind == "plane":
        points[:, 2] = -1.0
    elif kind == "room":
        points = rng.uniform(-1, 1, (n, 3))
        axis = rng.integers(0, 3, n)
        points[np.arange(n), axis] = np.sign(points[np.arange(n), axis])
    elif kind == "float32":
        points = points.astype(np.float32).astype(np.float64)
    elif kind == "line of balls":
        points = 0.2 * points + np.array([2.0, 0.0, 0.0]) * rng.integers(1, 6, (n, 1))
    elif kind == "far outlier":
        points[0] = [1e4, 2e4, -3e4]
    return points, eye


def farthest(points: np.ndarray, eye: np.ndarray) -> float:
    return float(np.linalg.norm(points - eye, axis=1).max()) * (1 + 1e-12)


def by_open3d(points: np.ndarray, eye: np.ndarray, radius: float) -> np.ndarray:
    get_num_threads()  # starts numba's threads before open3d brings a TBB that numba finds too old, and says so
    import open3d as o3d

    found = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).hidden_point_removal(eye, radius)[1]
    return np.sort(np.asarray(found, np.int64))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("times", [1.0, 3.0, 100.0, 1e4, 1e7])
def test_the_set_is_open3ds(kind: str, times: float, monkeypatch: pytest.MonkeyPatch) -> None:
    points, eye = cloud(kind, 4000)
    radius = times * farthest(points, eye)
    want = by_open3d(points, eye, radius)
    monkeypatch.setattr(operator, "_by_qhull", None)  # a hull of our own finds it
    assert np.array_equal(hidden_point_removal(points, eye, radius), want)
    assert np.array_equal(hidden_point_removal_reference(points, eye, radius), want)


@given(seed=st.integers(0, 10**6), n=st.integers(4, 300), kind=st.sampled_from(KINDS), power=st.floats(0.0, 6.0))
def test_the_set_is_the_references(seed: int, n: int, kind: str, power: float) -> None:
    points, eye = cloud(kind, n, seed)
    radius = 10**power * farthest(points, eye)
    assert np.array_equal(
        hidden_point_removal(points, eye, radius), hidden_point_removal_reference(points, eye, radius)
    )


@given(seed=st.integers(0, 10**6), step=st.sampled_from([0.5, 0.25, 0.125]), power=st.floats(0.0, 5.0))
def test_lattices_with_many_coincident_points_agree_by_position(seed: int, step: float, power: float) -> None:
    points, eye = cloud("ball", 400, seed)
    points = np.round(points / step) * step
    radius = 10**power * farthest(points, eye)
    ours, theirs = (
        np.unique(points[f(points, eye, radius)], axis=0)
        for f in (hidden_point_removal, hidden_point_removal_reference)
    )
    assert np.array_equal(ours, theirs)


@pytest.fixture(scope="module")
def showroom(
    realdata: Path, real_space: Callable[[Gaussians], NavigableSpace]
) -> tuple[Gaussians, NDArray[np.float64]]:
    """A real scene and an eye in it."""
    g = load_scene(realdata / "scenes/showroom/lod-meta.json", lod=3)
    return g, real_space(g).sample_viewpoints(1, np.random.default_rng(5))[0]


@pytest.mark.realdata
@pytest.mark.parametrize("times", [1.0, 30.0, 1000.0])
def test_the_set_of_a_real_scene_is_open3ds(showroom: tuple[Gaussians, NDArray[np.float64]], times: float) -> None:
    g, eye = showroom
    points = g.means[:: int(np.sqrt(times))].astype(np.float64)
    radius = times * farthest(points, eye)
    ours, theirs = hidden_point_removal(points, eye, radius), by_open3d(points, eye, radius)
    assert len(ours) == len(theirs)
    assert np.array_equal(np.unique(points[ours], axis=0), np.unique(points[theirs], axis=0))


def test_a_sphere_around_the_eye_is_all_visible_and_a_second_one_behind_it_hidden() -> None:
    points, _ = cloud("shell", 2000)
    both = np.concatenate([3.0 * points, points])
    assert np.array_equal(hidden_point_removal(both, np.zeros(3), 30.0), np.arange(2000, 4000))


def test_more_radius_more_points() -> None:
    points, eye = cloud("ball", 5000)
    counts = [len(hidden_point_removal(points, eye, k * farthest(points, eye))) for k in (1, 10, 100, 1e3, 1e4, 1e5)]
    assert counts == sorted(counts)
    assert counts[0] < 300
    assert counts[-1] == 5000


def test_moving_the_world_and_changing_the_order_change_nothing() -> None:
    points, eye = cloud("room", 3000)
    radius = 50 * farthest(points, eye)
    want = hidden_point_removal(points, eye, radius)
    shift = np.array([1e3, -2e3, 500.0])
    assert np.array_equal(hidden_point_removal(points + shift, eye + shift, radius), want)
    order = np.random.default_rng(0).permutation(len(points))
    assert np.array_equal(np.sort(order[hidden_point_removal(points[order], eye, radius)]), want)


def test_of_coincident_points_the_first_stands_for_all() -> None:
    points, eye = cloud("ball", 1000)
    radius = 100 * farthest(points, eye)
    once = hidden_point_removal(points, eye, radius)
    assert np.array_equal(hidden_point_removal(np.concatenate([points] * 3), eye, radius), once)
    assert np.array_equal(hidden_point_removal(np.repeat(points, 3, axis=0), eye, radius), 3 * once)


def test_points_at_the_eye_are_visible_and_hide_nothing() -> None:
    points, eye = cloud("ball", 500)
    radius = 100 * farthest(points, eye)
    want = hidden_point_removal(points, eye, radius)
    with_eye = np.concatenate([eye[None], points, eye[None]])
    assert np.array_equal(hidden_point_removal(with_eye, eye, radius), [0, *(want + 1), 501])
    assert np.array_equal(hidden_point_removal(np.repeat(eye[None], 3, axis=0), eye, 1.0), [0, 1, 2])


@pytest.mark.parametrize("n", range(5))
def test_a_few_points_are_all_visible(n: int) -> None:
    points, eye = cloud("ball", n)
    assert np.array_equal(hidden_point_removal(points, eye, 100.0), np.arange(n))


def test_points_in_a_plane_or_line_with_the_eye() -> None:
    line = np.outer([3.0, 1.0, 2.0, -5.0, -4.0], [1.0, 2.0, 3.0])
    assert np.array_equal(hidden_point_removal(line, np.zeros(3), 1e3), [1, 4])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    rings = np.concatenate([2.0 * ring, ring]) @ turn
    assert np.array_equal(hidden_point_removal(rings, np.zeros(3), 10.0), np.arange(60, 120))
    assert np.array_equal(hidden_point_removal(np.ones((9, 3)), np.zeros(3), 10.0), [0])


@pytest.mark.parametrize(
    ("points", "eye", "radius", "words"),
    [
        (np.ones((4, 2)), np.zeros(3), 10.0, r"points: expected shape \(N, 3\)"),
        (np.full((4, 3), np.nan), np.zeros(3), 10.0, "points: expected finite values, got nan"),
        (np.ones((4, 3)), np.zeros(2), 10.0, r"viewpoint: expected shape \(3,\)"),
        (np.ones((4, 3)), [0, np.inf, 0], 10.0, "viewpoint: expected finite values"),
        (np.ones((4, 3)), np.zeros(3), 1.0, "radius: expected .* farthest point, 1.73205, got 1.0; remove outliers"),
        (np.ones((4, 3)), np.zeros(3), np.nan, "radius: expected a finite radius"),
        (np.zeros((0, 3)), np.zeros(3), -1.0, "radius: expected"),
        (np.ones((4, 3)), np.zeros(3), "far", "radius: expected a number, got 'far'"),
    ],
)
def test_what_makes_no_sense_is_refused(points, eye, radius, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        hidden_point_removal(points, eye, radius)
