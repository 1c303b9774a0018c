"""Views to begin with: upright, where a person may stand, with more to see than the usual view; kept by packages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsvis.color.sh import seen_sh_colors
from gsvis.package import PackageInfo
from gsvis.prepare.start_views import START_VIEWS, choose_start_views, describe_start_views
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.poses import describe_poses
from gsvis.scene.procedural import two_rooms
from gsvis.scene.view_sampling import ViewSampling


def rooms() -> tuple[Gaussians, NavigableSpace]:
    g = two_rooms(6_000).gaussians
    return g, NavigableSpace.from_scene(g, up="+z")


def seen(g: Gaussians, cameras: Cameras) -> list[int]:
    return [int((view_weights(g, cameras[c]).summed[0] >= 0.25).sum()) for c in range(len(cameras))]


def test_the_first_view_shows_more_than_most_and_all_stand_upright_and_apart() -> None:
    g, space = rooms()
    views = choose_start_views(g, space)
    assert views is not None
    assert 2 <= len(views) <= START_VIEWS
    frames = np.linalg.inv(views.viewmats)
    assert np.abs(frames[:, :3, 0] @ space.up).max() < 1e-6  # level from left to right
    assert (-frames[:, :3, 1] @ space.up).min() > 0.9
    assert space.contains(views.viewpoints).all()
    away = np.linalg.norm(views.viewpoints[:, None] - views.viewpoints[None], axis=2)
    assert away[~np.eye(len(views), dtype=bool)].min() > 0.3
    usual = ViewSampling(24, views.width, views.height, 80.0, seed=9).cameras(g, space)
    assert seen(g, views[0])[0] > np.median(seen(g, usual))


def test_an_object_is_whole_in_views_from_several_sides_that_aim_at_its_middle() -> None:
    rng = np.random.default_rng(0)
    means = rng.uniform([-0.3, -0.2, 0.0], [0.3, 0.2, 2.0], (800, 3))
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (800, 1))
    g = Gaussians(means, quats, np.full((800, 3), 0.05), np.full(800, 0.9), rng.random((800, 1, 3)))
    found = NavigableSpace.around(g, up="+z")
    space = replace(found, kind=replace(found.kind, kind="object"))
    views = choose_start_views(g, space)
    assert views is not None
    assert len(views) >= 3
    places = np.einsum("cij,nj->cni", views.viewmats[:, :3, :3], means) + views.viewmats[:, None, :3, 3]
    assert (np.abs(places[..., :2]) < np.tan(np.radians(30.0)) * places[..., 2:]).all()  # at 60 degrees
    reaches = [view["reach"] for view in describe_start_views(g, space)]
    middles = views.viewpoints + np.array(reaches)[:, None] * views.forwards
    assert np.abs(middles - [0.0, 0.0, 1.0]).max() < 0.05
    level = views.viewpoints[:, :2] / np.linalg.norm(views.viewpoints[:, :2], axis=1, keepdims=True)
    assert (level @ level.T)[~np.eye(len(views), dtype=bool)].max() < np.cos(np.radians(25.0))


def test_an_object_whose_colors_are_given_has_the_views_of_one_that_has_them() -> None:
    rng = np.random.default_rng(1)
    means = rng.uniform(-0.5, 0.5, (300, 3))
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (300, 1))
    shN = rng.normal(0.0, 0.5, (300, 3, 3))
    g = Gaussians(means, quats, np.full((300, 3), 0.05), np.full(300, 0.9), rng.random((300, 1, 3)), shN)
    found = NavigableSpace.around(g, up="+z")
    space = replace(found, kind=replace(found.kind, kind="object"))
    asked = []

    def colors_of(ids: np.ndarray, eye: np.ndarray) -> np.ndarray:
        asked.append(len(ids))
        return seen_sh_colors(g, ids, eye)

    assert describe_start_views(g.without_harmonics(), space, colors_of=colors_of) == describe_start_views(g, space)
    assert asked


def test_views_in_rooms_stand_off_the_walls_and_know_how_far_they_look() -> None:
    g, space = rooms()
    for view in describe_start_views(g, space, count=3):
        x, y, z = view["position"]
        assert 0.3 < x < 7.7
        assert 0.3 < y < 3.7
        assert 0.7 < z < 2.3
        assert 0.5 < view["reach"] < 9.0


def test_a_scene_without_room_has_none() -> None:
    g, space = rooms()
    solid = Gaussians(g.means[:1], g.quats[:1], np.full((1, 3), 50.0), [1.0], g.sh0[:1])
    assert choose_start_views(solid, space) is None
    assert describe_start_views(solid, space) == []
    assert describe_poses(None) == []


def test_poses_are_those_of_the_cameras() -> None:
    cameras = Cameras.look_at([[1.0, 2.0, 3.0]], [[1.0, 5.0, 3.0]], up=[0.0, 0.0, 1.0], width=8, height=6, fov=60.0)
    (view,) = describe_poses(cameras)
    assert view["position"] == [1.0, 2.0, 3.0]
    w, x, y, z = view["rotation"]
    ahead = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    np.testing.assert_allclose(ahead, [0.0, 1.0, 0.0], atol=1e-5)
    assert PackageInfo(provenance={"views": [view]}).provenance["views"] == [view]
