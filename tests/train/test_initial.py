"""What training starts with: balls as large as their neighbors are far, or points where cameras look."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import SceneError
from gsvis.scene.cameras import Cameras
from gsvis.scene.points import PointCloud
from gsvis.train.initial import gaussians_from_points, random_points
from tests.train.photo_files import cloud


def test_a_grid_has_balls_of_its_step() -> None:
    step = 0.25
    grid = np.stack(np.meshgrid(*[np.arange(5) * step] * 3), axis=-1).reshape(-1, 3)
    start = gaussians_from_points(PointCloud(grid), sh_degree=3)
    np.testing.assert_allclose(start.scales, step, rtol=1e-6)  # three neighbors at one step, in the corners too
    np.testing.assert_array_equal(start.opacities, np.float32(0.1))
    np.testing.assert_array_equal(start.covars()[0], np.diag(start.scales[0].astype(np.float64) ** 2))
    assert start.sh_degree == 3
    assert not start.shN.any()


def test_scales_are_root_mean_squares_found_by_brute_force() -> None:
    points = cloud()
    apart = np.linalg.norm(points.means[:, None].astype(np.float64) - points.means[None], axis=2)
    near = np.sort(apart, axis=1)[:, 1:4]
    start = gaussians_from_points(points)
    np.testing.assert_allclose(start.scales[:, 0], np.sqrt((near**2).mean(axis=1)), rtol=1e-6)
    np.testing.assert_array_equal(start.means, points.means)
    np.testing.assert_allclose(0.5 + 0.28209479 * start.sh0[:, 0], points.colors, atol=1e-6)


@given(shift=st.integers(-100, 100), scale=st.sampled_from([1e-4, 0.5, 1.0, 3e3]), seed=st.integers(0, 99))
def test_scales_go_with_the_unit_and_the_order(shift: float, scale: float, seed: int) -> None:
    points = cloud()
    order = np.random.default_rng(seed).permutation(len(points))
    moved = PointCloud((points.means.astype(np.float64)[order] * scale + shift * scale), points.colors[order])
    want = gaussians_from_points(points).scales[order] * scale
    np.testing.assert_allclose(gaussians_from_points(moved).scales, want, rtol=1e-3)


def test_points_at_one_place_share_their_size_and_are_no_neighbors() -> None:
    twice = PointCloud(np.concatenate([cloud().means] * 2), np.concatenate([cloud().colors] * 2))
    once = gaussians_from_points(cloud())
    np.testing.assert_array_equal(gaussians_from_points(twice).scales, np.concatenate([once.scales] * 2))


@pytest.mark.parametrize("count", [2, 3])
def test_few_points_take_the_neighbors_there_are(count: int) -> None:
    start = gaussians_from_points(PointCloud(np.eye(3)[:count]))
    np.testing.assert_allclose(start.scales, np.sqrt(2.0), rtol=1e-6)


def test_what_has_no_size_is_refused() -> None:
    for points in (np.zeros((0, 3)), np.zeros((1, 3)), np.ones((9, 3))):
        with pytest.raises(ValueError, match="points: expected points at 2 places or more"):
            gaussians_from_points(PointCloud(points))
    with pytest.raises(ValueError, match="sh_degree"):
        gaussians_from_points(cloud(), sh_degree=4)


@pytest.mark.parametrize("kind", ["orbit", "inside out", "one", "forward"])
def test_random_points_are_seen(kind: str) -> None:
    made = {
        "orbit": lambda: Cameras.orbit((1.0, 2.0, 3.0), 2.0, 6),
        "inside out": lambda: Cameras.cubemap([[5.0, 0.0, 0.0]], 32),
        "one": lambda: Cameras.look_at([[0.0, 0.0, 0.0]], (1.0, 0.0, 0.0)),
        "forward": lambda: Cameras.look_at([[0.0, y, 0.0] for y in (0, 1, 2)], [[9.0, y, 0.0] for y in (0, 1, 2)]),
    }
    cameras = made[kind]()
    points = random_points(cameras, 200, np.random.default_rng(0))
    assert len(points) == 200
    assert (points.colors == 0.5).all()
    local = np.einsum("cij,nj->cni", cameras.viewmats[:, :3, :3], points.means) + cameras.viewmats[:, None, :3, 3]
    pixels = np.einsum("cij,cnj->cni", cameras.Ks, local)
    at = pixels[..., :2] / pixels[..., 2:]
    inside = (local[..., 2] > 0) & (at >= -0.01).all(-1) & (at <= (cameras.width + 0.01, cameras.height + 0.01)).all(-1)
    assert inside.any(axis=0).all()
    again = random_points(cameras, 200, np.random.default_rng(0))
    np.testing.assert_array_equal(again.means, points.means)


def test_an_orbit_gets_points_about_its_middle() -> None:
    points = random_points(Cameras.orbit((1.0, 2.0, 3.0), 2.0, 12), 5000, np.random.default_rng(0))
    np.testing.assert_allclose(points.means.mean(axis=0), (1.0, 2.0, 3.0), atol=0.3)
    assert np.abs(points.means - (1.0, 2.0, 3.0)).max() < 6.0


def test_cameras_that_see_nothing_are_refused() -> None:
    fine = Cameras.look_at([[0.0, 0.0, 0.0]], (1.0, 0.0, 0.0), width=4, height=4)
    narrow = Cameras(fine.viewmats, fine.Ks * [[1e9], [1e9], [1.0]], 4, 4)
    with pytest.raises(SceneError, match="check their poses"):
        random_points(narrow, 3, np.random.default_rng(0))
    with pytest.raises(ValueError, match="count"):
        random_points(fine, 0, np.random.default_rng(0))
    with pytest.raises(ValueError, match="cameras"):
        random_points(fine[[]], 1, np.random.default_rng(0))
