"""The scheduler and what a client holds: regimes, reconnects, and poses of every kind."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr.candidates import CandidateStore
from gsvis.abr.classes import FieldOfView
from gsvis.abr.holdings import Holdings
from gsvis.abr.index import nearest_replacements
from gsvis.abr.policies import POLICIES, REGIMES, lowest_last, offsets, pairs, regime_of
from gsvis.abr.predict import exponential
from gsvis.abr.scheduler import Scheduler, SchedulerConfig
from tests.abr import abr_scenes as scenes

VIEW = FieldOfView.of_degrees(80, 60, margin=8)
FEW = settings(max_examples=12)


def walked(scheduler: Scheduler, client: Holdings, seed: int, ticks: int, start: float = 0.0) -> None:
    rng = np.random.default_rng(seed)
    place, spin = rng.uniform(-2, 2, 3), rng.normal(0, 0.5, 3)
    for k in range(ticks):
        t = start + k / 10
        scheduler.on_pose(t, place + 0.1 * k, exponential(spin * k / 10))
        batch = scheduler.next_batch(t, max(200.0, scheduler.allowance()))
        client.add(batch.gaussians, batch.terms, batch.dropped)
        if batch.bytes:
            scheduler.on_sent(t, batch.bytes)
            scheduler.on_ack(t + 0.1, batch.bytes, 0.1)


@FEW
@given(st.integers(0, 10_000), st.sampled_from(POLICIES))
def test_a_client_that_comes_back_loses_and_repeats_nothing(seed: int, policy: str) -> None:
    index = scenes.random_index(seed)
    store, client = CandidateStore(index), Holdings(len(index), index.num_terms)
    config = SchedulerConfig(policy=policy, start_rate=5e3)
    walked(Scheduler(store, VIEW, config), client, seed, 5)
    data = client.to_bytes()
    held = Holdings.from_bytes(data, len(index), index.num_terms)
    assert held.to_bytes() == data
    again = Scheduler(store, VIEW, config, holdings=held)
    walked(again, client, seed + 1, 10)  # add refuses what is there
    assert np.array_equal(client.received, again.holdings.received)
    assert np.array_equal(client.shown, again.holdings.shown)


@FEW
@given(st.integers(0, 10_000))
def test_the_same_input_gives_the_same_batches(seed: int) -> None:
    index = scenes.random_index(seed)
    held = [Holdings(len(index), index.num_terms) for _ in range(2)]
    for client in held:
        walked(Scheduler(CandidateStore(index), VIEW), client, seed, 6)
    assert held[0].to_bytes() == held[1].to_bytes()


def test_records_are_ranked_anew_only_when_the_view_has_changed() -> None:
    index = scenes.random_index(4)
    scheduler = Scheduler(CandidateStore(index), VIEW, SchedulerConfig(lead=0.0))
    for k in range(20):
        scheduler.on_pose(k / 10, [0.2, 0.2, 0.2], exponential(np.array([0, 1e-3 * k, 0])))
        scheduler.next_batch(k / 10, 300.0)
    assert scheduler.plans == 1
    scheduler.on_pose(3.0, [0.2, 0.2, 0.2], exponential(np.array([0, 0.5, 0])))
    scheduler.next_batch(3.0, 300.0)
    assert scheduler.plans == 2


def test_poses_of_every_kind() -> None:
    index = scenes.random_index(6)
    scheduler = Scheduler(CandidateStore(index), VIEW)
    assert len(scheduler.next_batch(0.0, 1e6)) == 0
    for position, quat in (([np.nan] * 3, [1, 0, 0, 0]), ([0, 0, 0], [np.inf, 0, 0, 0]), ([0, 0, 0], [0, 0, 0, 0])):
        with pytest.raises(ValueError, match="expected"):
            scheduler.on_pose(0.0, position, quat)
    assert scheduler.cell == -1
    scheduler.on_pose(1.0, [1e8, -1e8, 0], [1, 0, 0, 0])  # far outside of all cells: the nearest serves
    assert 0 <= scheduler.cell < len(index.grid)
    assert len(scheduler.next_batch(1.0, 1e6)) > 0
    cell = scheduler.cell
    scheduler.on_pose(0.5, index.grid.centers[0], [1, 0, 0, 0])  # late
    assert scheduler.cell == cell


def test_what_is_under_way_is_bounded_by_the_window() -> None:
    scheduler = Scheduler(CandidateStore(scenes.random_index(7)), VIEW, SchedulerConfig(start_rate=1e4, window=0.3))
    scheduler.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
    assert scheduler.allowance() == 3e3
    records = scheduler.next_batch(0.0, scheduler.allowance() / 2).bytes
    assert scheduler.outstanding == 0.0
    sent = 1.25 * records  # what the wire adds
    scheduler.on_sent(0.0, sent)
    assert scheduler.outstanding == sent
    assert scheduler.record_rate == pytest.approx(1e4 / 1.25)
    assert scheduler.allowance() == 3e3 - sent
    scheduler.on_ack(0.2, sent / 2, 0.0)
    assert (scheduler.outstanding, scheduler.rate) == (sent / 2, 1e4)
    scheduler.on_ack(0.2, sent / 2, sent / 4e4)
    assert scheduler.outstanding == 0.0
    assert scheduler.rate == pytest.approx(2e4)


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
    assert pairs("fov-first", "high", 3)[:5] == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)]
    assert pairs("low-first", "high", 3)[:5] == [(0, 0), (1, 0), (0, 1), (0, 2), (1, 1)]
    assert pairs("low-first", "medium", 3)[:3] == [(0, 0), (1, 0), (0, 1)]
    assert pairs("fov-first", "low", 3)[:4] == [(0, 0), (0, 1), (1, 0), (2, 0)]
    for policy in POLICIES:
        for regime in REGIMES:
            for levels in (1, 2, 3, 16):
                table = offsets(policy, regime, levels)
                assert table.min() == 0
                assert (table[..., 1] >= table[..., 0]).all()
                if policy != "utility":
                    found = pairs(policy, regime, levels)
                    assert len(set(found)) == len(found) == 5 * levels
                assert lowest_last(regime, levels) == (levels - 1 if regime == "high" else 0)
    low, high = offsets("utility", "low", 3), offsets("utility", "high", 3)
    assert (low[1:] >= high[1:]).all()


@FEW
@given(st.binary(max_size=200), st.integers(0, 60), st.integers(0, 255))
def test_bytes_that_are_no_holdings_are_refused(junk: bytes, place: int, value: int) -> None:
    made = Holdings(1000, 50)
    made.add(np.arange(0, 900, 7), np.arange(10), np.array([7]))
    data = bytearray(made.to_bytes())
    with pytest.raises(ValueError, match=r"^data: expected"):
        Holdings.from_bytes(junk, 1000, 50)
    with pytest.raises(ValueError, match=r"^data: expected"):
        Holdings.from_bytes(bytes(data[:-1]), 1000, 50)
    with pytest.raises(ValueError, match=r"^data: expected"):
        Holdings.from_bytes(bytes(data), 1001, 50)
    data[place] = value
    try:
        Holdings.from_bytes(bytes(data), 1000, 50)
    except ValueError as error:
        assert str(error).startswith("data: expected")


def test_what_is_held_is_not_taken_in_again() -> None:
    made = Holdings(100, 10)
    none = np.zeros(0, np.int64)
    made.add(np.array([1, 2]), np.array([3]), none)
    for gaussians, terms in ((np.array([2]), none), (none, np.array([3])), (np.array([5, 5]), none)):
        with pytest.raises(ValueError, match="held already"):
            made.copy().add(gaussians, terms, none)
    with pytest.raises(ValueError, match=r"^gaussians"):
        made.add(np.array([100]), none, none)
    made.add(none, none, np.array([1]))
    assert made.shown.tolist() == [2]
    assert made.received.tolist() == [1, 2]


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
