"""The 80 faces, sets gathered and traced, fractions and their distribution."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.raycast import EllipsoidProxies, Tracer, visible_in
from gsvis.raycast import directions as dirs
from gsvis.raycast._kernels.directions import first_free
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from tests.raycast.scenes import scene


def test_face_of_gives_the_triangle_that_holds_the_direction() -> None:
    d = np.random.default_rng(0).normal(size=(20_000, 3))
    corners = dirs.icosphere_faces()[dirs.face_of(d)]
    sides = np.cross(corners, np.roll(corners, -1, axis=1))
    assert (np.einsum("nki,ni->nk", sides, d) > -1e-12).all()


@pytest.mark.parametrize("rays_per_face", [1, 4, 16, 64])
def test_spread_directions_lie_in_their_face(rays_per_face: int) -> None:
    d = dirs.face_directions(rays_per_face)
    assert d.shape == (80, rays_per_face, 3)
    np.testing.assert_array_equal(dirs.face_of(d.reshape(-1, 3)), np.repeat(np.arange(80), rays_per_face))


def test_corners_and_edges_belong_to_one_of_their_faces() -> None:
    faces = dirs.icosphere_faces()
    for points in (faces, 0.5 * (faces + np.roll(faces, 1, axis=1))):
        got = dirs.face_of(points.reshape(-1, 3))
        assert ((got >= 0) & (got < 80)).all()
        touch = np.abs(faces[got][:, :, None] - points.reshape(-1, 1, 1, 3)).max(axis=3) < 1e-9
        edge = points is not faces
        assert edge or touch.any(axis=(1, 2)).all()


@given(st.lists(st.integers(0, 79), max_size=80, unique=True))
def test_fractions_count_bits(faces: list[int]) -> None:
    bits = np.zeros((1, 80), np.uint8)
    bits[0, faces] = 1
    sets = np.packbits(bits, axis=1, bitorder="little")
    assert dirs.direction_fractions(sets)[0] == np.float32(len(faces) / 80)
    cdf = dirs.direction_cdf(dirs.direction_fractions(sets))
    np.testing.assert_array_equal(cdf, np.arange(81) >= len(faces))
    assert dirs.jaccard(sets, sets)[0] == 1.0
    assert dirs.jaccard(sets, ~sets)[0] == 0.0


def test_seen_directions_are_the_faces_towards_the_eyes_that_see() -> None:
    g = scene("blobs", n=50)
    eyes = np.random.default_rng(3).normal(scale=3.0, size=(40, 3))
    weights = np.random.default_rng(4).uniform(0, 1, (40, 50)).astype(np.float32)
    sets = dirs.seen_directions(g, weights, eyes, tau=0.5)
    want = np.zeros((50, 80), bool)
    for v, eye in enumerate(eyes):
        faces = dirs.face_of(eye - g.means)
        want[np.arange(50), faces] |= weights[v] >= 0.5
    np.testing.assert_array_equal(np.unpackbits(sets, axis=1, bitorder="little").astype(bool), want)
    halves = dirs.seen_directions(g, weights[:9], eyes[:9], 0.5) | dirs.seen_directions(g, weights[9:], eyes[9:], 0.5)
    np.testing.assert_array_equal(halves, sets)


def test_sets_from_cameras_join_what_each_camera_sees() -> None:
    tracer = Tracer(EllipsoidProxies.from_scene(scene("mixed")))
    views = Cameras.orbit([0, 0, 0], 3.0, 5, width=20, height=20)
    want = dirs.seen_directions(tracer.proxies.gaussians, visible_in(tracer, views), views.viewpoints)
    np.testing.assert_array_equal(dirs.directions_from_cameras(tracer, views), want)


def lone_gaussian() -> tuple[Tracer, NavigableSpace]:
    g = Gaussians([[0, 0, 0.0]], [[1, 0, 0, 0]], [[0.05] * 3], [0.9], np.zeros((1, 1, 3)))
    return Tracer(EllipsoidProxies.from_scene(g)), NavigableSpace.from_box([-1, -1, -1], [1, 1, 1], 16)


def test_a_lone_gaussian_is_seen_from_everywhere() -> None:
    tracer, box = lone_gaussian()
    assert dirs.direction_fractions(dirs.trace_directions(tracer, box)).tolist() == [1.0]


def test_above_a_floor_is_half_of_all_directions() -> None:
    x, y = np.meshgrid(np.linspace(-3, 3, 121), np.linspace(-3, 3, 121))
    floor = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    n = len(floor) + 1
    means = np.concatenate([floor, [[0.013, 0.017, 0.012]]])
    scales = np.tile([0.05, 0.05, 1e-4], (n, 1))
    scales[-1] = 0.002
    opacities = np.full(n, 0.99)
    g = Gaussians(means, np.tile([1.0, 0, 0, 0], (n, 1)), scales, opacities, np.zeros((n, 1, 3)))
    navigable = NavigableSpace.from_box([-1, -1, -1], [1, 1, 1], 40)  # both sides: the floor must do the hiding
    sets = dirs.trace_directions(Tracer(EllipsoidProxies.from_scene(g)), navigable, ids=[n - 1])
    seen = np.unpackbits(sets, axis=1, bitorder="little")[0].astype(bool)
    up = dirs.face_directions(1)[:, 0, 2]
    free = navigable.contains([[0.013, 0.017, 0.012]])[0]
    assert free  # every eye is close by, above the floor or right through it
    assert seen[up > 0.05].all()
    thin = NavigableSpace.from_box([-1, -1, -1], [1, 1, -0.5], 40)
    assert not dirs.trace_directions(Tracer(EllipsoidProxies.from_scene(g)), thin, ids=[n - 1]).any()
    above = NavigableSpace.from_box([-1, -1, 0.5], [1, 1, 1], 40)
    sets = dirs.trace_directions(Tracer(EllipsoidProxies.from_scene(g)), above, ids=[n - 1], rays_per_face=16)
    seen = np.unpackbits(sets, axis=1, bitorder="little")[0].astype(bool)
    assert seen[up > 0.8].all()
    assert not seen[up < 0.0].any()


def test_more_rays_a_face_never_lose_a_face() -> None:
    tracer = Tracer(EllipsoidProxies.from_scene(scene("mixed")))
    box = NavigableSpace.from_box([-3, -3, 1.5], [3, 3, 3], 24)
    coarse = dirs.trace_directions(tracer, box, rays_per_face=1)
    fine = dirs.trace_directions(tracer, box, rays_per_face=4)
    assert not (coarse & ~fine).any()  # the middle part of a face has the same center


def test_traced_and_gathered_agree_where_eyes_are_dense() -> None:
    tracer = Tracer(EllipsoidProxies.from_scene(scene("blobs", n=60)))
    box = NavigableSpace.from_box([-4, -4, 2.0], [4, 4, 4], 32)
    eyes = box.sample_viewpoints(400, np.random.default_rng(0))
    from gsvis.raycast import GaussianRays, visible_from

    weights = visible_from(tracer, eyes, sampling="gaussians", rays=GaussianRays())
    gathered = dirs.seen_directions(tracer.proxies.gaussians, weights, eyes)
    traced = dirs.trace_directions(tracer, box, rays_per_face=16)
    assert dirs.jaccard(gathered, traced).mean() > 0.7


def test_solid_angles_of_a_lone_gaussian_and_of_half_a_world() -> None:
    tracer, box = lone_gaussian()
    for rays_per_face in (1, 4, 16, 64):
        np.testing.assert_allclose(
            dirs.solid_angle_fractions(tracer, box, rays_per_face=rays_per_face), [1.0], rtol=1e-6
        )
    above = NavigableSpace.from_box([-50, -50, 0.2], [50, 50, 1.2], 100)  # eyes in a slab overhead
    half = dirs.solid_angle_fractions(tracer, above, rays_per_face=64)
    np.testing.assert_allclose(half, [0.5], atol=0.03)


def test_solid_angle_never_exceeds_the_faces_that_hold_it() -> None:
    tracer = Tracer(EllipsoidProxies.from_scene(scene("mixed")))
    box = NavigableSpace.from_box([-3, -3, 1.5], [3, 3, 3], 24)
    faces = dirs.direction_fractions(dirs.trace_directions(tracer, box, rays_per_face=16))
    angle = dirs.solid_angle_fractions(tracer, box, rays_per_face=16)
    assert (angle <= 1.1 * faces + 1e-6).all()  # faces differ in size by a tenth
    assert ((angle > 0) == (faces > 0)).all()
    np.testing.assert_array_equal(dirs.solid_angle_fractions(tracer, box, ids=[3, 1], rays_per_face=16), angle[[3, 1]])


def test_ids_choose_and_order() -> None:
    tracer = Tracer(EllipsoidProxies.from_scene(scene("mixed")))
    box = NavigableSpace.from_box([-3, -3, 1.5], [3, 3, 3], 24)
    whole = dirs.trace_directions(tracer, box)
    np.testing.assert_array_equal(dirs.trace_directions(tracer, box, ids=[7, 3, 200]), whole[[7, 3, 200]])
    assert dirs.trace_directions(tracer, box, ids=[]).shape == (0, 10)


@given(st.integers(0, 10_000))
def test_the_grid_walk_meets_the_first_free_voxel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    free = rng.uniform(size=(5, 6, 7)) < 0.1
    start, d = rng.uniform(-0.5, 1.5, 3) * [5, 6, 7], rng.normal(size=3)
    if seed % 4 == 0:
        d[seed % 3] = 0.0
    d /= np.linalg.norm(d)
    eye = np.empty(3)
    found = first_free(start, d, free, np.zeros(3), 1.0, eye)
    t = np.linspace(0, 25, 25_001)
    cells = np.floor(start + t[:, None] * d).astype(int)
    inside = ((cells >= 0) & (cells < free.shape)).all(axis=1)
    hits = np.zeros(len(t), bool)
    hits[inside] = free[tuple(cells[inside].T)]
    if found:
        cell = np.floor(eye).astype(int)
        assert free[tuple(cell)]
        at = float((eye - start) @ d)
        np.testing.assert_allclose(start + at * d, eye, atol=1e-9)
        first = t[hits][0] if hits.any() else np.inf
        assert at <= first + 2.0
        assert first >= at - 2.0
    else:
        assert not hits.any()


def test_progress_goes_from_nothing_to_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dirs, "_CHUNK", 100)
    tracer = Tracer(EllipsoidProxies.from_scene(scene("mixed")))
    box, n = NavigableSpace.from_box([-3, -3, 1.5], [3, 3, 3], 24), len(tracer.proxies.gaussians)
    calls: list[tuple[str, int, int]] = []

    def progress(*call: object) -> None:
        calls.append(call)  # type: ignore[arg-type]

    dirs.directions_from_cameras(tracer, Cameras.orbit([0, 0, 0], 3.0, 3, width=8, height=8), progress=progress)
    assert calls == [("cameras", k, 3) for k in range(4)]
    calls.clear()
    sets = dirs.trace_directions(tracer, box, progress=progress)
    assert calls == [("directions", k, n) for k in range(0, n + 1, 100)]
    assert n == 300
    calls.clear()
    dirs.solid_angle_fractions(tracer, box, rays_per_face=4, progress=progress)
    assert calls == [("directions", k, 4) for k in range(5)]
    monkeypatch.undo()
    np.testing.assert_array_equal(dirs.trace_directions(tracer, box), sets)  # pieces change nothing


def test_refusals_name_the_argument() -> None:
    tracer, box = lone_gaussian()
    with pytest.raises(ValueError, match=r"^ids: expected values in \[0, 1\)"):
        dirs.trace_directions(tracer, box, ids=[1])
    with pytest.raises(ValueError, match=r"^rays_per_face: expected 1, 4, 16 or 64, got 2"):
        dirs.face_directions(2)
    with pytest.raises(ValueError, match=r"^directions: expected non-zero"):
        dirs.face_of([[0, 0, 0]])
    for shape, kind in (((3, 9), "u1"), ((3, 11), "u1"), ((10,), "u1"), ((3, 10, 1), "u1"), ((3, 10), "i8")):
        with pytest.raises(ValueError, match=r"^sets: expected \(N, 10\) uint8"):
            dirs.direction_fractions(np.zeros(shape, kind))
    with pytest.raises(ValueError, match=r"^left / right: expected one length"):
        dirs.jaccard(np.zeros((3, 10), np.uint8), np.zeros((1, 10), np.uint8))
    with pytest.raises(ValueError, match=r"^fractions: expected at least one"):
        dirs.direction_cdf([])
