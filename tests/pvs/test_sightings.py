"""Weights and their classes, and what a set takes of what was seen faintly: the fainter, the more light it misses."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsvis.pvs import PvsConfig
from gsvis.pvs.sightings import FaintOnes, Sighting
from gsvis.pvs.weight_classes import FAINTEST, UNSEEN, WeightClasses

COUNT = 700
CLASSES = (np.arange(COUNT) % (4 - UNSEEN) + UNSEEN).astype(np.int8)
EVERY = np.ones(COUNT, bool)


def sighting(classes: np.ndarray = CLASSES) -> Sighting:
    """A viewpoint that sees each Gaussian with a class."""
    return Sighting(np.array([1.0, 2.0, 3.0]), 1, np.arange(len(classes), dtype=np.int32), classes)


@given(st.lists(st.floats(0.0, 1.0, width=32), max_size=30))
def test_each_weight_lies_between_the_edges_of_its_class(weights: list[float]) -> None:
    config = PvsConfig()
    classes = WeightClasses(config.class_edges)
    faint = config.tau * 2.0 ** np.arange(FAINTEST, 0)
    edges = np.concatenate([[0.0], faint, config.class_edges, [np.inf]]).astype(np.float32)
    for weight, found in zip(weights, classes.of(np.array(weights, np.float32)), strict=True):
        assert edges[found - UNSEEN] <= np.float32(weight) < edges[found - UNSEEN + 1]
    assert classes.faintest == faint[0].astype(np.float32)


def test_a_set_takes_the_fainter_the_more_light_it_misses() -> None:
    taken = []
    for missed in (0.01, 0.05, 0.2, 0.9):
        faint = FaintOnes([sighting()], EVERY, 0.05)
        assert faint.pay(missed)
        (found,) = faint.take(missed)
        assert np.array_equal(found[0], np.flatnonzero((faint.taken <= CLASSES) & (CLASSES < 0)))
        assert found[1].tolist() == [1.0, 2.0, 3.0]
        taken.append(faint.taken)
    assert taken == [-2, -2, -3, FAINTEST]


def test_it_takes_more_only_where_the_last_ones_left_little() -> None:
    faint = FaintOnes([sighting()], EVERY, 0.05)
    first = next(faint.take(0.2))[0]
    assert not faint.pay(0.18)
    assert faint.pay(0.1)
    second = next(faint.take(0.1))[0]
    assert not np.isin(second, first).any()
    assert (CLASSES[second] < CLASSES[first].min()).all()
    list(faint.take(0.9))
    assert not faint.pay(0.0)  # there are none left


def test_only_gaussians_of_the_level_are_taken() -> None:
    members = np.arange(COUNT) % 2 == 0
    (found,) = FaintOnes([sighting()], members, 0.05).take(0.9)
    assert len(found[0]) > 0
    assert members[found[0]].all()


def test_a_sighting_tells_what_it_sees_from_what_is_faint() -> None:
    each = sighting()
    assert np.array_equal(each.ids[each.seen], np.flatnonzero(CLASSES >= 0))
    assert np.array_equal(each.between(-3, -1), np.flatnonzero((CLASSES == -3) | (CLASSES == -2)))
