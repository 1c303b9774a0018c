"""Policies and regimes: tables with known answers, and replacements between levels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr._kernels import units as kernels
from gsvis.abr._kernels.plan import NEVER
from gsvis.abr.index import nearest_replacements
from gsvis.abr.policies import (
    POLICIES,
    REGIMES,
    UtilityConfig,
    lowest_last,
    offset_table,
    offsets,
    rank_pairs,
    regime_of,
)
from gsvis.abr.rings import RINGS
from tests.abr import abr_scenes as scenes

FEW = settings(max_examples=12)


def test_the_regime_follows_the_bandwidth_and_holds_on() -> None:
    sizes = np.array([1e5, 3e5, 1e6])
    assert [regime_of(rate, sizes, 1.0) for rate in (2e6, 5e5, 2e5, 1e3)] == ["high", "medium", "low", "low"]
    assert regime_of(1.1e6, sizes, 1.0, "medium") == "medium"
    assert regime_of(1.3e6, sizes, 1.0, "medium") == "high"
    assert regime_of(0.9e6, sizes, 1.0, "high") == "high"
    assert regime_of(0.8e6, sizes, 1.0, "high") == "medium"
    assert regime_of(1e3, sizes, 1.0, "high") == "low"
    assert regime_of(1e9, sizes, 1.0, "low") == "high"
    assert regime_of(1.0, np.array([5.0]), 1.0) == "low"


def test_tables_of_the_policies() -> None:
    assert rank_pairs("fov-first", "high", 3)[:5] == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)]
    assert rank_pairs("low-first", "high", 3)[:5] == [(0, 0), (1, 0), (0, 1), (0, 2), (1, 1)]
    assert rank_pairs("low-first", "medium", 3)[:3] == [(0, 0), (1, 0), (0, 1)]
    assert rank_pairs("fov-first", "low", 3)[:4] == [(0, 0), (0, 1), (1, 0), (2, 0)]
    for policy in POLICIES:
        for regime in REGIMES:
            for levels in (1, 2, 3, 16):
                offset_table = offsets(policy, regime, levels)
                assert offset_table.min() == 0
                assert (offset_table[..., 1] >= offset_table[..., 0]).all()
                if policy != "utility":
                    found = rank_pairs(policy, regime, levels)
                    assert len(set(found)) == len(found) == 6 * levels
                assert lowest_last(regime, levels) == (levels - 1 if regime == "high" else 0)
    assert rank_pairs("low-first", "high", 4, picture=0)[:5] == [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2)]
    assert rank_pairs("fov-first", "low", 4, picture=0)[:6] == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0)]
    low, high = offsets("utility", "low", 3), offsets("utility", "high", 3)
    assert (low[1:] >= high[1:]).all()


@pytest.mark.parametrize("picture", [-1, 0])
def test_finer_levels_in_view_wait_by_their_factor(picture: int) -> None:
    plain, later = (offsets("utility", "high", 4, UtilityConfig(finer=factor), picture) for factor in (1.0, 0.5))
    assert (later - plain)[0].tolist() == [[0, 0]] * (picture + 2) + [[32, 32]] * (2 - picture)
    assert np.array_equal(later[1:], plain[1:])


@pytest.mark.parametrize("policy", POLICIES[:2])
def test_each_place_of_the_two_orders_has_its_own_keys(policy: str) -> None:
    found = offsets(policy, "medium", 3)
    assert sorted(found.ravel() // kernels.BUCKETS) == list(range(found.size))
    assert not (found % kernels.BUCKETS).any()


def test_utility_adds_the_logarithms_of_its_factors() -> None:
    """In view, out of view, ahead, and neighbors by face, edge and corner: each ring loses adjacent / peripheral."""
    config = UtilityConfig(peripheral=2**-3, ahead=2**-4, adjacent=2**-5, terms=0.5, finer=1.0, beyond=2**-6)
    for regime, power in (("high", 1.0), ("medium", 1.5), ("low", 2.0)):
        found = offsets("utility", regime, 1, config)[:, 0, kernels.GEOMETRY]
        assert found.tolist() == [32 * power * halvings for halvings in (0, 3, 4, 5, 7, 9)]
    terms = offsets("utility", "high", 3, config)
    assert (terms[..., kernels.TERMS] - terms[..., kernels.GEOMETRY] == 32).all()
    for adjacent in (2**-3, 2**-2):  # a neighbor is worth what is ahead at most, and no more than what is out of view
        near = offsets("utility", "high", 1, UtilityConfig(peripheral=2**-3, ahead=2**-4, adjacent=adjacent))
        assert near[:, 0, kernels.GEOMETRY].tolist() == [0, 96, 128, 128, 128, 128]
    beyond = offsets("utility", "low", 3, config) - offsets(
        "utility", "low", 3, UtilityConfig(**{**vars(config), "beyond": 1.0})
    )
    assert beyond[..., kernels.GEOMETRY].tolist() == [[0, 0, 192]] + [[0, 192, 192]] * 5


@pytest.mark.parametrize("regime", REGIMES)
def test_of_what_ends_early_only_a_first_picture_in_view_is_sent(regime: str) -> None:
    everywhere = (kernels.INSIDE, kernels.OUTSIDE, kernels.EDGE)
    found = offset_table("fov-first", regime, 3, picture=0, terms_in=everywhere)[0].reshape(RINGS, 3, 3, 2, 3)
    sent = found != NEVER
    least = 2 if regime == "high" else 1
    assert sent[0, :, least:].all()
    assert sent[1:, :, least:, kernels.GEOMETRY, : kernels.EDGE].all()
    early = sent[:, :, :least]
    assert early[0, 0, :, kernels.GEOMETRY, kernels.INSIDE].all()
    assert early[0, 0, :, kernels.GEOMETRY, kernels.EDGE].all()
    assert early.sum() == 2 * least


@pytest.mark.parametrize("policy", POLICIES)
def test_only_what_belongs_to_a_first_picture_alone_waits_by_its_factor(policy: str) -> None:
    tables = [offset_table(policy, "low", 4, UtilityConfig(first=factor), picture=0) for factor in (1.0, 0.5)]
    added = (tables[1][0] - tables[0][0]).reshape(RINGS, 4, 4, 2, 3)
    alone = added[0, 0, 0, kernels.GEOMETRY, kernels.INSIDE]
    assert alone == (32 if policy == "utility" else 0)
    assert added[0, 0, 0, kernels.GEOMETRY, kernels.EDGE] == alone
    assert np.count_nonzero(added) == 2 * (alone > 0)
    assert tables[1][1] - tables[0][1] == alone


@pytest.mark.parametrize("regime", REGIMES)
def test_what_is_at_the_edge_of_the_view_waits_by_its_factor(regime: str) -> None:
    made = offset_table("utility", regime, 3, UtilityConfig(edge=0.5), strong=(2.0, 1.0), kinds=3)[0]
    inside, edge = made[..., kernels.INSIDE], made[..., kernels.EDGE]
    sent = inside < NEVER
    own = np.arange(len(made)) < 9
    assert (edge[own] - inside[own] == 32)[sent[own]].all()
    assert (edge[own][~sent[own]] == NEVER).all()
    assert (edge[~own] == NEVER).all()
    bare = offset_table("utility", regime, 3, UtilityConfig(edge=0.5), terms_in=(kernels.INSIDE,))[0]
    assert (bare[:, kernels.TERMS, kernels.EDGE] == NEVER).all()
    assert np.array_equal(bare[:, kernels.GEOMETRY], made[:, kernels.GEOMETRY])


def test_terms_that_change_the_image_twice_as_much_are_worth_four_times_as_much() -> None:
    made = offset_table("utility", "high", 3, strong=(4.0, 2.0, 1.0), kinds=4)[0][8, :, kernels.INSIDE]
    assert np.diff(made[kernels.STRONG :]).tolist() == [64, 64]


@FEW
@given(st.integers(0, 10_000), st.integers(1, 4))
def test_everything_that_ends_early_is_replaced_from_the_level_above(seed: int, count: int) -> None:
    levels = scenes.random_levels(np.random.default_rng(seed), 150, count)
    starts, ids = nearest_replacements(levels)
    ending = levels.last < len(levels) - 1
    for g in np.flatnonzero(ending).tolist():
        found = ids[starts[g] : starts[g + 1]]
        enters = np.flatnonzero(levels.first == levels.last[g] + 1)
        assert len(found) or not len(enters)
        assert np.isin(found, enters).all()
    assert (np.diff(starts)[~ending] == 0).all()
