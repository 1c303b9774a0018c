"""Kernels that take records, each against its plain twin, and bounds that only save work."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from gsvis.abr import reference
from gsvis.abr._kernels.lanes import not_behind
from gsvis.abr._kernels.plan import UNITS
from gsvis.abr._kernels.take import bound, is_left, widen
from gsvis.abr._kernels.units import Seen
from gsvis.abr.batches import Batch
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.abr.planner import Planner
from gsvis.pvs.codec import ids_of, pack, pack_some
from tests.abr import abr_scenes as scenes

FEW = settings(max_examples=12)
N = 200
SETS = st.sets(st.integers(0, N - 1))


def held_of(gaussians: set[int], gone: set[int]) -> Holdings:
    holdings = Holdings(N)
    holdings.sent[:], holdings.gone[:] = pack(np.array(sorted(gaussians), np.int64), N), words(gone)
    return holdings


def words(ids: set[int]) -> np.ndarray:
    return pack(np.array(sorted(ids), np.int64), N)


def seen_of(ids: set[int] | np.ndarray) -> Seen:
    return Seen(*pack_some(np.array(sorted(ids), np.int64)))


@given(SETS, SETS, SETS, SETS, SETS)
def test_what_is_left_of_cells_is_what_the_plain_twin_says(
    wanted: set[int], others: set[int], held: set[int], gone: set[int], owed: set[int]
) -> None:
    seen = seen_of(wanted | others)
    allowed = np.empty_like(seen.masks)
    found = is_left(seen, words(wanted), held_of(held, gone).words, words(owed)[seen.words], allowed)
    assert found == reference.is_left(wanted, held, gone, owed)
    assert allowed.tolist() == words(wanted)[seen.words].tolist()
    without = is_left(seen, words(wanted), held_of(held, gone).words, words(set())[:0], allowed)
    assert without == reference.is_left(wanted, held, gone, set())


@FEW
@given(st.integers(0, 10_000))
def test_others_that_have_arrived_before_make_what_they_replace_due(seed: int) -> None:
    index, rng = scenes.random_index(seed), np.random.default_rng(seed)
    links, n = CandidateIndex(index).tables.links, len(index)
    some, others, held, gone = (rng.permutation(n)[: int(rng.integers(n))] for _ in range(4))
    holdings, candidates = Holdings(n, index.num_terms), pack(np.sort(some), n)
    holdings.sent[:], holdings.gone[:] = pack(np.sort(held), n), pack(np.sort(gone), n)
    looks = np.full(len(links.ending), 7, np.int32)
    widen(candidates, seen_of(others), holdings.words, links, looks)
    assert ids_of(candidates).tolist() == np.union1d(some, others).tolist()
    fresh = np.intersect1d(np.setdiff1d(others, some), np.union1d(held, gone))
    for x, look in zip(links.ending.tolist(), looks.tolist(), strict=True):
        low, high = index.replacement_offsets[x : x + 2]
        assert look == (0 if np.isin(index.replacement_ids[low:high], fresh).any() else 7)


@FEW
@given(st.integers(0, 10_000), st.sampled_from([0.3, 0.6, 1.0]))
def test_bounds_hold_whatever_has_arrived(seed: int, share: float) -> None:
    index, rng = scenes.random_index(seed), np.random.default_rng(seed)
    links, n = CandidateIndex(index).tables.links, len(index)
    candidates = rng.permutation(n)[: int(rng.integers(n))]
    room, *found = np.zeros((4, len(links.ending)), np.int32)
    count = bound(seen_of(candidates), links, index.last, np.full(index.num_levels, share), room, *found)
    assert not room.any()
    bounds = {e: (least, sure) for e, least, sure in np.stack(found)[:, :count].T.tolist()}
    assert len(bounds) == count
    for _ in range(5):
        arrived = set(rng.permutation(n)[: int(rng.integers(n))].tolist())
        for e, x in enumerate(links.ending.tolist()):
            ids = links.ids[links.starts[e] : links.starts[e + 1]]
            areas = links.areas[links.starts[e] : links.starts[e + 1]].astype(np.float64)
            units = int(np.ceil(UNITS * areas / links.every[e])[np.isin(ids, list(arrived))].sum())
            is_dropped = reference.is_dropped(x, index, set(candidates.tolist()), arrived, share)
            least, sure = bounds.get(e, (-1, 2**31))  # nothing is known of those without candidates
            assert is_dropped or units < sure
            assert not is_dropped or units >= least


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("replaced", [0.3, 0.6, 1.0])
def test_bounds_change_no_batch(seed: int, replaced: float, monkeypatch: pytest.MonkeyPatch) -> None:
    index = scenes.random_index(seed, count=400)

    def batches() -> list[Batch]:
        rng, found = np.random.default_rng(seed), []
        planner = Planner(CandidateIndex(index), FieldOfView.from_degrees(80, 60), AbrConfig(replaced=replaced))
        for k in range(40):
            turn = rng.normal(size=4)
            planner.on_pose(0.1 * k, index.grid.centers[k // 10 % len(index.grid)], turn)
            found.append(planner.next_batch(0.1 * k, 500.0, 5000.0))
        return found

    ours = batches()
    monkeypatch.setattr(CandidateIndex, "bounds_of", lambda *args, **options: None)
    plain = batches()
    for name in ("gaussians", "terms", "dropped"):
        for mine, theirs in zip(ours, plain, strict=True):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("replaced", "memory"), [(0.3, None), (1.0, None), (0.3, 2500.0)])
def test_counting_what_arrives_changes_no_batch(seed: int, replaced: float, memory: float | None) -> None:
    """Batches of single records, with checks of every replacement; cells, filling and evictions on the way."""
    index = scenes.random_index(seed, count=300)

    def batches(*, checked: bool) -> list[Batch]:
        rng, found = np.random.default_rng(seed), []
        planner = Planner(
            CandidateIndex(index), FieldOfView.from_degrees(80, 60), AbrConfig(replaced=replaced), memory=memory
        )
        cells = rng.integers(len(index.grid), size=8)
        for k in range(240):
            if k % 3 == 0:
                planner.on_pose(0.1 * k, index.grid.centers[cells[k // 30]], rng.normal(size=4))
            if checked:
                replacements = planner._cells.replacements
                for looks in (replacements.looks, replacements.looks_far, replacements.sure):
                    looks[:] = 0
            found.append(planner.next_batch(0.1 * k, 40.0, 5000.0))
        return found

    ours, plain = batches(checked=False), batches(checked=True)
    assert sum(len(batch.dropped) for batch in ours)
    assert memory is None or sum(len(batch.evicted) for batch in ours)
    for name in ("gaussians", "terms", "dropped", "evicted"):
        for mine, theirs in zip(ours, plain, strict=True):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))


@given(st.integers(0, 10_000), st.integers(0, 3))
def test_a_plane_has_the_spheres_behind_it_that_numpy_finds(seed: int, word: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, z, radii = rng.normal(size=(4, 256)).astype(np.float32)
    a, b, c, d = rng.normal(size=4).astype(np.float32)
    radii[::7] = -(a * x + b * y + c * z + d)[::7]  # touching
    x[::31] = np.nan
    found = int(bits_in_front(x, y, z, radii, 64 * word, a, b, c, d))
    far = (a * x + b * y + c * z + d + radii)[64 * word : 64 * word + 64]
    assert [bool(found >> k & 1) for k in range(64)] == (~(far < 0)).tolist()


@njit
def bits_in_front(x, y, z, radii, low, a, b, c, d):
    return not_behind(x, y, z, radii, low, (a, b, c, d))
