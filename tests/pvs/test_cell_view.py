"""What one cell sees: right on scenes whose visibility is known, by every method, and monotone in what it should be."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.errors import SceneError
from gsvis.pvs import PvsConfig
from gsvis.pvs.cell_view import see_cell
from gsvis.pvs.look import METHODS, Look
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import OccluderScene, box_in_room, nested_shells, random_scene, two_rooms, wall_with_hole
from gsvis.scene.solid import buried

MAKERS = {"wall": wall_with_hole, "box": box_in_room, "rooms": two_rooms, "shells": nested_shells}
SIZES = {"hybrid": 384, "raster": 384, "raycast": 64}
# Splats are flat and ordered by their centers, so surfaces must be of many; small Gaussians fall between coarse rays,
# so there they must be of few.
COUNTS = {"hybrid": 20_000, "raster": 20_000, "raycast": 1200}
LOOKS: dict[tuple[str, str], tuple[OccluderScene, Look]] = {}


def looked(name: str, method: str) -> tuple[OccluderScene, Look]:
    """A closed-form scene and a look at it by a method; made once."""
    if (name, method) not in LOOKS:
        scene = MAKERS[name](COUNTS[method], sh_degree=0)
        LOOKS[name, method] = scene, Look(scene.gaussians, method, SIZES[method], 1 / 255)
    return LOOKS[name, method]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", MAKERS)
def test_no_visible_gaussian_is_missing_and_none_behind_a_wall_is_kept(name: str, method: str) -> None:
    scene, look = looked(name, method)
    config = PvsConfig(method=method, size=SIZES[method])
    missing, visible = 0, 0
    for eye, shown, hidden in zip(scene.viewpoints[:2], scene.visible, scene.hidden, strict=False):
        seen = see_cell(look, eye[None], config)
        mask = np.zeros(len(scene.gaussians), bool)
        mask[seen.ids] = True
        assert seen.viewpoints == 1
        assert not (hidden & mask).any(), f"kept {np.count_nonzero(hidden & mask)}"
        missing += np.count_nonzero(shown & ~mask)
        visible += np.count_nonzero(shown)
    # Seams of walls seen edge on: splats are ordered by their centers there, rays by where they are densest.
    assert missing <= (0.003 * visible if name == "rooms" else 0)


@pytest.mark.parametrize("method", METHODS)
def test_more_viewpoints_never_shrink_a_set_nor_lower_a_class(method: str) -> None:
    scene, look = looked("rooms", method)
    config = PvsConfig(method=method, size=SIZES[method], growth=0.0, patience=99, min_viewpoints=1)
    eyes = scene.navigable.sample_viewpoints(5, np.random.default_rng(1))
    before: dict[int, int] = {}
    for count in range(1, len(eyes) + 1):
        seen = see_cell(look, eyes, replace(config, max_viewpoints=count))
        now = dict(zip(seen.ids.tolist(), seen.classes.tolist(), strict=True))
        assert seen.viewpoints == count
        assert all(now.get(gaussian, -1) >= level for gaussian, level in before.items())
        before = now


@pytest.mark.parametrize("method", ["hybrid", "raster"])
@given(st.integers(0, 1000))
@settings(max_examples=12)
def test_a_bigger_opacity_in_front_never_enlarges_what_is_seen_behind(method: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    behind = random_scene(rng, 60)
    sheet = np.stack([rng.uniform(-3, 3, 8), rng.uniform(-3, 3, 8), np.full(8, -6.0)], axis=1)
    eye = np.array([0.0, 0.0, -9.0])
    found = []
    for opacity in (0.2, 0.6, 0.95):
        front = Gaussians(
            sheet, np.tile([1.0, 0, 0, 0], (8, 1)), np.full((8, 3), 0.5), np.full(8, opacity), np.zeros((8, 1, 3))
        )
        g = Gaussians.concatenate([behind, front])
        ids, weights = Look(g, method, 48, 1 / 255)(eye)
        largest = np.zeros(len(g))
        largest[ids] = weights
        found.append(largest[:60])
    for more, less in pairwise(found):
        assert (less <= more + 1e-5).all()


def test_an_eye_in_something_opaque_is_left_out() -> None:
    ball = Gaussians([[0, 0, 0], [5, 0, 0]], [[1, 0, 0, 0]] * 2, [[0.5] * 3] * 2, [0.9, 0.9], np.zeros((2, 1, 3)))
    inside, outside = np.array([[0.1, 0.0, 0.0]]), np.array([[2.5, 0.0, 0.0]])
    assert buried(ball, np.concatenate([inside, outside])).tolist() == [True, False]
    assert buried(ball, np.zeros((0, 3))).tolist() == []
    look = Look(ball, "hybrid", 16, 1 / 255)
    assert see_cell(look, inside, PvsConfig()).viewpoints == 0
    assert len(see_cell(look, inside, PvsConfig()).ids) == 0
    both = see_cell(look, np.concatenate([inside, outside]), PvsConfig())
    assert both.viewpoints == 1
    assert both.ids.tolist() == [0, 1]


def test_directions_point_to_the_eyes() -> None:
    from gsvis.raycast import directions

    scene, look = looked("box", "hybrid")
    eye = scene.viewpoints[0]
    seen = see_cell(look, eye[None], PvsConfig(size=SIZES["hybrid"]))
    bits = np.unpackbits(seen.directions, axis=1, bitorder="little")
    assert (bits.sum(axis=1) == 1).all()
    expected = directions.face_of(eye - scene.gaussians.means[seen.ids])
    assert np.array_equal(bits.argmax(axis=1), expected)


def test_classes_are_those_of_the_largest_weight() -> None:
    scene, look = looked("rooms", "hybrid")
    config = PvsConfig(size=SIZES["hybrid"], min_viewpoints=1, max_viewpoints=3, growth=0.0, patience=9)
    eyes = scene.navigable.sample_viewpoints(3, np.random.default_rng(2))
    seen = see_cell(look, eyes, config)
    largest = np.zeros(len(scene.gaussians), np.float32)
    for eye in eyes:
        ids, weights = look(eye)
        largest[ids] = np.maximum(largest[ids], weights)
    assert np.array_equal(seen.ids, np.flatnonzero(largest >= np.float32(config.tau)))
    edges = [*config.class_edges, np.inf]
    for level in range(len(config.class_edges)):
        weights = largest[seen.ids[seen.classes == level]]
        assert (weights >= np.float32(edges[level])).all()
        assert (weights < np.float32(edges[level + 1])).all()


def test_a_cell_is_done_when_its_set_has_stopped_growing() -> None:
    scene = two_rooms(1200, sh_degree=0)
    look = Look(scene.gaussians, "hybrid", 16, 1 / 255)
    eyes = np.tile(scene.viewpoints[0], (30, 1))
    assert see_cell(look, eyes, PvsConfig(min_viewpoints=1, patience=2)).viewpoints == 3
    assert see_cell(look, eyes, PvsConfig(min_viewpoints=5, patience=2)).viewpoints == 5
    assert see_cell(look, eyes, PvsConfig(min_viewpoints=1, patience=40)).viewpoints == 24
    assert see_cell(look, eyes, PvsConfig(min_viewpoints=1, patience=2)).growth == 0.0


@pytest.mark.parametrize(
    "bad",
    [
        {"method": "magic"},
        {"tau": 0.0},
        {"tau": 0.6},
        {"tau": float("nan")},
        {"size": 3},
        {"size": 5000},
        {"size": 16.5},
        {"growth": -0.1},
        {"growth": 1.5},
        {"patience": 0},
        {"min_viewpoints": 0},
        {"max_viewpoints": 3},
        {"class_ratio": 1.0},
    ],
)
def test_bad_settings_are_refused_by_name(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        PvsConfig(**bad)


@given(st.floats(1e-6, 0.5), st.floats(1.25, 1e6))
def test_class_edges_rise_from_tau_and_stay_below_one(tau: float, ratio: float) -> None:
    edges = PvsConfig(tau=tau, class_ratio=ratio).class_edges
    assert edges[0] == tau
    assert (np.diff(edges) > 0).all()
    assert 1 <= len(edges) <= 16
    assert edges[-1] < 1.0


def test_a_scene_of_nothing_cannot_be_looked_at() -> None:
    for method in METHODS:
        with pytest.raises(SceneError, match="nothing to see"):
            Look(Gaussians.empty(), method, 16, 1 / 255)
