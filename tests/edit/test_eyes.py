"""Eyes: rays begin where eyes are and run where they look; views are new ones where there are any."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.edit import EyesInSpace, EyesOfCameras
from gsvis.pvs import CertificateConfig, Certifier
from gsvis.pvs.look import Look
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.view_sampling import ViewSampling

FEW = ViewSampling(6, 32, 24, 90.0)


def ball(center: tuple[float, float, float] = (0.0, 0.0, 5.0)) -> Gaussians:
    return Gaussians([center], [[1, 0, 0, 0]], [[0.5, 0.5, 0.5]], [0.99], np.zeros((1, 1, 3)))


def row(count: int) -> Cameras:
    """Cameras on a line along x that look along +z."""
    eyes = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(float)
    return Cameras.look_at(eyes, eyes + np.array([0.0, 0.0, 1.0]), up=(0.0, -1.0, 0.0), width=40, height=30, fov=60.0)


def rays_of(eyes: EyesOfCameras, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    found = eyes._draw_rays(count, np.random.default_rng(0), None)
    assert found is not None
    return found


def test_rays_of_cameras_begin_at_them_and_run_through_their_images() -> None:
    cameras = row(3)
    rays_o, rays_d = rays_of(EyesOfCameras(cameras))
    assert set(np.round(rays_o[:, 0], 9)) == {0.0, 1.0, 2.0}
    np.testing.assert_allclose(np.linalg.norm(rays_d, axis=1), 1.0)
    x, y = (cameras.Ks[0, 0, 0] * rays_d[:, k] / rays_d[:, 2] + cameras.Ks[0, k, 2] for k in (0, 1))
    assert 0.0 <= x.min() < 1.0 < 39.0 < x.max() <= 40.0
    assert 0.0 <= y.min() < 1.0 < 29.0 < y.max() <= 30.0


def test_with_a_margin_eyes_fill_a_ball_around_the_camera() -> None:
    rays_o, _ = rays_of(EyesOfCameras(row(1), margin=0.5), 2000)
    away = np.linalg.norm(rays_o, axis=1)
    assert 0.49 < away.max() <= 0.5
    assert np.mean(away < 0.5 * 0.5 ** (1 / 3)) == pytest.approx(0.5, abs=0.05)  # half of the volume


def test_a_camera_sees_what_is_before_it_and_not_what_is_behind() -> None:
    for center, found in (((0.0, 0.0, 5.0), 1), ((0.0, 0.0, -5.0), 0)):
        (sight,) = EyesOfCameras(row(1)).iter_looks(Look(ball(center), "hybrid", 16, 1 / 255), 0)
        assert sight is not None
        assert len(sight[0]) == found


def test_a_camera_inside_something_solid_looks_but_a_place_beside_it_does_not() -> None:
    looks = list(EyesOfCameras(row(1), margin=1e-3).iter_looks(Look(ball((0.0, 0.0, 0.0)), "hybrid", 16, 1 / 255), 0))
    assert [each is None for each in looks] == [False, True]


def test_no_ray_can_begin_where_everything_is_solid() -> None:
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(ball((0.0, 0.0, 0.0)))))
    assert EyesOfCameras(row(1), margin=0.01).certify(certifier, [0], CertificateConfig(rays=8), 0, []) is None


def test_drawn_views_are_others_than_those_looked_from_where_there_are_any() -> None:
    cameras = row(20)
    some = EyesOfCameras(cameras, looks=10)
    assert not some.repeats
    assert some.count_looks() == 10
    drawn = some.draw_views(ball(), FEW)
    assert len(drawn) == 6
    assert {int(x) % 2 for x in np.rint(drawn.viewpoints[:, 0])} == {1}  # even ones were looked from
    every = EyesOfCameras(cameras)
    assert every.repeats
    assert len(every.draw_views(ball(), FEW)) == 6


def test_views_of_a_walk_are_poses_on_it() -> None:
    walk = HeadPath([0.0, 2.0], [[1, 1, 1], [3, 1, 1]], [[1, 0, 0, 0]] * 2)
    eyes = EyesInSpace(NavigableSpace.from_box((0, 0, 0), (4, 2, 2), 8), walk)
    views = eyes.draw_views(ball(), FEW)
    assert len(views) == 6
    np.testing.assert_allclose(views.viewpoints[:, 1:], 1.0)
    assert 1.0 < views.viewpoints[:, 0].min() < views.viewpoints[:, 0].max() < 3.0


def test_places_to_look_from_are_free_and_spread_over_the_space() -> None:
    space = NavigableSpace.from_box((0, 0, 0), (4, 2, 2), 8)
    eyes = EyesInSpace(space, boxes=4)
    assert space.contains(eyes.viewpoints).all()
    assert (np.ptp(eyes.viewpoints, axis=0) > (3.0, 1.0, 1.0)).all()


def test_a_walk_is_looked_from_itself_at_most_96_times() -> None:
    space = NavigableSpace.from_box((0, 0, 0), (4, 2, 2), 8)  # voxels of 0.5
    there = np.stack([np.linspace(0.1, 3.9, 400), np.ones(400), np.ones(400)], axis=1)
    walk = HeadPath(np.arange(800.0), np.concatenate([there, there[::-1]]), np.tile([1.0, 0, 0, 0], (800, 1)))
    places, alone = EyesInSpace(space, walk, boxes=1).viewpoints, EyesInSpace(space, boxes=1).viewpoints
    on_walk = places[: len(places) - len(alone)]
    assert len(on_walk) == 8  # there and back is the same way
    np.testing.assert_allclose(np.diff(on_walk[:, 0]), 0.5, atol=0.02)
    fine = NavigableSpace.from_box((0, 0, 0), (4, 2, 2), 128)  # the way has 121 of its voxels
    assert 48 < len(EyesInSpace(fine, walk, boxes=1).viewpoints) - 8 <= 96


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: EyesOfCameras(row(2)[:0]), "cameras: expected at least one"),
        (lambda: EyesOfCameras(row(1), margin=-1.0), "margin"),
        (lambda: EyesOfCameras(row(1), margin=np.nan), "margin"),
        (lambda: EyesOfCameras(row(1), looks=0), "looks"),
        (lambda: EyesInSpace(NavigableSpace.from_box((0, 0, 0), (1, 1, 1), 2), boxes=0), "boxes"),
    ],
)
def test_wrong_arguments_are_named(wrong, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wrong()
