"""What a client holds: reconnects, bytes, and ids that are wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.abr.planner import Planner
from gsvis.abr.policies import POLICIES
from gsvis.abr.predict import exponential
from tests.abr import abr_scenes as scenes

VIEW = FieldOfView.from_degrees(80, 60, margin=8)
FEW = settings(max_examples=12)


def walk(planner: Planner, client: Holdings, seed: int, ticks: int) -> None:
    rng = np.random.default_rng(seed)
    place, spin = rng.uniform(-2, 2, 3), rng.normal(0, 0.5, 3)
    for k in range(ticks):
        t = k / 10
        planner.on_pose(t, place + 0.1 * k, exponential(spin * k / 10))
        batch = planner.next_batch(t, 1500.0, 5e3)
        client.add(batch.gaussians, batch.terms, batch.dropped)


@FEW
@given(st.integers(0, 10_000), st.sampled_from(POLICIES))
def test_a_client_that_comes_back_loses_and_repeats_nothing(seed: int, policy: str) -> None:
    index = scenes.random_index(seed)
    store, client = CandidateIndex(index), Holdings(len(index), index.num_terms)
    config = AbrConfig(policy=policy)
    walk(Planner(store, VIEW, config), client, seed, 5)
    data = client.to_bytes()
    held = Holdings.from_bytes(data, len(index), index.num_terms)
    assert held.to_bytes() == data
    again = Planner(store, VIEW, config, holdings=held)
    walk(again, client, seed + 1, 10)  # add refuses what is there
    assert np.array_equal(client.received, again.holdings.received)
    assert np.array_equal(client.shown, again.holdings.shown)


@FEW
@given(st.integers(0, 10_000))
def test_the_same_input_gives_the_same_batches(seed: int) -> None:
    index = scenes.random_index(seed)
    held = [Holdings(len(index), index.num_terms) for _ in range(2)]
    for client in held:
        walk(Planner(CandidateIndex(index), VIEW), client, seed, 6)
    assert held[0].to_bytes() == held[1].to_bytes()


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
        with pytest.raises(ValueError, match=r"held already|each id once"):
            made.copy().add(gaussians, terms, none)
    with pytest.raises(ValueError, match=r"^gaussians"):
        made.add(np.array([100]), none, none)
    made.add(none, none, np.array([1]))
    assert made.shown.tolist() == [2]
    assert made.received.tolist() == [1, 2]


@pytest.mark.parametrize("size", [0, 1, 100, 5000, 16_000, 65_536, 65_537, 70_000, 200_000])
def test_nothing_that_is_held_takes_more_bytes_than_are_allowed(size: int) -> None:
    most = Holdings.most_bytes(size, size)
    every = np.arange(size)
    for held in (every, every[::2], every[every % 3 > 0], every[:4096], every[::16], every[-4096:]):
        client = Holdings(size, size)
        client.add(held, held, held)
        assert len(client.to_bytes()) <= most
    assert most < 200 + 3 * (2 * size if size < 4096 else size // 8 + 8192 + 9)
