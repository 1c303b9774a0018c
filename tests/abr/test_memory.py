"""A client with little memory: never more than it can hold, and nothing in view is evicted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr.batches import Batch
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FOV, FieldOfView, classify
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.abr.index import SceneIndex
from gsvis.abr.memory import ClientMemory
from gsvis.abr.planner import Planner
from gsvis.pvs.codec import ids_of
from tests.abr import abr_scenes as scenes

VIEW = FieldOfView.from_degrees(80, 60, margin=5)
FEW = settings(max_examples=15)


class Client:
    """A client that checks each batch and counts its own bytes."""

    def __init__(self, index: SceneIndex, most_bytes: float) -> None:
        self.index, self.most_bytes = index, most_bytes
        self.holdings = Holdings(len(index), index.num_terms)

    @property
    def held_bytes(self) -> float:
        index, h = self.index, self.holdings
        owners = np.repeat(np.arange(len(index)), np.diff(index.term_offsets))
        terms = h.received_terms
        return 16.0 * len(h.shown) + 4.5 * int(np.isin(owners[terms], h.shown).sum())

    def add(self, batch: Batch, gone: np.ndarray) -> None:
        owners = np.repeat(np.arange(len(self.index)), np.diff(self.index.term_offsets))
        terms = self.holdings.received_terms
        self.holdings.evict(batch.evicted, terms[np.isin(owners[terms], batch.evicted)])
        fresh = ids_of(gone & ~self.holdings.gone)  # replaced, whether they came or not
        self.holdings.add(batch.gaussians, batch.terms, fresh)  # refuses what it has
        assert self.held_bytes <= self.most_bytes * (1 + 1e-6)


def bytes_of_all(index: SceneIndex) -> float:
    return 16.0 * len(index) + 4.5 * index.num_terms


def follow(client: Client, planner: Planner, views: list, budget: float = 800.0) -> None:
    for cell, eye, planes in views:
        planner.aim(cell, eye, planes)
        sent = 0
        while not planner.done:
            batch = planner.take(budget)
            client.add(batch, planner.holdings.gone)
            sent += len(batch) + len(batch.evicted)
            assert sent < 20 * len(client.index) + 20 * client.index.num_terms, "the same records come again and again"
        assert planner.memory is not None
        assert planner.memory.held_bytes == pytest.approx(client.held_bytes, rel=1e-5, abs=1e-3)
        assert np.array_equal(client.holdings.sent, planner.holdings.sent)
        assert np.array_equal(client.holdings.sent_terms, planner.holdings.sent_terms)


def some_views(index: SceneIndex, seed: int, count: int) -> list:
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        cell = int(rng.integers(len(index.grid)))
        eye = (index.grid.centers[cell] + rng.uniform(-0.3, 0.3, 3)).astype(np.float32)
        out.append((cell, eye, VIEW.planes(eye, rng.normal(size=4))[None]))
    return out


@FEW
@given(st.integers(0, 10_000), st.floats(0.0, 1.2), st.booleans(), st.integers(1, 3))
def test_a_client_never_holds_more_than_its_memory(seed, share, cones, levels) -> None:
    index = scenes.random_index(seed, count=300, levels=levels, shape=(5, 3, 2), share=0.15, cones=cones)
    most = max(1.0, share * bytes_of_all(index))
    client = Client(index, most)
    planner = Planner(CandidateIndex(index), VIEW, memory=most)
    follow(client, planner, some_views(index, seed, 6))


@FEW
@given(st.integers(0, 10_000), st.booleans())
def test_what_is_in_view_arrives_if_the_memory_holds_it_wherever_the_viewer_was(seed, cones) -> None:
    index = scenes.random_index(seed, count=300, levels=1, shape=(5, 3, 2), share=0.15, cones=cones)
    views = some_views(index, seed, 5)
    needed = []
    for cell, _, planes in views:
        inside = np.flatnonzero(classify(index, cell, planes).classes == FOV)
        words = np.unique(inside >> 6)  # words are evicted as a whole: one that touches the view stays
        stay = np.flatnonzero(np.isin(np.arange(len(index)) >> 6, words))
        needed.append((inside, 16.0 * len(stay)))
    terms = 4.5 * index.num_terms
    most = max(nbytes for _, nbytes in needed) + terms + 100.0
    client = Client(index, most)
    planner = Planner(CandidateIndex(index), VIEW, AbrConfig(policy="fov-first"), memory=most)
    for view, (inside, _) in zip(views, needed, strict=True):
        follow(client, planner, [view])
        assert np.isin(inside, client.holdings.shown).all()


@FEW
@given(st.integers(0, 10_000))
def test_nothing_in_view_is_evicted(seed) -> None:
    index = scenes.random_index(seed, count=300, levels=1, shape=(5, 3, 2), share=0.15)
    most = 1.6 * len(index)
    planner = Planner(CandidateIndex(index), VIEW, memory=most)
    for cell, eye, planes in some_views(index, seed, 6):
        planner.aim(cell, eye, planes)
        inside = np.flatnonzero(classify(index, cell, planes).classes == FOV)
        while not planner.done:
            assert not np.isin(planner.take(500.0).evicted, inside).any()


def test_what_is_farthest_goes_first() -> None:
    index = scenes.random_index(3, count=640, levels=1, shape=(6, 1, 1), share=0.3, most_terms=0)
    store = CandidateIndex(index)
    holdings = Holdings(len(index), 0)
    holdings.add(np.arange(len(index)), [], [])
    memory = ClientMemory(store, holdings, 16.0 * len(index))
    near, eye = np.zeros_like(holdings.sent), np.zeros(3, np.float32)
    gone = memory.make_room(4 * 64 * 16.0, near, eye, np.zeros((0, 5, 4), np.float32), for_view=False)
    apart = np.linalg.norm(store.tables.spheres[: -(-len(index) // 64), :3], axis=1)
    assert set((gone >> 6).tolist()) == set(np.argsort(-apart)[: len(set((gone >> 6).tolist()))].tolist())


def test_what_an_evicted_gaussian_had_replaced_comes_again() -> None:
    index = scenes.random_index(5, count=200, levels=3, shape=(5, 1, 1), share=0.5, most_terms=0)
    store = CandidateIndex(index)
    planner = Planner(store, VIEW, memory=1e6)
    planner.aim(0, index.grid.centers[0], np.tile(np.array([0, 0, 0, 1], np.float32), (1, 5, 1)), "low")
    while not planner.done:
        planner.take(1e4)
    gone = set(ids_of(planner.holdings.gone).tolist())
    assert gone
    assert planner.memory is not None
    evicted = planner.memory.make_room(
        1e9, np.zeros_like(planner.holdings.sent), index.grid.centers[0].astype(np.float32),
        np.zeros((0, 5, 4), np.float32), for_view=False,
    )  # fmt: skip
    assert gone <= set(evicted.tolist())
    assert not planner.holdings.gone.any()
    assert not planner.holdings.sent.any()
    assert planner.memory.held_bytes == pytest.approx(0.0, abs=1e-6)


def test_a_client_without_room_for_one_record_gets_nothing() -> None:
    index = scenes.random_index(7, shape=(3, 1, 1))
    planner = Planner(CandidateIndex(index), VIEW, memory=1.0)
    planner.on_pose(0.0, index.grid.centers[0], [1, 0, 0, 0])
    assert len(planner.next_batch(0.0, 1e4, 1e6)) == 0
    assert planner.done


@pytest.mark.parametrize("memory", [0.0, -1.0, float("nan")])
def test_memory_that_cannot_be_is_refused(memory) -> None:
    with pytest.raises(ValueError, match="most_bytes: expected bytes > 0"):
        Planner(CandidateIndex(scenes.random_index(0)), VIEW, memory=memory)


def test_holdings_forget_only_what_they_have() -> None:
    holdings = Holdings(10, 5)
    holdings.add([1, 2], [3], [4])
    for gaussians, terms in (([5], []), ([1], [2]), ([11], [])):
        with pytest.raises(ValueError, match="expected"):
            holdings.evict(gaussians, terms)
    holdings.evict([1, 4], [3])
    assert holdings.received.tolist() == [2]
    assert ids_of(holdings.gone).tolist() == []
    assert holdings.received_terms.tolist() == []
