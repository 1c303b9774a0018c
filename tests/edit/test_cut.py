"""Cuts: scenes whose visibility is known, laws of order and seed, and the guard of held-out views."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gsvis.edit import Cut, CutConfig, EyesInSpace, EyesOfCameras, cut
from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OccluderScene, nested_shells
from gsvis.scene.view_sampling import ViewSampling

QUICK = CutConfig(size=48, rays=1024, max_stages=4, limit=0.01, views=ViewSampling(3, 48, 36, 90.0))
BARE = replace(QUICK, views=replace(QUICK.views, count=0))


@cache
def shells() -> OccluderScene:
    return nested_shells(2500, sh_degree=0)


def near(eye: np.ndarray, side: float = 0.05) -> NavigableSpace:
    return NavigableSpace.from_box(eye - side, eye + side, 6)


@cache
def between() -> Cut:
    """What eyes between the outer two of three closed shells see."""
    return cut(shells().gaussians, EyesInSpace(near(shells().viewpoints[0]), boxes=1), QUICK)


def radius() -> np.ndarray:
    return np.asarray(np.linalg.norm(shells().gaussians.means, axis=1))


def test_what_a_closed_shell_hides_is_gone_and_what_is_certainly_visible_is_kept() -> None:
    found = between()
    assert np.mean(found.kept[radius() < 1.5]) < 0.01  # the hull accepts a few in doubt
    assert np.mean(found.kept[shells().visible[0]]) > 0.995
    outer = found.kept[radius() > 2.5]
    assert 0.3 < outer.mean() < 0.9  # the shell in the middle hides a part


def test_the_certificate_and_the_views_say_that_little_is_missing() -> None:
    found = between()
    assert found.missed <= found.bound <= 0.01
    assert found.rays >= 1024
    assert (found.looks, found.buried) == (8, 0)
    assert found.held_out is not None
    assert found.held_out.psnr.min() > 45.0
    assert found.held_out.fresh
    assert found.check is None or found.check.agreeing == found.check.rays


def test_weights_are_those_of_what_is_kept() -> None:
    found = between()
    assert np.array_equal(found.kept, found.weights > 0.0)
    assert found.weights[found.kept].min() >= 0.25 / 255.0
    assert found.weights.max() <= 1.0


def test_the_order_of_the_scene_does_not_matter() -> None:
    g = shells().gaussians
    order = np.random.default_rng(1).permutation(len(g))
    eyes = EyesInSpace(near(shells().viewpoints[0]), boxes=1)
    moved, still = cut(g[order], eyes, BARE), cut(g, eyes, BARE)
    assert np.array_equal(moved.kept, still.kept[order])
    assert moved.bound == still.bound


def test_the_same_seed_gives_the_same_cut_and_another_other_rays() -> None:
    eyes = EyesInSpace(near(shells().viewpoints[0]), boxes=1)
    one, same, other = (cut(shells().gaussians, eyes, replace(BARE, seed=seed)) for seed in (0, 0, 1))
    assert np.array_equal(one.weights, same.weights)
    assert not np.array_equal(one.certificates[0].weights, other.certificates[0].weights)


def cameras(count: int = 2) -> Cameras:
    """Cameras between the outer shells that look outward, away from the others."""
    eye = shells().viewpoints[0]
    return Cameras.look_at(np.repeat(eye[None], count, axis=0), 2.0 * eye, width=48, height=36, fov=50.0)


def test_cameras_keep_what_they_show_and_nothing_behind_them() -> None:
    g, view = shells().gaussians, cameras(1)
    found = cut(g, EyesOfCameras(view), QUICK)
    depth = (g.means - view.viewpoints) @ view.forwards[0]
    assert 0 < len(found) < 0.25 * len(g)
    assert depth[found.kept].min() > 0.0
    assert found.held_out is not None
    assert not found.held_out.fresh
    assert found.held_out.psnr.min() > 45.0


def test_a_margin_keeps_more() -> None:
    g = shells().gaussians
    alone, wide = (cut(g, EyesOfCameras(cameras(), margin), BARE) for margin in (0.0, 0.3))
    assert wide.kept[alone.kept].mean() > 0.99
    assert len(wide) > 1.1 * len(alone)


class Elsewhere(EyesInSpace):
    """Eyes between the shells whose views are drawn outside of all, so that the first ones are bad."""

    def draw_views(self, g: Gaussians, sampling: ViewSampling) -> Cameras:
        rng = np.random.default_rng(sampling.stream)
        outside = shells().viewpoints[3] + 0.1 * rng.random((sampling.count, 3))
        return Cameras.look_at(outside, np.zeros(3), width=48, height=36, fov=50.0)


def test_what_bad_views_lack_is_added() -> None:
    g, eyes = shells().gaussians, Elsewhere(near(shells().viewpoints[0]), boxes=1)
    before, after = (cut(g, eyes, replace(QUICK, rounds=rounds)) for rounds in (1, 4))
    assert before.held_out is not None
    assert after.held_out is not None
    assert before.held_out.psnr.min() < 20.0
    assert after.held_out.psnr.min() > 45.0
    assert 1 < after.held_out.rounds <= 4
    assert before.held_out.added == 0
    assert after.held_out.added == len(after) - len(before) > 0
    assert after.kept[before.kept].all()


def test_eyes_that_see_nothing_and_eyes_without_a_place_are_refused() -> None:
    g, eye = shells().gaussians, np.array([8.0, 0.0, 0.0])
    away = Cameras.look_at(eye[None], 2.0 * eye, width=16, height=12)
    with pytest.raises(SceneError, match="everything would go"):
        cut(g, EyesOfCameras(away), BARE)
    solid = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[9, 9, 9]], [0.99], np.zeros((1, 1, 3)))
    with pytest.raises(SceneError, match="inside something solid"):
        cut(solid, EyesInSpace(near(np.zeros(3)), boxes=1), BARE)


def test_progress_begins_and_ends_every_stage() -> None:
    seen: dict[str, list[tuple[int, int]]] = {}

    def report(stage: str, done: int, total: int) -> None:
        seen.setdefault(stage, []).append((done, total))

    progress: Progress = report
    cut(shells().gaussians, EyesOfCameras(cameras()), QUICK, progress=progress)
    assert list(seen) == ["structure", "viewpoints", "certificate", "held_out"]
    for steps in seen.values():
        assert steps[0][0] == 0
        assert steps[-1][0] == steps[-1][1]
        assert steps == sorted(steps)
    silent("", 0, 1)


def test_the_document_holds_plain_numbers() -> None:
    document = between().as_dict()
    assert document["gaussians_out"] == len(between())
    assert document["certificate"]["bound"] == between().bound
    assert document["held_out"]["worst_psnr"] > 45.0


@pytest.mark.parametrize(
    "wrong",
    [{"tau": 0.0}, {"limit": 0.0}, {"size": 3}, {"rays": 0}, {"rounds": 0}, {"min_psnr": 101.0}, {"max_stages": 0}],
)
def test_wrong_options_are_named(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        CutConfig(**wrong)
