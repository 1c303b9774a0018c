"""The picture of where people stand: a plan is seen along up, whatever direction that is; equal scenes, equal bytes."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from gsvis.report.places import Places, Reading, draw_places
from gsvis.report.plan import Plan, nice_length
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from tests.scene.places import box, discs

UPS = np.array([[0, 0, 1.0], [0, -1, 0], [0.1, -0.98, 0.17], [-0.6, 0.0, 0.8]])


def scene() -> Gaussians:
    return box((-2, -2, 0), (2, 2, 2), 0.25)


def space_of(up: np.ndarray, kind: str = "rooms") -> NavigableSpace:
    unit = up / np.linalg.norm(up)
    free = np.ones((4, 4, 4), bool)
    return NavigableSpace(np.array([-1.0, -1, 0.5]), 0.5, free, unit, kind=SpaceKind(kind, ""))  # type: ignore[arg-type]


@pytest.mark.parametrize("up", UPS)
def test_what_lies_above_each_other_is_one_place_of_a_plan(up: np.ndarray) -> None:
    space = space_of(up)
    plan = Plan.over(scene(), space, 300)
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert np.allclose(plan.places(points), plan.places(points + 3.0 * space.up), atol=1e-9)
    across = np.cross(space.up, [0.3, 0.5, 0.7])
    across /= np.linalg.norm(across)
    moved = plan.places(points + across) - plan.places(points)
    assert np.allclose(np.linalg.norm(moved, axis=1), plan.pixels / plan.side)  # lengths along the ground are kept
    assert np.allclose(np.cross(plan.right, plan.onward), space.up)  # no mirror image


@pytest.mark.parametrize("up", UPS)
def test_all_eyes_and_all_that_is_given_lie_on_the_plan(up: np.ndarray) -> None:
    more = np.array([[9.0, -7.0, 4.0]])
    plan = Plan.over(scene(), space_of(up), 300, more=more)
    eyes = space_of(up).sample_viewpoints(100, np.random.default_rng(0))
    places = plan.places(np.concatenate([eyes, more]))
    assert np.all((places > 0) & (places < 300))
    assert plan.covered(space_of(up)).any()


def test_outliers_do_not_set_the_size_of_a_plan() -> None:
    far = discs(np.random.default_rng(0).normal(size=(400, 3)) * 5000.0, (0.1, 0.1, 0.1))
    plain, flown = (Plan.over(g, space_of(UPS[0]), 300) for g in (scene(), Gaussians.concatenate([scene(), far])))
    assert flown.side < 2.5 * plain.side


def test_rooms_are_cut_open_and_objects_are_not() -> None:
    g = scene()
    colors = np.where(g.means[:, 2:] > 1.9, 2.0, 0.0) * np.ones((1, 3))  # a white ceiling over a gray floor
    g = replace(g, sh0=colors[:, None, :].astype(np.float32))
    middle = [Plan.over(g, space_of(UPS[0], kind), 100).draw(g, (0, 0, 0))[50, 50] for kind in ("rooms", "object")]
    assert middle[0].max() < 0.7 < middle[1].min()


def test_round_lengths() -> None:
    assert [nice_length(each) for each in (1.0, 1.99, 4.9, 0.0077, 3e6)] == [1.0, 1.0, 2.0, 0.005, 2e6]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_picture_holds_a_view_of_each_reading(count: int) -> None:
    g = scene()
    view = Cameras.look_at([[0.5, 0.5, 1.0]], [[2.0, 1.0, 1.0]])
    readings = tuple(Reading(f"reading {k}", space_of(UPS[k]), None if k == 2 else view) for k in range(count))
    walk = np.array([[0.0, 0, 1], [1, 0, 1]])
    places = Places("A title", ("a line",), readings, space_of(UPS[0]), cameras=walk, walk=walk)
    png = draw_places(g, places)
    assert png == draw_places(g, places)
    with Image.open(io.BytesIO(png)) as image:
        assert image.size[0] == 1280
        assert 600 < image.size[1] < 1400
        assert image.info["Software"] == "gsvis"
