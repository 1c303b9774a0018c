"""The order of records: the fast path against its slow twin, and the laws that any order keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr.batches import Batch
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import ADJACENT, FOV, NONE, PERIPHERAL, FieldOfView, classify
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.abr.outside import STEPS
from gsvis.abr.planner import Planner
from gsvis.abr.policies import POLICIES, REGIMES, UtilityConfig
from gsvis.abr.predict import exponential
from gsvis.abr.reference import View, order_records
from gsvis.files.cache import Cache
from gsvis.pvs.codec import ids_of
from gsvis.scene.gaussians import rotations_from_quats
from tests.abr import abr_scenes as scenes

VIEW = FieldOfView.from_degrees(80, 60, margin=15)
MIDDLE = FieldOfView.from_degrees(80, 60)
FEW = settings(max_examples=15)


def some_view(index, seed: int, regime: str = "high") -> View:
    rng = np.random.default_rng(seed)
    eye = rng.uniform(-3, 3, 3).astype(np.float32)
    cell = int(rng.integers(len(index.grid)))
    quats = rng.normal(size=(int(rng.integers(1, 3)), 4))
    planes = np.stack([VIEW.planes(eye, quat) for quat in quats])
    middle = np.stack([MIDDLE.planes(eye, quat) for quat in quats]) if rng.random() < 0.7 else None
    eyes = (eye + rng.normal(0, 0.5, (int(rng.integers(0, 3)), 3))).astype(np.float32)
    near = [cell, *index.grid.neighbors(cell).tolist()]
    return View(cell, eye, planes, regime, eyes, int(rng.choice(near)), middle)


def aimed(
    store: CandidateIndex,
    view: View,
    policy: str,
    holdings: Holdings | None = None,
    reach: float = 1e6,
    *,
    fill: bool = False,
    config: AbrConfig | None = None,
) -> Planner:
    planner = Planner(store, VIEW, config or AbrConfig(policy=policy, fill=fill), holdings=holdings)
    planner.reach = reach
    planner.aim(
        view.cell, view.eye, view.planes, view.regime, eyes=view.eyes, cell_ahead=view.cell_ahead, middle=view.middle,
        step=view.step,
    )  # fmt: skip
    return planner


def taken(planner: Planner, budgets: list[float]) -> list[Batch]:
    """Batches until nothing is left, with budgets one after the other."""
    out, k, empty = [], 0, 0
    while not planner.done and empty < len(budgets) + 1:
        out.append(planner.take(budgets[k % len(budgets)]))
        empty = 0 if len(out[-1]) else empty + 1
        k += 1
    return out


def joined(batches: list[Batch], name: str) -> list[int]:
    return [int(i) for batch in batches for i in getattr(batch, name)]


@FEW
@given(
    st.integers(0, 10_000), st.sampled_from(POLICIES), st.sampled_from(REGIMES), st.integers(1, 3), st.booleans(),
    st.booleans(), st.booleans(), st.booleans(), st.one_of(st.just(0), st.integers(1, STEPS - 1)),
)  # fmt: skip
def test_fast_and_slow_give_the_same_records_in_the_same_order(
    seed, policy, regime, levels, ordered, cones, fill, standing, step
):
    shape = (4, 3, 3) if fill else (3, 3, 2)
    index = scenes.random_index(
        seed, count=200, levels=levels, ordered=ordered, cones=cones, shape=shape, share=0.1 if fill else 0.4,
        standing=standing,
    )  # fmt: skip
    store = CandidateIndex(index)
    view = replace(some_view(index, seed, regime), step=step)
    rng = np.random.default_rng(seed)
    held = Holdings(len(index), index.num_terms)
    held.add(np.flatnonzero(rng.random(len(index)) < 0.2), np.zeros(0, np.int64), np.zeros(0, np.int64))
    picture, (replaced, covered) = float(rng.choice([0.0, 0.5, 1.0])), rng.choice([0.3, 0.6, 1.0], 2).tolist()
    utility = UtilityConfig(
        finer=float(rng.choice([0.01, 0.3, 1.0])), first=float(rng.choice([0.02, 1.0])),
        edge=float(rng.choice([0.1, 1.0])), change=float(rng.choice([4e-8, 1e-5, 1e-2])),
    )  # fmt: skip
    strong = [(), (1.0,), (30.0, 2.0, 0.5)][int(rng.integers(3))]
    config = AbrConfig(
        policy=policy, fill=fill, picture=picture, replaced=replaced, covered=covered, utility=utility, strong=strong
    )
    slow = order_records(store, view, policy, held, utility=utility, fill=fill, config=config)
    reach = float(rng.choice([1.0, 500.0, 1e9]))
    batches = taken(aimed(store, view, policy, held.copy(), reach, config=config), [1e9])
    assert joined(batches, "gaussians") == [i for kind, i in slow if kind == "gaussian"]
    assert joined(batches, "terms") == [i for kind, i in slow if kind == "term"]
    assert joined(batches, "dropped") == [i for kind, i in slow if kind == "drop"]


@FEW
@given(
    st.integers(0, 10_000),
    st.sampled_from(POLICIES),
    st.lists(st.floats(20, 3000), min_size=1, max_size=5),
    st.floats(1, 1e5),
)
def test_batches_together_are_one_order_whatever_their_sizes(seed, policy, budgets, reach) -> None:
    index = scenes.random_index(seed, count=300)
    store, view = CandidateIndex(index), some_view(index, seed)
    whole = taken(aimed(store, view, policy), [1e12])
    parts = taken(aimed(store, view, policy, reach=reach), budgets)
    for name in ("gaussians", "terms", "dropped"):
        assert joined(parts, name) == joined(whole, name)
    for k, batch in enumerate(parts):
        size = index.gaussian_bytes[batch.gaussians].sum() + index.term_bytes[batch.terms].sum()
        assert batch.bytes == pytest.approx(float(size))
        assert batch.bytes <= budgets[k % len(budgets)]


@settings(max_examples=6)
@given(st.integers(0, 10_000), st.sampled_from(POLICIES), st.sampled_from(REGIMES), st.floats(50, 3e4))
def test_what_is_beyond_reach_follows_in_the_same_order(seed, policy, regime, reach) -> None:
    index = scenes.random_index(seed, count=6000, shape=(2, 2, 1), share=0.7)
    store, view = CandidateIndex(index), some_view(index, seed, regime)
    assert len(store.in_cell(view.cell).runs.slots) > 90  # enough for a sample of them
    whole = taken(aimed(store, view, policy, reach=1e12), [1e12])
    parts = taken(aimed(store, view, policy, reach=reach), [4000.0])
    for name in ("gaussians", "terms", "dropped"):
        assert joined(parts, name) == joined(whole, name)


def test_a_walk_goes_on_as_in_the_next_second_and_a_new_cell_has_to_be_prepared_once() -> None:
    shared = CandidateIndex(scenes.random_index(0))
    planner, other = Planner(shared, VIEW, AbrConfig()), Planner(shared, VIEW, AbrConfig())
    assert planner.position_in(3.0) is None
    assert not planner.has_to_prepare
    for k in range(40):
        planner.on_pose(0.1 * k, [0.05 * k, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
    there = planner.position_in(3.0)
    assert there is not None
    assert np.allclose(there, [0.05 * 39 + 1.5, 0.0, 0.0], atol=0.02)
    other.on_pose(0.0, [0.05 * 39, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
    assert planner.cell == other.cell
    assert planner.has_to_prepare
    assert other.has_to_prepare
    planner.next_batch(4.0, 1e3, 1e6)
    assert not planner.has_to_prepare
    assert not other.has_to_prepare


def test_cells_that_see_nothing_have_nothing_to_send() -> None:
    index = scenes.random_index(8, count=100, share=0.0)
    planner = aimed(CandidateIndex(index), some_view(index, 8), "utility")
    assert len(planner.take(1e6)) == 0
    assert planner.done


@FEW
@given(st.integers(0, 10_000), st.floats(-8, 8), st.floats(-8, 8), st.floats(-8, 8))
def test_the_cell_of_a_position_is_the_one_it_is_in_or_the_nearest(seed, x, y, z) -> None:
    index, position = scenes.random_index(seed, count=10), np.array([x, y, z])
    inside = int(index.grid.cell_at(position[None])[0])
    apart = np.linalg.norm(index.grid.centers - position, axis=1)
    assert index.grid.nearest(position) == (inside if inside >= 0 else int(apart.argmin()))


@FEW
@given(st.integers(0, 10_000), st.sampled_from(POLICIES))
def test_nothing_is_sent_twice_over_a_walk_and_all_that_is_seen_arrives(seed, policy) -> None:
    index = scenes.random_index(seed)
    store = CandidateIndex(index)
    planner, client = Planner(store, VIEW, AbrConfig(policy=policy)), Holdings(len(index), index.num_terms)
    rng = np.random.default_rng(seed)
    reachable = np.unique(np.concatenate([index.sets.classes(cell)[0] for cell in range(len(index.grid))]))
    for step in range(6):
        view = some_view(index, seed + step, str(rng.choice(REGIMES)))
        planner.aim(view.cell, view.eye, view.planes, view.regime)
        while not planner.done:
            batch = planner.take(2000.0)
            owners = np.searchsorted(index.term_offsets, batch.terms, side="right") - 1
            client.add(batch.gaussians, batch.terms, batch.dropped)  # refuses what it has
            assert np.isin(owners, client.received).all()
            if batch.filling and not np.isin(batch.gaussians, reachable).all():  # what no cell sees comes last
                assert np.isin(reachable[index.last[reachable] == index.num_levels - 1], client.received).all()
        members = index.sets.classes(view.cell)[0]
        wanted = members[index.last[members] == index.num_levels - 1]
        assert np.isin(wanted, client.received).all()
        active = index.active.active_ids(view.cell)
        owners = np.searchsorted(index.term_offsets, active, side="right") - 1
        assert np.isin(active[np.isin(owners, wanted)], client.received_terms).all()
    assert all(np.array_equal(a, b) for a, b in zip(client.words[:2], planner.holdings.words[:2], strict=True))
    assert np.array_equal(client.shown, planner.holdings.shown)


@FEW
@given(st.integers(0, 10_000), st.sampled_from(("medium", "low")))
def test_those_of_a_level_alone_go_when_enough_of_what_replaces_them_is_there(seed, regime) -> None:
    index = scenes.random_index(seed)
    store, view = CandidateIndex(index), some_view(index, seed, regime)
    share = float(np.random.default_rng(seed).choice([0.3, 0.6, 1.0]))
    planner = aimed(
        store, view, "fov-first", config=AbrConfig(policy="fov-first", fill=False, replaced=share, covered=share)
    )
    candidates = ids_of(store.in_cell(view.cell).union)
    while not planner.done:
        batch = planner.take(400.0)
        received = planner.holdings.received
        for x in batch.dropped.tolist():
            low, high = index.replacement_offsets[x : x + 2]
            wanted = np.intersect1d(index.replacement_ids[low:high], candidates)
            there = np.isin(wanted, np.union1d(received, ids_of(planner.holdings.gone)))
            assert index.areas[wanted[there]].sum() >= (share - 1e-5) * index.areas[wanted].sum()
    shown = planner.holdings.shown
    for x in shown[index.last[shown] < index.num_levels - 1].tolist():  # nothing that is replaced stays
        low, high = index.replacement_offsets[x : x + 2]
        assert not np.isin(index.replacement_ids[low:high], candidates).any()


@FEW
@given(st.integers(0, 10_000), st.sampled_from(("medium", "low")), st.booleans())
def test_none_waits_for_longer_than_it_has_to_while_views_change(seed, regime, fill) -> None:
    """What a batch replaces in part stays only if more than the spare share of area is missing."""
    index, rng = scenes.random_index(seed), np.random.default_rng(seed)
    store, view = CandidateIndex(index), some_view(index, seed, regime)
    share = float(rng.choice([0.3, 0.6, 1.0]))
    planner = aimed(store, view, "utility", config=AbrConfig(fill=fill, replaced=share, covered=share))
    near = [view.cell, *index.grid.neighbors(view.cell).tolist()]
    replaced = np.repeat(np.arange(len(index)), np.diff(index.replacement_offsets))
    for _ in range(20):
        batch = planner.take(300.0)
        held, gone = planner.holdings.received, ids_of(planner.holdings.gone)
        candidates = ids_of(planner._cursor.cell.candidates)
        for x in np.unique(replaced[np.isin(index.replacement_ids, batch.gaussians)]).tolist():
            low, high = index.replacement_offsets[x : x + 2]
            wanted = np.intersect1d(index.replacement_ids[low:high], candidates)
            missing = wanted[~np.isin(wanted, np.union1d(held, gone))]
            enough = index.areas[missing].sum() <= (1.0 - share - 1e-5) * index.areas[wanted].sum()
            assert x in gone or not enough
        if rng.random() < 0.5:
            other = some_view(index, int(rng.integers(1000)), regime)
            planner.aim(view.cell, other.eye, other.planes, regime, eyes=other.eyes, cell_ahead=int(rng.choice(near)))


@FEW
@given(st.integers(0, 10_000))
def test_under_high_bandwidth_nothing_is_sent_that_the_highest_level_has_not(seed) -> None:
    index = scenes.random_index(seed)
    store, view = CandidateIndex(index), some_view(index, seed)
    found = joined(taken(aimed(store, view, "utility"), [1e9]), "gaussians")
    assert (index.last[found] == index.num_levels - 1).all()
    candidates = ids_of(store.in_cell(view.cell).union)
    assert sorted(found) == candidates[index.last[candidates] == index.num_levels - 1].tolist()


@FEW
@given(st.integers(0, 10_000), st.sampled_from(POLICIES), st.sampled_from(REGIMES))
def test_a_first_picture_is_of_what_is_in_view_and_without_terms(seed, policy, regime) -> None:
    index = scenes.random_index(seed, count=300, cones=True)
    store, view = CandidateIndex(index), some_view(index, seed, regime)
    config = AbrConfig(policy=policy, fill=False, picture=1.0)
    batches = taken(aimed(store, view, policy, config=config), [1e9])
    found = np.array(joined(batches, "gaussians"), np.int64)
    owners = np.repeat(np.arange(len(index)), np.diff(index.term_offsets))
    picture = found[index.last[found] < index.num_levels - 1]
    inside = classify(index, view.cell, view.planes).classes == FOV
    wanted = inside & (index.last < index.num_levels - 1) & (index.first <= index.highest_within(1.0))
    assert set(picture.tolist()) <= set(np.flatnonzero(wanted).tolist())
    assert not np.isin(owners[joined(batches, "terms")], picture).any()


def test_a_level_is_a_first_picture_if_it_has_few_gaussians() -> None:
    index = scenes.random_index(1, count=400, levels=3)
    low, medium, high = index.level_counts
    assert index.highest_within(0.99 * low / high) == -1
    assert index.highest_within(low / high) == 0
    assert index.highest_within(1.0) == (1 if medium <= high else 0)
    assert index.highest_within(0.0) == -1


@FEW
@given(st.integers(0, 10_000))
def test_the_orders_of_the_paper(seed) -> None:
    index = scenes.random_index(seed, most_terms=0)
    store, view = CandidateIndex(index), replace(some_view(index, seed, "low"), cell_ahead=None)
    found = classify(index, view.cell, view.planes)
    for policy, head in (
        ("fov-first", [(FOV, 0), (FOV, 1), (PERIPHERAL, 0)]),
        ("low-first", [(FOV, 0), (PERIPHERAL, 0), (FOV, 1)]),
    ):
        ids = np.array(joined(taken(aimed(store, view, policy), [1e9]), "gaussians"), np.int64)
        groups = list(zip(found.classes[ids].tolist(), index.first[ids].tolist(), strict=True))
        ranks = [groups.index(pair) for pair in head if pair in groups]
        if policy == "low-first":
            assert ranks == sorted(ranks)
        runs = [pair for k, pair in enumerate(groups) if k == 0 or pair != groups[k - 1]]
        adjacent = [k for k, pair in enumerate(runs) if pair[0] == ADJACENT]
        assert len([pair for pair in runs if pair[0] != ADJACENT]) == len(
            {pair for pair in runs if pair[0] != ADJACENT}
        )
        assert NONE not in found.classes[ids]
        low = [k for k in adjacent if runs[k][1] == 0]
        beyond = [k for k, pair in enumerate(runs) if pair[0] == PERIPHERAL and pair[1] > 0]
        assert not low or not beyond or min(beyond) > min(low)  # what is above goes last under low bandwidth
        for level in range(3):
            distances = found.distances[ids[(found.classes[ids] == ADJACENT) & (index.first[ids] == level)]]
            assert (np.diff(distances) >= 0).all()


@given(st.integers(0, 10_000))
def test_in_view_or_not_follows_from_the_corners_of_the_image(seed) -> None:
    rng = np.random.default_rng(seed)
    eye, quat = rng.normal(0, 3, 3), rng.normal(size=4)
    fov = FieldOfView(*rng.uniform(0.2, 2.0, 4), near=0.1)
    planes = fov.planes(eye, quat).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(planes[:, :3], axis=1), 1.0, rtol=1e-6)
    turn = rotations_from_quats(quat[None] / np.linalg.norm(quat))[0]
    local = rng.normal(0, 2, (200, 3))
    x, y, z = local.T
    expected = (z > 0.1) & (x < fov.right * z) & (-x < fov.left * z) & (y < fov.bottom * z) & (-y < fov.top * z)
    points = local @ turn.T + eye
    far = points @ planes[:, :3].T + planes[:, 3]
    sure = np.abs(far).min(axis=1) > 1e-4
    assert np.array_equal((far > 0).all(axis=1)[sure], expected[sure])


def test_a_margin_moves_each_border_by_its_angle() -> None:
    tangents, margin, pose = np.array([0.3, 0.9, 0.6, 1.4]), 0.2, ([1.0, -2.0, 0.5], [0.9, 0.1, -0.3, 0.2])
    wider = FieldOfView(*np.tan(np.arctan(tangents) + margin)).planes(*pose)
    np.testing.assert_allclose(FieldOfView(*tangents, margin=margin).planes(*pose), wider, atol=1e-6)


def test_a_wider_margin_only_adds() -> None:
    index = scenes.random_index(3)
    before = None
    for margin in (0.0, 5.0, 20.0, 60.0):
        planes = FieldOfView.from_degrees(60, 40, margin=margin).planes([0, 0, 0], [1, 0.2, 0.1, 0])
        inside = classify(index, 0, planes).classes == FOV
        assert before is None or not (before & ~inside).any()
        before = inside


def test_utility_prefers_what_is_near_large_and_in_view() -> None:
    index = scenes.random_index(5, count=3000, levels=1, most_terms=0, share=1.0)
    store = CandidateIndex(index)
    view = some_view(index, 5)
    ids = np.array(joined(taken(aimed(store, view, "utility"), [1e9]), "gaussians"), np.int64)
    apart = np.maximum(np.linalg.norm(index.means[ids] - view.eye, axis=1), 0.3)
    gain = index.areas[ids] / apart**2 / index.gaussian_bytes[ids]
    inside = classify(index, view.cell, view.planes).classes[ids] == FOV
    tenth = len(ids) // 10
    assert np.median(gain[:tenth]) > 2 * np.median(gain[-tenth:])
    assert inside[:tenth].mean() > inside[-tenth:].mean()


@FEW
@given(st.integers(0, 10_000), st.sampled_from(REGIMES))
def test_terms_that_change_the_image_more_go_first(seed, regime) -> None:
    index = scenes.random_index(seed, count=300, levels=1, cones=True)
    store, view = CandidateIndex(index), some_view(index, seed, regime)
    strong, everything = (50.0, 5.0), (1e9,)
    orders = {}
    for steps in ((), strong):
        config = AbrConfig(fill=False, strong=steps, utility=UtilityConfig(change=1.0))
        orders[steps] = joined(taken(aimed(store, view, "utility", config=config), list(everything)), "terms")
    assert sorted(orders[()]) == sorted(orders[strong])  # another order of the same terms
    owners = np.searchsorted(index.term_offsets, orders[strong], side="right") - 1
    planner = aimed(store, view, "utility", config=AbrConfig(fill=False, first_epsilon=50.0, epsilon=50.0, strong=()))
    most = set(joined(taken(planner, list(everything)), "terms"))
    held = set()
    for t, g in zip(orders[strong], owners.tolist(), strict=True):  # those of a Gaussian: the strongest before others
        rest = set(range(*index.term_offsets[g : g + 2].tolist())) & (most - held)
        assert t in most or not rest
        held.add(t)


@pytest.mark.parametrize("strong", [(1.0, 4.0), (2.0, 2.0), (0.0,), (float("inf"),), tuple(range(9, 1, -1))])
def test_multiples_of_epsilon_fall(strong) -> None:
    with pytest.raises(ValueError, match="falling"):
        AbrConfig(strong=strong)


def test_budgets_that_fit_nothing_give_nothing() -> None:
    index = scenes.random_index(1)
    planner = Planner(CandidateIndex(index), VIEW)
    assert len(planner.take(1e6)) == 0  # no view yet
    view = some_view(index, 1)
    planner.aim(view.cell, view.eye, view.planes)
    assert len(planner.take(0.0)) == 0
    assert len(planner.take(5.0)) == 0
    assert len(planner.take(1e6)) > 0


def test_candidates_of_cells_are_kept_within_bounds() -> None:
    index = scenes.random_index(2)
    largest = max(CandidateIndex(index).in_cell(cell).nbytes for cell in range(len(index.grid)))
    store = CandidateIndex(index, cache=Cache(2 * largest))
    for cell in range(len(index.grid)):
        assert store.in_cell(cell) is store.in_cell(cell)
        assert store.cache.nbytes <= 2 * largest
    assert store.cache.find(("candidates", 0, 0)) is None


def test_a_planner_keeps_the_candidates_of_its_cell_when_no_cache_has_room() -> None:
    index, built = scenes.random_index(2), []
    store = CandidateIndex(index, cache=Cache(0))
    planner, plain = Planner(store, VIEW), Planner(CandidateIndex(index), VIEW)
    build = store.build
    store.build = lambda cell, step: built.append(cell) or build(cell, step)
    for k in range(6):
        for client in (planner, plain):
            client.on_pose(k / 10, index.grid.centers[0], [1, 0.3 * k, 0, 0])
        a, b = planner.next_batch(k / 10, 500.0, 1e5), plain.next_batch(k / 10, 500.0, 1e5)
        assert a.gaussians.tolist() == b.gaussians.tolist()
        assert a.terms.tolist() == b.terms.tolist()
    assert planner.plans > 1
    assert len(built) == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda i: AbrConfig(policy="best"), "policy"),
        (lambda i: Planner(CandidateIndex(i), VIEW, holdings=Holdings(1)), "holdings"),
        (lambda i: Planner(CandidateIndex(i), VIEW).take(np.nan), "budget"),
        (lambda i: CandidateIndex(i, pixel=np.nan), "pixel"),
        (lambda i: CandidateIndex(i).in_cell(10_000), "cell"),
        (lambda i: UtilityConfig(peripheral=0.0), "peripheral"),
        (lambda i: UtilityConfig(beyond=1.01), "beyond"),
        (lambda i: UtilityConfig(medium=0.99), "medium"),
        (lambda i: UtilityConfig(medium=4.01), "medium"),
        (lambda i: UtilityConfig(low=0.99), "low"),
        (lambda i: UtilityConfig(low=4.01), "low"),
        (lambda i: UtilityConfig(edge=0.0), "edge"),
        (lambda i: UtilityConfig(change=0.0), "change"),
        (lambda i: UtilityConfig(change=np.nan), "change"),
        (lambda i: FieldOfView.from_degrees(190, 20), "horizontal"),
        (lambda i: FieldOfView(1, 1, 1, 1, margin=np.nan), "margin"),
    ],
)
def test_wrong_arguments_are_named(make, message) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        make(scenes.random_index(0, count=50))


@pytest.mark.parametrize("power", [1.0, 4.0])
def test_powers_may_be_at_the_ends_of_their_range(power: float) -> None:
    config = UtilityConfig(medium=power, low=power, peripheral=1e-6, adjacent=1.0)
    assert (config.medium, config.low) == (power, power)


def test_records_are_ranked_anew_only_when_the_view_has_changed() -> None:
    index = scenes.random_index(4)
    planner = Planner(CandidateIndex(index), VIEW, AbrConfig(lead=0.0))
    for k in range(20):
        planner.on_pose(k / 10, [0.2, 0.2, 0.2], exponential(np.array([0, 1e-3 * k, 0])))
        planner.next_batch(k / 10, 300.0, 1e5)
    assert planner.plans == 1
    planner.on_pose(3.0, [0.2, 0.2, 0.2], exponential(np.array([0, 0.5, 0])))
    planner.next_batch(3.0, 300.0, 1e5)
    assert planner.plans == 2


def test_poses_of_every_kind() -> None:
    index = scenes.random_index(6)
    planner = Planner(CandidateIndex(index), VIEW)
    assert len(planner.next_batch(0.0, 1e6, 1e5)) == 0
    for position, quat in (([np.nan] * 3, [1, 0, 0, 0]), ([0, 0, 0], [np.inf, 0, 0, 0]), ([0, 0, 0], [0, 0, 0, 0])):
        with pytest.raises(ValueError, match="expected"):
            planner.on_pose(0.0, position, quat)
    assert planner.cell == -1
    planner.on_pose(1.0, [1e8, -1e8, 0], [1, 0, 0, 0])  # far outside of all cells: the nearest serves
    assert 0 <= planner.cell < len(index.grid)
    assert len(planner.next_batch(1.0, 1e6, 1e5)) > 0
    cell = planner.cell
    planner.on_pose(0.5, index.grid.centers[0], [1, 0, 0, 0])  # late
    assert planner.cell == cell


def test_a_frustum_begins_within_a_part_of_a_cell_in_any_units() -> None:
    view = FieldOfView.from_degrees(90, 70)
    assert view.in_cells(0.5) == view
    assert view.in_cells(1e-3).near <= 1e-3 / 8
    assert view.in_cells(1e3).near == view.near
