"""Cameras: where they look, what their rays cover, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.scene.cameras import Cameras, intrinsics

POINTS = st.tuples(*[st.floats(-10, 10)] * 3)


def project(cameras: Cameras, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, N, 2) pixels and (C, N) depths of (N, 3) world points."""
    local = np.einsum("cij,nj->cni", cameras.viewmats[:, :3, :3], points) + cameras.viewmats[:, None, :3, 3]
    pixels = np.einsum("cij,cnj->cni", cameras.Ks, local)
    return pixels[..., :2] / pixels[..., 2:], local[..., 2]


@given(eye=POINTS, target=POINTS)
def test_the_target_lies_on_the_principal_point_at_its_distance(
    eye: tuple[float, ...], target: tuple[float, ...]
) -> None:
    distance = float(np.linalg.norm(np.subtract(target, eye)))
    if distance < 1e-3:
        target = (eye[0], eye[1], eye[2] + 1.0)
        distance = float(np.linalg.norm(np.subtract(target, eye)))
    cameras = Cameras.look_at([eye], target, width=100, height=60)
    pixels, depths = project(cameras, np.array([target]))
    np.testing.assert_allclose(pixels[0, 0], [50, 30], atol=1e-6)
    np.testing.assert_allclose(depths[0, 0], distance, rtol=1e-9)
    np.testing.assert_allclose(cameras.viewpoints, [eye], atol=1e-9)
    np.testing.assert_allclose(cameras.forwards[0], np.subtract(target, eye) / distance, atol=1e-9)


def test_up_is_up_in_the_image() -> None:
    cameras = Cameras.look_at([[5, 0, 1]], [0, 0, 0])
    (low, high), _ = project(cameras, np.array([[0, 0, 0], [0, 0, 1.0]]))[0][0], None
    assert high[1] < low[1]
    assert high[0] == pytest.approx(low[0])
    (left, right), _ = project(cameras, np.array([[0, -1.0, 0], [0, 1.0, 0]]))[0][0], None
    assert left[0] < right[0]


def test_a_view_along_up_still_has_a_rigid_pose() -> None:
    cameras = Cameras.look_at([[0, 0, 5], [0, 0, -5]], [0, 0, 0])
    np.testing.assert_allclose(cameras.forwards, [[0, 0, -1], [0, 0, 1]])


def test_the_field_of_view_is_horizontal() -> None:
    k = intrinsics(200, 100, 90.0)
    np.testing.assert_allclose(k, [[100, 0, 100], [0, 100, 50], [0, 0, 1]])


def test_an_orbit_goes_round_its_center() -> None:
    cameras = Cameras.orbit([1, 2, 3], 4.0, 12, up=[0, -1, 0], elevation=30.0)
    offsets = cameras.viewpoints - [1, 2, 3]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 4.0)
    np.testing.assert_allclose(offsets[:, 1], -2.0)
    np.testing.assert_allclose(offsets.mean(axis=0), [0, -2, 0], atol=1e-12)
    np.testing.assert_allclose(cameras.forwards, -offsets / 4.0, atol=1e-12)
    steps = np.einsum("ci,ci->c", offsets, np.roll(offsets, 1, axis=0))
    np.testing.assert_allclose(steps, steps[0])


def test_cubemap_rays_belong_to_their_face_and_cover_the_sphere_evenly() -> None:
    size = 16
    viewpoints = np.array([[1.0, 2.0, 3.0], [-4.0, 0.0, 0.5]])
    cameras = Cameras.cubemap(viewpoints, size)
    assert len(cameras) == 12
    np.testing.assert_allclose(cameras.viewpoints, np.repeat(viewpoints, 6, axis=0), atol=1e-12)
    rays_o, rays_d = cameras.rays()
    np.testing.assert_allclose(rays_o, np.repeat(viewpoints, 6 * size * size, axis=0), atol=1e-12)
    faces = rays_d.reshape(2, 6, size * size, 3)
    axis = np.abs(faces).argmax(axis=-1)
    sign = np.take_along_axis(faces, axis[..., None], axis=-1)[..., 0] > 0
    np.testing.assert_array_equal(axis, np.broadcast_to(np.repeat([0, 1, 2], 2)[:, None], axis.shape))
    np.testing.assert_array_equal(sign, np.broadcast_to(np.tile([True, False], 3)[:, None], sign.shape))
    # A pixel's solid angle is close to its area times cos^3 of the angle from the face's axis.
    solid = np.abs(faces).max(axis=-1) ** 3 * (2.0 / size) ** 2
    np.testing.assert_allclose(solid.sum(axis=(1, 2)), 4 * np.pi, rtol=2e-3)
    np.testing.assert_allclose(np.einsum("vfp,vfpi->vi", solid, faces), 0, atol=1e-12)
    second = np.einsum("vfp,vfpi,vfpj->vij", solid, faces, faces)
    np.testing.assert_allclose(second, np.broadcast_to(4 * np.pi / 3 * np.eye(3), (2, 3, 3)), rtol=1e-2, atol=1e-12)


def test_rays_pass_through_the_centers_of_their_pixels() -> None:
    cameras = Cameras.orbit([0, 0, 0], 3.0, 2, width=7, height=5)
    rays_o, rays_d = cameras.rays()
    np.testing.assert_allclose(np.linalg.norm(rays_d, axis=1), 1)
    for i in range(2):
        part = slice(i * 35, (i + 1) * 35)
        pixels, depths = project(cameras[i], (rays_o + 2.5 * rays_d)[part])
        x, y = np.meshgrid(np.arange(7) + 0.5, np.arange(5) + 0.5)
        np.testing.assert_allclose(pixels[0], np.stack([x.ravel(), y.ravel()], axis=1), atol=1e-9)
        assert (depths > 0).all()


