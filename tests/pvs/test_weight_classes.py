"""Classes of weights: as a search finds them, and -1 right below tau."""

from __future__ import annotations

import numpy as np

from gsvis.pvs.config import PvsConfig
from gsvis.pvs.weight_classes import FAINTEST, UNSEEN, WeightClasses

EDGES = PvsConfig().class_edges


def test_classes_are_what_a_search_finds() -> None:
    all_edges = np.concatenate([EDGES[0] * 2.0 ** np.arange(FAINTEST, 0), EDGES]).astype(np.float32)
    others = np.exp(np.random.default_rng(0).uniform(np.log(1e-6), 0.0, 500)).astype(np.float32)
    weights = np.concatenate([all_edges, np.nextafter(all_edges, np.float32(0.0)), others])
    expected = np.searchsorted(all_edges, weights, side="right") + UNSEEN
    found = WeightClasses(EDGES).of(weights)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.int8


def test_the_ends() -> None:
    some = np.array([0.0, EDGES[0] * 0.999, EDGES[0] * 1.001, 1.0], np.float32)
    assert WeightClasses(EDGES).of(some).tolist() == [UNSEEN, -1, 0, len(EDGES) - 1]
