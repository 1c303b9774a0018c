"""Outside of all cells: the nearest set is widened by the distance, and inside nothing changes."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr import candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FieldOfView
from gsvis.abr.outside import STEPS, distance_step, uncertainty, widened_weights
from gsvis.abr.planner import Planner
from gsvis.pvs.codec import ids_of
from tests.abr import abr_scenes as scenes

VIEW = FieldOfView.from_degrees(80, 60, margin=5)
FEW = settings(max_examples=10)


def test_the_step_is_zero_inside_and_rises_with_the_distance_in_sides_of_a_cell() -> None:
    index = scenes.random_index(3, count=50)
    for cell in range(len(index.grid)):
        (low, side), center = index.grid.box_of(cell), index.grid.centers[cell]
        assert np.allclose(np.array(low) + side / 2, center)
        corners = center + side * (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5)
        assert {distance_step(index, cell, point) for point in [center, *corners]} == {0}
        away = [
            distance_step(index, cell, center + side * np.array([0.0, 0.5 + d, 0.0]))
            for d in np.geomspace(1e-3, 1e6, 60)
        ]
        assert away == sorted(away)
        assert set(away) == set(range(1, STEPS))
        assert distance_step(index, cell, np.full(3, 1e300)) == STEPS - 1


def test_weights_fall_to_plain_importance_with_the_distance() -> None:
    own = np.array([0.01, 0.2, 0.9], np.float32)
    assert uncertainty(0) == 0.0
    last = np.full(3, np.inf)
    for step in range(1, STEPS):
        found = widened_weights(own, step)
        apart = np.abs(found[:3] - own.mean())
        assert (apart <= last).all()
        assert found[4] <= found[3] <= own.mean() + 1e-6
        last = apart
    assert np.allclose(widened_weights(own, STEPS - 1), own.mean())


@FEW
@given(st.integers(0, 10_000), st.integers(1, STEPS - 1))
def test_outside_the_candidates_are_all_that_there_is(seed, step) -> None:
    store = CandidateIndex(scenes.random_index(seed, count=300, share=0.1))
    cell = seed % len(store.index.grid)
    inside, outside = store.in_cell(cell), store.in_cell(cell, step)
    assert (inside.step, outside.step) == (0, step)
    assert np.array_equal(ids_of(outside.union), np.arange(300))
    assert len(ids_of(inside.union)) < 300


@FEW
@given(st.integers(0, 10_000), st.integers(1, STEPS - 1))
def test_of_a_large_scene_outside_candidates_are_what_nearby_cells_see(seed, step) -> None:
    index = scenes.random_index(seed, count=700, share=0.02)
    with patch.object(candidates, "_DENSE", 0), patch.object(candidates, "_REST", 3):
        store = CandidateIndex(index)
        found = ids_of(store.in_cell(0, step).union)
        seen = np.unique(np.concatenate([index.sets.classes(cell)[0] for cell in range(len(index.grid))]))
        assert np.isin(ids_of(store.in_cell(0).union), found).all()
        assert np.isin(found, seen).all()
        planner = Planner(store, VIEW)
        planner.aim(0, np.zeros(3, np.float32), VIEW.planes(np.zeros(3), (1, 0, 0, 0))[None], step=step)
        sent = [int(g) for batch in drained(planner) for g in batch.gaussians]
    assert len(sent) == len(set(sent))
    assert set(np.flatnonzero(index.last == index.num_levels - 1)) <= set(sent)


@FEW
@given(st.integers(0, 10_000))
def test_inside_the_same_records_come_as_without_widening(seed) -> None:
    index = scenes.random_index(seed, count=300)
    cell, rng = seed % len(index.grid), np.random.default_rng(seed)
    eye = index.grid.centers[cell] + rng.uniform(-0.999, 0.999, 3) * index.grid.cell_size / 2
    orders = []
    for rule in (distance_step, lambda *_: 0):
        with patch("gsvis.abr.planner.distance_step", rule):
            planner = Planner(CandidateIndex(index), VIEW)
            planner.on_pose(0.0, eye, (1, 0.2, 0, 0))
            orders.append([planner.next_batch(0.0, 3000.0, 1e4).gaussians.tolist() for _ in range(5)])
    assert orders[0] == orders[1]


def test_what_is_not_to_be_sent_never_is() -> None:
    index = scenes.random_index(5, count=300)
    sent = np.arange(300) % 3 > 0
    object.__setattr__(index, "sent", sent)
    planner = Planner(CandidateIndex(index), VIEW)
    planner.aim(0, np.zeros(3, np.float32), VIEW.planes(np.zeros(3), (1, 0, 0, 0))[None], step=STEPS - 1)
    seen = np.unique(np.concatenate([index.sets.classes(cell)[0] for cell in range(len(index.grid))]))
    others = np.setdiff1d(np.arange(300), seen)
    assert not np.isin(others[~sent[others]], [g for batch in drained(planner) for g in batch.gaussians]).any()


def drained(planner: Planner) -> list:
    out = []
    while not planner.done:
        out.append(planner.take(3000.0))
    return out


@pytest.mark.parametrize("rule", ["widened", "nearest cell alone"])
def test_a_viewer_who_steps_outside_is_ranked_for_anew(rule) -> None:
    index = scenes.random_index(2, count=300)
    planner = Planner(CandidateIndex(index), VIEW)
    center, side = index.grid.centers[0], index.grid.cell_size
    with patch("gsvis.abr.planner.distance_step", distance_step if rule == "widened" else lambda *_: 0):
        for k, away in enumerate((0.45, 0.51, 0.52)):
            planner.on_pose(k / 10, center - [away * side, 0, 0], (1, 0, 0, 0))
            assert planner.has_to_prepare == (k < (2 if rule == "widened" else 1))
            planner.prepare()
            planner.next_batch(k / 10, 500.0, 1e4)
            assert not planner.has_to_prepare