def test_resizing_samples_the_same_view() -> None:
    cameras = Cameras.orbit([0, 0, 0], 3.0, 2, width=8, height=6)
    small = cameras.resize(4, 3)
    points = np.random.default_rng(0).normal(size=(10, 3))
    np.testing.assert_allclose(project(small, points)[0], project(cameras, points)[0] / 2)
    assert (small.width, small.height, small.names) == (4, 3, cameras.names)


def test_arrays_are_read_only_and_the_callers_stay_their_own() -> None:
    viewmats, ks = np.tile(np.eye(4), (2, 1, 1)), np.tile(intrinsics(8, 6, 60.0), (2, 1, 1))
    cameras = Cameras(viewmats, ks, 8, 6, ["a", "b"])
    for array in (cameras.viewmats, cameras.Ks):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    assert viewmats.flags.writeable
    assert ks.flags.writeable
    assert repr(cameras) == "Cameras(2 of 8 x 6)"


def test_indexing_keeps_names_with_their_cameras() -> None:
    cameras = Cameras.orbit([0, 0, 0], 3.0, 5)
    for index in (slice(1, 3), [4, 0], np.arange(5) % 2 == 0, 2, -1):
        picked, where = cameras[index], np.atleast_1d(np.arange(5)[index])
        np.testing.assert_array_equal(picked.viewmats, cameras.viewmats[where])
        assert picked.names == tuple(cameras.names[i] for i in where)
    with pytest.raises(IndexError):
        cameras[5]


def test_no_camera_is_no_ray() -> None:
    none = Cameras(np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), 8, 6)
    assert [len(r) for r in none.rays()] == [0, 0]
    assert len(Cameras.cubemap(np.zeros((0, 3)), 4)) == 0


GOOD: dict[str, Any] = {"viewmats": np.eye(4)[None], "Ks": intrinsics(8, 6, 60.0)[None], "width": 8, "height": 6}
SHEAR = np.eye(4)[None] + np.eye(4, k=1)[None]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmats": np.eye(3)[None]}, r"viewmats: expected shape \(C, 4, 4\)"),
        ({"viewmats": SHEAR}, "viewmats: expected rotations"),
        ({"viewmats": np.diag([1.0, 1.0, -1.0, 1.0])[None]}, "viewmats: expected rotations"),
        ({"viewmats": np.full((1, 4, 4), np.nan)}, "viewmats: expected finite"),
        ({"viewmats": (np.eye(4) + np.eye(4, k=-3))[None]}, "viewmats: expected a last row of 0 0 0 1"),
        ({"Ks": np.zeros((1, 3, 3))}, "Ks: expected focal lengths > 0"),
        ({"Ks": np.eye(3)[None].repeat(2, axis=0)}, "viewmats / Ks: expected one length"),
        ({"width": 0}, "width: expected an integer of at least 1, got 0"),
        ({"height": 2.5}, "height: expected an integer"),
        ({"names": ["a", "b"]}, "names: expected 1 names"),
    ],
)
def test_a_bad_argument_names_itself(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match="^" + message):
        Cameras(**{**GOOD, **change})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Cameras.look_at([[0, 0, 0]], [0, 0, 0]), "eyes: expected eyes apart from their targets"),
        (lambda: Cameras.look_at([[0, 0, 0]], [np.nan, 0, 0]), "targets: expected finite"),
        (lambda: Cameras.look_at([[0, 0, 0]], [[1, 0, 0]] * 2), "targets: expected shape"),
        (lambda: Cameras.look_at([[0, 0, 0]], 5), "targets: expected shape"),
        (lambda: Cameras.look_at([0, 0, 0], [1, 0, 0]), "eyes: expected shape"),
        (lambda: Cameras.look_at([[0, 0, 0]], [1, 0, 0], up=[0, 0, 0]), "up: expected non-zero"),
        (lambda: Cameras.look_at([[0, 0, 0]], [1, 0, 0], up=[0, 1]), "up: expected shape"),
        (lambda: Cameras.look_at([[0, 0, 0]], [1, 0, 0], fov=180.0), "fov: expected degrees"),
        (lambda: Cameras.look_at([[0, 0, 0]], [1, 0, 0], width=0), "width: expected"),
        (lambda: Cameras.orbit([0, 0, 0], -1.0, 3), "radius: expected"),
        (lambda: Cameras.orbit([0, 0, 0], np.inf, 3), "radius: expected"),
        (lambda: Cameras.orbit([0, 0, 0], 1.0, 0), "count: expected"),
        (lambda: Cameras.orbit([0, 0, 0], 1.0, 3, elevation=90.0), "elevation: expected"),
        (lambda: Cameras.orbit([0, 0], 1.0, 3), "center: expected"),
        (lambda: Cameras.cubemap([0, 0, 0], 4), "viewpoints: expected"),
        (lambda: Cameras.cubemap([[0, 0, 0]], 0), "size: expected"),
        (lambda: Cameras.cubemap([[0, 0, 0]], 4).resize(0, 4), "width: expected"),
    ],
)
def test_a_bad_argument_of_a_constructor_names_itself(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match="^" + message):
        make()


@pytest.mark.realdata
def test_garden_cameras_are_valid_and_see_their_points(realdata: Any) -> None:
    with np.load(realdata / "scenes" / "formats" / "garden_points.npz") as data:
        cameras = Cameras(data["viewmats"], data["Ks"], int(data["width"]), int(data["height"]))
        pixels, depths = project(cameras, data["means3d"].astype(np.float64))
    assert len(cameras) == 3
    inside = (depths > 0) & (pixels > 0).all(axis=-1) & (pixels < [cameras.width, cameras.height]).all(axis=-1)
    assert (inside.mean(axis=1) > 0.4).all()
