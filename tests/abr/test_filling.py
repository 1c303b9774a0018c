"""What fills an idle link, and terms by the pose: everything that a cell sees arrives, and nothing too early."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr import candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FOV, FieldOfView, classify
from gsvis.abr.cones import TermCones
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.abr.index import SceneIndex
from gsvis.abr.planner import Planner
from gsvis.abr.policies import POLICIES
from gsvis.abr.rings import Shells
from gsvis.color.activation import Activation
from gsvis.color.srbf import SrbfColors
from gsvis.files.cache import Cache
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.codec import ids_of
from tests.abr import abr_scenes as scenes

VIEW = FieldOfView.from_degrees(80, 60, margin=5)
FEW = settings(max_examples=12)
ALL_ROUND = np.tile(np.array([0, 0, 0, 1], np.float32), (1, 5, 1))  # planes that have everything in front of them


def look_at(planner: Planner, cell: int, eye: list[float], planes: np.ndarray = ALL_ROUND) -> None:
    planner.aim(cell, np.array(eye, np.float32), planes)


def drained(planner: Planner, budget: float = 3000.0) -> list:
    out = []
    while not planner.done:
        out.append(planner.take(budget))
    return out


@FEW
@given(st.integers(0, 10_000), st.sampled_from(POLICIES), st.booleans())
def test_an_idle_link_brings_all_that_any_cell_sees(seed, policy, cones) -> None:
    index = scenes.random_index(seed, count=300, shape=(6, 3, 2), share=0.03, cones=cones)
    planner = Planner(CandidateIndex(index), VIEW, AbrConfig(policy=policy))
    look_at(planner, 0, [0.0, 0.0, 0.0])
    batches = drained(planner)
    seen = np.unique(np.concatenate([index.sets.classes(cell)[0] for cell in range(len(index.grid))]))
    wanted = seen[index.last[seen] == index.num_levels - 1]
    assert np.isin(wanted, planner.holdings.received).all()
    terms = np.unique(np.concatenate([index.active.active_ids(cell) for cell in range(len(index.grid))]))
    owners = np.searchsorted(index.term_offsets, terms, side="right") - 1
    assert np.isin(terms[np.isin(owners, wanted)], planner.holdings.received_terms).all()
    flags = [batch.filling for batch in batches if len(batch)]
    assert flags == sorted(flags)  # what the view needs goes first


@FEW
@given(st.integers(0, 10_000), st.booleans())
def test_what_no_cell_sees_comes_last_and_an_idle_link_ends_with_every_record(seed, dense) -> None:
    index = scenes.random_index(seed, count=700, shape=(3, 2, 1), share=0.03, cones=True)
    store = CandidateIndex(index)
    with patch.object(candidates, "_DENSE", 1 << 16 if dense else 0), patch.object(candidates, "_REST", 4):
        planner = Planner(store, VIEW)
        look_at(planner, 0, [0.0, 0.0, 0.0])
        batches = drained(planner)
    sent = np.concatenate([batch.gaussians for batch in batches])
    terms = np.concatenate([batch.terms for batch in batches])
    assert len(np.unique(sent)) == len(sent)
    assert len(np.unique(terms)) == len(terms)
    wanted = np.flatnonzero(index.last == index.num_levels - 1)
    assert np.isin(wanted, sent).all()
    owners = np.repeat(np.arange(len(index)), np.diff(index.term_offsets))
    assert np.isin(np.flatnonzero(np.isin(owners, wanted)), terms).all()
    seen = np.unique(np.concatenate([index.sets.classes(cell)[0] for cell in range(len(index.grid))]))
    flags = ~np.isin(sent, seen)
    assert flags.any()
    assert (np.diff(flags.astype(int)) >= 0).all()


@FEW
@given(st.integers(0, 10_000))
def test_what_fills_goes_by_the_distance_to_the_nearest_cell_that_sees_it(seed) -> None:
    index = scenes.random_index(seed, count=400, levels=1, shape=(8, 4, 2), share=0.02, most_terms=0)
    store = CandidateIndex(index)
    shells = [store.shells.cells(0, k) for k in range(store.shells.count(0))]
    assert sorted(cell for shell in shells for cell in shell) == list(range(len(index.grid)))
    first = np.full(len(index), len(shells))
    for k in reversed(range(len(shells))):
        for cell in shells[k]:
            first[index.sets.classes(cell)[0]] = k
    planner = Planner(store, VIEW)
    look_at(planner, 0, [0.0, 0.0, 0.0])
    sent = [int(g) for batch in drained(planner) if batch.filling for g in batch.gaussians]
    assert (np.diff(first[sent]) >= 0).all()
    apart = np.linalg.norm(index.grid.centers - index.grid.centers[0], axis=1)
    far = [apart[shell].tolist() for shell in shells[1:]]
    assert [d for shell in far for d in shell] == sorted(d for shell in far for d in shell)


def test_shells_are_sorted_as_if_all_cells_were() -> None:
    coords = np.stack(np.unravel_index(np.arange(1800), (30, 30, 2)), axis=1).astype(np.int32)
    grid = CellGrid(np.zeros(3), 1.0, (30, 30, 2), coords, np.array([0.0, 0.0, 1.0]))
    for cell in (0, 911):
        shells = Shells(grid, Cache(1 << 20))
        near = [cell, *grid.neighbors(cell).tolist()]
        order = np.argsort(np.linalg.norm(grid.centers - grid.centers[cell], axis=1), kind="stable")
        found = [shells.cells(cell, k) for k in range(shells.count(cell))]
        assert sorted(found[0]) == sorted(near)
        assert [k for shell in found[1:] for k in shell] == order[~np.isin(order, near)].tolist()


@FEW
@given(st.integers(0, 10_000))
def test_without_filling_only_terms_in_view_that_are_active_for_an_eye_are_sent(seed) -> None:
    index = scenes.random_index(seed, count=300, levels=1, cones=True)
    store, rng = CandidateIndex(index), np.random.default_rng(seed)
    config = AbrConfig(fill=False, parallax=0.0, epsilon=0.01)
    planner = Planner(store, VIEW, config)
    least = np.float32(-np.log(config.epsilon) - 0.5 * np.log(3.6e-5))
    for _ in range(4):  # as the eye walks, terms are checked again
        eye = rng.uniform(-3, 3, 3).astype(np.float32)
        planes = VIEW.planes(eye, rng.normal(size=4))[None]
        planner.aim(0, eye, planes)
        fresh = [int(t) for batch in drained(planner) for t in batch.terms]
        inside = np.flatnonzero(classify(index, 0, planes).classes == FOV)
        owners = np.searchsorted(index.term_offsets, fresh, side="right") - 1
        assert np.isin(owners, inside).all()
        # No Gaussian is larger than all of space at full weight: what no such Gaussian would need is not sent.
        widest = least + 0.5 * np.log(4 * np.pi)
        for t, g in zip(fresh, owners.tolist(), strict=True):
            assert index.cones.active([t], index.means[g], [eye], float(widest))[0]


def test_a_term_is_sent_when_the_eye_enters_its_cone_and_not_before() -> None:
    index = _one_term(width=1.0, cosine=0.9)
    planner = Planner(CandidateIndex(index), VIEW, AbrConfig(fill=False, epsilon=1.0, first_epsilon=1.0, parallax=0.01))
    look_at(planner, 0, [0.0, 0.0, -1.0])  # the Gaussian is seen along +z; the cone is around +x
    assert sum(len(batch.terms) for batch in drained(planner)) == 0
    assert planner.holdings.received.tolist() == [0]
    planner.aim(0, [0.0, 0.0, -1.0], ALL_ROUND, eyes=[[-1.0, 0.0, 0.0]])  # predicted
    assert sum(len(batch.terms) for batch in drained(planner)) == 0  # checked already, and the eye has not moved
    planner.aim(0, [-1.0, 0.0, 0.0], ALL_ROUND)
    assert sum(len(batch.terms) for batch in drained(planner)) == 1


def test_a_predicted_eye_brings_the_terms_that_it_will_need() -> None:
    index = _one_term(width=1.0, cosine=0.9)
    planner = Planner(CandidateIndex(index), VIEW, AbrConfig(fill=False, epsilon=1.0))
    planner.aim(0, [0.0, 0.0, -1.0], ALL_ROUND, eyes=[[-1.0, 0.0, 0.0]])
    assert sum(len(batch.terms) for batch in drained(planner)) == 1


def test_the_cell_ahead_brings_no_terms_for_the_eye_there() -> None:
    index = scenes.random_index(14, count=300, levels=1, cones=True)
    config = AbrConfig(fill=False, lead=0.0, ahead=1.0, epsilon=0.1, strong=())
    planner = Planner(CandidateIndex(index), VIEW, config)
    widest = float(np.float32(-np.log(config.epsilon) - 0.5 * np.log(3.6e-5)) + 0.5 * np.log(4 * np.pi))
    enters, count = False, 0
    for t in np.arange(0.0, 2.0, 0.1).tolist():
        eye = np.array([2.0 * t - 3.0, -2.0, -2.0], np.float32)
        planner.on_pose(t, eye, [1.0, 0.0, 0.0, 0.0])
        while len(batch := planner.next_batch(t, 1e6, 1e5)):
            for term in batch.terms.tolist():
                owner = np.searchsorted(index.term_offsets, term, side="right") - 1
                assert index.cones.active([term], index.means[owner], [eye], widest)[0]
                count += 1
        enters |= planner.cell_ahead != planner.cell
    assert enters
    assert count


def test_a_link_with_nothing_to_spare_is_not_filled() -> None:
    index = scenes.random_index(11, shape=(6, 3, 2), share=0.1)
    planner = Planner(CandidateIndex(index), VIEW)
    for k in range(200):
        planner.on_pose(k / 10, index.grid.centers[0], [1, 0, 0, 0])
        assert not planner.next_batch(k / 10, 4000.0, 1e5, spare=0.0).filling
    assert planner.filling
    assert not planner.done
    assert planner.next_batch(20.0, 4000.0, 1e5, spare=400.0).bytes <= 400.0
    planner.on_pose(21.0, index.grid.centers[-1], [1, 0, 0, 0])
    assert not planner.filling  # not known before the next batch


def test_the_cell_ahead_goes_before_other_neighbors() -> None:
    index = scenes.random_index(12, count=600, levels=1, shape=(3, 3, 1), share=0.15, most_terms=0)
    store = CandidateIndex(index)
    near = index.grid.neighbors(4).tolist()
    own = set(index.sets.classes(4)[0].tolist())
    for ahead in near:
        planner = Planner(store, VIEW, AbrConfig(policy="fov-first", fill=False))
        planner.aim(4, index.grid.centers[4], ALL_ROUND, cell_ahead=ahead)
        sent = [int(g) for batch in drained(planner) for g in batch.gaussians if int(g) not in own]
        theirs = set(index.sets.classes(ahead)[0].tolist())
        flags = [g in theirs for g in sent]
        assert flags == sorted(flags, reverse=True)
        assert any(flags)


@FEW
@given(st.integers(0, 10_000), st.sampled_from(["rgb", "hsl"]))
def test_cones_hold_all_eyes_for_which_a_term_is_active(seed, variant) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 4, 20)
    total, width = int(counts.sum()), 3 if variant == "rgb" else 1
    colors = SrbfColors(
        variant, rng.uniform(0.1, 0.9, (20, 3)), np.ones(20), np.append(0, np.cumsum(counts)),
        rng.integers(0, 1 if variant == "rgb" else 2, total), rng.uniform([0, -3], [3, 3], (total, 2)),
        rng.uniform(0.5, 40, total), rng.normal(0, 0.2, (total, width)),
    )  # fmt: skip
    means, eye, epsilon = rng.normal(0, 1, (20, 3)).astype(np.float32), rng.normal(0, 3, 3), 0.02
    activation = Activation(colors, means, epsilon)
    theta, phi = colors.centers.T
    centers = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    cones = TermCones(centers, np.arange(total), activation.least_cosines(), 1.0 / colors.decays)
    owners = np.repeat(np.arange(20), counts)
    inside = np.array([cones.active([t], means[owners[t]], [eye])[0] for t in range(total)], bool)
    active = activation.active(eye)
    assert not (active & ~inside).any()
    if variant == "rgb":
        close = np.abs(activation.contributions(eye) - epsilon) < 1e-4
        assert np.array_equal(active[~close], inside[~close])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"places": [3]}, "places"),
        ({"cosines": [np.nan]}, "cosines"),
        ({"cosines": [0.0, 0.0]}, "cosines"),
        ({"widths": [-1.0]}, "widths"),
        ({"centers": [[0.0, 1.0]]}, "centers"),
    ],
)
def test_cones_that_cannot_be_are_refused(change, message) -> None:
    good = {"centers": [[0.0, 0.0, 1.0]], "places": [0], "cosines": [0.5], "widths": [0.1]}
    arrays = {name: np.asarray(value) for name, value in (good | change).items()}
    with pytest.raises(ValueError, match=f"^{message}"):
        TermCones(**arrays)


def test_what_came_while_filling_is_not_sent_again_by_another_session() -> None:
    index = scenes.random_index(13, shape=(6, 3, 2), share=0.1, cones=True)
    store = CandidateIndex(index)
    first = Planner(store, VIEW)
    look_at(first, 0, [0.0, 0.0, 0.0])
    client = Holdings(len(index), index.num_terms)
    for _ in range(12):
        batch = first.take(2000.0)
        client.add(batch.gaussians, batch.terms, ids_of(first.holdings.gone))
    second = Planner(store, VIEW, holdings=client.copy())
    look_at(second, 0, [0.0, 0.0, 0.0])
    for batch in drained(second):
        client.add(batch.gaussians, batch.terms, batch.dropped)  # refuses what it has
    assert np.array_equal(client.received_terms, second.holdings.received_terms)


def _one_term(width: float, cosine: float) -> SceneIndex:
    index = scenes.random_index(0, count=64, levels=1, shape=(1, 1, 1), most_terms=1, share=1.0)
    big = 4.0 * np.ones(1, np.float32)
    cells = scenes.ArrayCells([(np.zeros(1, np.int64), np.zeros(1, np.uint8))], [np.zeros(1, np.int64)])
    cones = TermCones(
        np.array([[1.0, 0.0, 0.0]], np.float32), np.zeros(1, np.int32), np.array([cosine], np.float32),
        np.array([1e-3 * width], np.float32),
    )  # fmt: skip
    none = np.zeros(2, np.int64)
    return SceneIndex(
        np.zeros((1, 3), np.float32), big, big, np.ones(1, np.float32), 16.0 * np.ones(1, np.float32),
        np.zeros(1, np.uint8), np.zeros(1, np.uint8), ("all",), np.array([0, 1]), 4.5 * np.ones(1, np.float32), none,
        np.zeros(0, np.int32), np.ones(1, np.float32), index.grid, cells, active=cells, cones=cones,
    )  # fmt: skip
