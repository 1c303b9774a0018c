"""Certificates: known answers, laws of sets and of rays, coverage, the plain twin, and the second tracer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsvis._extras import has
from gsvis.errors import BackendError
from gsvis.pvs.bound import staged_bound, upper_bound
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.certificate import (
    Certificate,
    CertificateConfig,
    Certifier,
    heaviest_hits,
)
from gsvis.pvs.reference import missed_light_reference
from gsvis.pvs.viewpoints import CellViewpoints, FreeVoxels
from gsvis.raycast import EllipsoidProxies, Tracer, compare, cross_check
from gsvis.raycast.reference import brute_force_contributions
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from gsvis.scene.repeats import first_equal
from gsvis.scene.solid import buried
from tests.pvs.violations import most_violations

F64 = NDArray[np.float64]
QUICK = CertificateConfig(limit=0.0, rays=600, round_rays=256)


@cache
def rooms() -> tuple[Certifier, CellViewpoints]:
    scene = two_rooms(1200, sh_degree=0)
    grid = CellGrid.over(scene.navigable, max_cells=8)
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(scene.gaussians)))
    return certifier, CellViewpoints(grid, scene.navigable)


def tracer() -> Tracer:
    return rooms()[0].tracer


def certified(
    ids: Sequence[int] | NDArray[np.int64],
    config: CertificateConfig = QUICK,
    *,
    cell: int = 2,
    stage: int = 0,
    earlier: Sequence[Certificate] = (),
) -> Certificate:
    certifier, viewpoints = rooms()
    found = certifier.certify(viewpoints.voxels(cell), ids, config, stage=stage, earlier=earlier)
    assert found is not None
    return found


def everything() -> NDArray[np.int64]:
    return np.arange(len(tracer().proxies.gaussians))


def one_cell() -> FreeVoxels:
    space = NavigableSpace.from_box((-1, -1, -1), (1, 1, 1), 4)
    return CellViewpoints(CellGrid.over(space, max_cells=1), space).voxels(0)


def half_space() -> Certifier:
    """Two opaque discs without end, one above and one below a room: each ray ends on one of them."""
    flat = [[1e6, 1e6, 1e-3]] * 2
    g = Gaussians([[0, 0, 2], [0, 0, -2]], [[1, 0, 0, 0]] * 2, flat, [1.0, 1.0], np.zeros((2, 1, 3)))
    return Certifier(Tracer(EllipsoidProxies.from_scene(g)))


def test_a_set_of_everything_misses_nothing_and_its_bound_is_that_of_nothing_missed() -> None:
    found = certified(everything())
    assert found.missed == 0.0
    assert found.bound == staged_bound([(np.zeros(600), found.weights)])
    assert found.bound < 1.2 * upper_bound(np.zeros(600), found.weights)
    assert len(found.worst_o) == len(found.ids) == 0
    assert found.rounds == 3


def test_an_empty_set_misses_everything() -> None:
    found = certified([])
    assert found.missed == pytest.approx(1.0)
    assert found.bound == pytest.approx(1.0)
    assert np.array_equal(found.missed_weights, found.weights)
    assert found.heavy == 1.0


def test_half_of_the_light_is_missed_where_half_of_the_world_is() -> None:
    found = half_space().certify(one_cell(), [0], CertificateConfig(limit=0.0, rays=4000))
    assert found is not None
    assert found.missed == pytest.approx(0.5, abs=0.03)  # 4 standard deviations
    assert 0.5 < found.bound < 0.56
    assert found.ids.tolist() == [1]
    assert np.all(found.worst_d[:, 2] < 0.0)
    assert set(np.round(found.missed_weights, 2)) == {0.0, 1.0}


def test_rays_that_meet_nothing_do_not_count_and_are_not_drawn_where_nothing_lies() -> None:
    g = half_space().tracer.proxies.gaussians[:1]  # rays down leave the world
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(g)))

    def everywhere(count: int, rng: np.random.Generator) -> tuple[F64, F64]:
        directions = rng.normal(size=(count, 3))
        return rng.uniform(-1, 1, (count, 3)), directions / np.linalg.norm(directions, axis=1, keepdims=True)

    around, aimed = certifier.certify_rays(everywhere, [], QUICK), certifier.certify(one_cell(), [], QUICK)
    assert around is not None
    assert aimed is not None
    assert 0.4 < np.mean(around.weights > 0.0) < 0.6
    assert np.mean(aimed.weights > 0.0) > 0.99
    assert around.missed == aimed.missed == 1.0


def test_there_are_more_rays_where_few_meet_something_but_not_without_end() -> None:
    g = Gaussians([[6, 0, 0]], [[1, 0, 0, 0]], [[0.2, 0.2, 0.2]], [0.9], np.zeros((1, 1, 3)))
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(g)))
    counts = []
    for sparse in (1, 3, 16):
        found = certifier.certify(
            one_cell(), [0], CertificateConfig(limit=0.0, rays=600, round_rays=256, sparse=sparse)
        )
        assert found is not None
        factor = min(sparse, round(1.0 / found.weights.mean()))
        assert factor * 600 * 0.8 <= len(found) <= sparse * 600
        counts.append(len(found))
    assert counts[:2] == [600, 1800]
    assert counts == sorted(counts)


def test_a_larger_set_never_misses_more() -> None:
    ids = everything()
    small, large = certified(ids[::3]), certified(np.union1d(ids[::3], ids[::2]))
    assert np.all(large.missed_weights <= small.missed_weights)
    assert np.array_equal(large.weights, small.weights)
    assert large.bound <= small.bound


def test_what_is_missed_is_listed_and_adding_it_brings_the_light_back() -> None:
    ids = everything()[::2]
    found = certified(ids)
    assert len(found.ids)
    assert not np.isin(found.ids, ids).any()
    assert np.all(np.diff(found.ids) > 0)
    assert np.all(found.id_weights >= np.float32(QUICK.tau))
    better = certified(np.union1d(ids, found.ids))
    assert better.missed < 0.02 * found.missed
    assert np.all(better.missed_weights < 256 * QUICK.tau)
    assert len(better.ids) == 0


def test_the_worst_rays_come_first_and_miss_what_they_say() -> None:
    ids = everything()[::2]
    found = certified(ids)
    assert len(found.worst_o) == QUICK.worst
    assert np.all(np.diff(found.worst_missed) <= 0.0)
    assert found.worst_missed[0] == found.missed_weights.max()
    hits = tracer().contributions(found.worst_o, found.worst_d)
    lost = ~np.isin(hits.gaussian_ids, ids)
    again = np.bincount(hits.ray_ids[lost], hits.weights[lost], len(hits))
    assert again == pytest.approx(found.worst_missed)


def test_the_plain_twin_finds_the_same() -> None:
    ids = everything()[::2]
    found = certified(ids, CertificateConfig(limit=0.0, rays=40, checked=40))
    plain = missed_light_reference(tracer().proxies.gaussians, set(ids.tolist()), found.checked_o, found.checked_d)
    assert found.missed_weights == pytest.approx(np.array([missed for missed, _ in plain]), abs=1e-5)
    assert found.weights == pytest.approx(np.array([whole for _, whole in plain]), abs=1e-5)


def test_rays_start_in_the_cell_outside_everything_solid_and_look_everywhere() -> None:
    found = certified(everything()[::2], CertificateConfig(limit=0.0, rays=2000, checked=2000))
    viewpoints = rooms()[1]
    assert np.all(viewpoints.grid.cell_at(found.checked_o) == 2)
    assert np.all(viewpoints.space.contains(found.checked_o))
    assert not buried(tracer().proxies.gaussians, found.checked_o).any()
    assert not np.isin(found.checked_o, viewpoints.spread(2, 50)).any()
    assert np.linalg.norm(found.checked_d, axis=1) == pytest.approx(1.0)
    assert np.abs(found.checked_d.mean(axis=0)).max() < 0.06
    assert np.abs(found.checked_d.T @ found.checked_d / 2000 - np.eye(3) / 3).max() < 0.04


def test_rays_depend_on_seed_cell_stage_and_round_alone() -> None:
    ids = everything()[::2]
    config = CertificateConfig(limit=0.0, rays=600, round_rays=300, checked=600)
    one, again = certified(ids, config), certified(ids, config)
    assert np.array_equal(one.checked_o, again.checked_o)
    assert np.array_equal(one.missed_weights, again.missed_weights)
    others = [
        certified(ids, config, stage=1),
        certified(ids, config, cell=3),
        certified(ids, CertificateConfig(limit=0.0, rays=600, round_rays=300, checked=600, seed=1)),
    ]
    for each in others:
        assert not np.isin(each.checked_d, one.checked_d).any()
    assert not np.isin(one.checked_d[:300], one.checked_d[300:]).any()


def test_rounds_end_when_the_bound_is_low_enough_or_the_rays_are_spent() -> None:
    ids = everything()
    config = CertificateConfig(limit=0.01, rays=5000, round_rays=128)
    found = certified(ids, config)
    assert found.bound <= 0.01
    assert len(found) == 128 * found.rounds < 5000
    assert staged_bound([(found.missed_weights[:-128], found.weights[:-128])]) > 0.01
    spent = certified(ids, CertificateConfig(limit=1e-4, rays=1000, round_rays=128))
    assert len(spent) == 1000
    assert spent.rounds == 8
    assert spent.bound > 1e-4


def test_rounds_end_when_the_estimate_is_above_the_limit() -> None:
    ids = everything()
    config = CertificateConfig(limit=0.01, rays=5000, round_rays=128)
    hopeless = certified(ids[::2], config)
    assert hopeless.rounds == 1
    assert hopeless.missed > 0.01
    share = staged_bound([(hopeless.missed_weights, hopeless.weights)])
    assert hopeless.bound == share > 0.01
    assert len(certified(ids[::2], CertificateConfig(limit=0.0, rays=1000, round_rays=128))) == 1000


@cache
def light(cell: int) -> F64:
    """(N,) the weight of each Gaussian on 10,240 rays of a cell that no other test traces."""
    many = certified(
        [], CertificateConfig(limit=0.0, rays=10_240, round_rays=10_240, checked=10_240, seed=99), cell=cell
    )
    hits = tracer().contributions(many.checked_o, many.checked_d)
    return np.bincount(hits.gaussian_ids, hits.weights, len(everything()))


def true_share(ids: NDArray[np.int64], cell: int) -> float:
    """The light that a set misses, by many more rays."""
    held = np.isin(everything(), ids)
    return float(light(cell)[~held].sum() / light(cell).sum())


def test_the_light_of_many_more_rays_is_what_a_certificate_of_them_says() -> None:
    ids = everything()[::2]
    many = certified(ids, CertificateConfig(limit=0.0, rays=10_240, round_rays=10_240, seed=99), cell=1)
    assert many.missed == pytest.approx(true_share(ids, 1), rel=1e-4)


def test_the_light_of_many_more_rays_lies_below_the_bound() -> None:
    rng = np.random.default_rng(0)
    violations, trials = 0, 60
    for trial in range(trials):
        kept = np.flatnonzero(rng.random(len(everything())) < (0.999, 0.99, 0.9)[trial % 3])
        found = certified(kept, CertificateConfig(limit=0.002, rays=512, round_rays=128, seed=trial), cell=trial % 6)
        violations += true_share(kept, trial % 6) > found.bound
    assert violations <= most_violations(trials)


def test_rays_depend_on_free_voxels_and_number_of_a_cell_not_on_the_grid_around_it() -> None:
    certifier, viewpoints = rooms()
    voxels = viewpoints.voxels(2)
    alone = FreeVoxels(2, voxels.voxels.copy(), voxels.origin.copy(), voxels.voxel_size)
    found = certifier.certify(alone, everything()[::2], QUICK)
    assert found is not None
    assert np.array_equal(found.missed_weights, certified(everything()[::2]).missed_weights)


def test_one_free_point_in_a_buried_cell_is_enough() -> None:
    ball = Gaussians([[0.5, 0.5, 0.5]], [[1, 0, 0, 0]], [[1.0, 1.0, 1.0]], [0.99], np.zeros((1, 1, 3)))
    space = NavigableSpace.from_box((0, 0, 0), (2, 2, 2), 8)  # its far corner alone is free
    voxels = CellViewpoints(CellGrid.over(space, max_cells=1), space).voxels(0)
    found = Certifier(Tracer(EllipsoidProxies.from_scene(ball))).certify(
        voxels, [], CertificateConfig(limit=0.0, rays=100, checked=100)
    )
    assert found is not None
    assert not buried(ball, found.checked_o).any()
    assert found.ids.tolist() == [0]


def test_stages_are_bounded_together() -> None:
    ids = everything()
    config = CertificateConfig(limit=0.0, rays=400, round_rays=200)
    first = certified(ids[::2], config, stage=1)
    second = certified(np.union1d(ids[::2], first.ids), config, stage=2, earlier=[first])
    third = certified(ids, config, stage=3, earlier=[first, second])
    samples = [(each.missed_weights, each.weights) for each in (first, second, third)]
    for count, each in enumerate((first, second, third), 1):
        assert each.bound == staged_bound(samples[:count], error=config.error)
        assert each.missed <= each.bound
    assert third.bound < first.bound
    assert np.array_equal(second.weights, certified(ids, config, stage=2).weights)  # rays know no earlier stage
    wider = certified(ids, config, stage=3)
    assert wider.bound == staged_bound([samples[2]], error=config.error)


def test_a_stage_ends_by_the_bound_of_all_stages() -> None:
    ids = everything()
    config = CertificateConfig(limit=0.02, rays=4096, round_rays=64)
    first = certified(ids[::2], config, stage=1)
    assert first.bound > config.limit
    assert first.rounds == 1  # hopeless from the first round on
    last = certified(ids, config, stage=2, earlier=[first])
    assert last.bound <= config.limit
    before = (first.missed_weights, first.weights)
    cut = len(last) - 64
    assert staged_bound([before, (last.missed_weights[:cut], last.weights[:cut])]) > config.limit


def test_a_bound_of_a_set_that_was_mended_holds() -> None:
    rng = np.random.default_rng(1)
    violations, trials = 0, 40
    for trial in range(trials):
        config = CertificateConfig(limit=0.002, rays=256, round_rays=64, seed=trial)
        kept, stages = np.flatnonzero(rng.random(len(everything())) < 0.9), []
        for stage in range(1, 4):
            found = certified(kept, config, cell=trial % 6, stage=stage, earlier=stages)
            stages.append(found)
            if stage < 3:
                kept = np.union1d(kept, found.ids)
        violations += true_share(kept, trial % 6) > found.bound
    assert violations <= most_violations(trials)


@given(st.lists(st.tuples(st.integers(0, 6), st.sampled_from([0.0, 0.1, 0.25, 0.5, 1.0])), max_size=30))
def test_of_the_hits_of_each_gaussian_the_heaviest_is_taken(hits: list[tuple[int, float]]) -> None:
    ids = np.array([each for each, _ in hits], np.int64)
    weights = np.array([weight for _, weight in hits], np.float32)
    found, numbers = heaviest_hits(ids, weights)
    assert found.tolist() == sorted(set(ids.tolist()))
    for each, number in zip(found.tolist(), numbers.tolist(), strict=True):
        assert ids[number] == each
        wanted = -1
        for k in range(len(hits)):  # the first of equal ones
            if ids[k] == each and (wanted < 0 or weights[k] > weights[wanted]):
                wanted = k
        assert number == wanted


def test_a_cell_inside_something_solid_has_no_certificate() -> None:
    inside = Gaussians([[0.5, 0.5, 0.5]], [[1, 0, 0, 0]], [[2.0, 2.0, 2.0]], [0.99], np.zeros((1, 1, 3)))
    space = NavigableSpace.from_box((0, 0, 0), (2, 1, 1), 4)
    viewpoints = CellViewpoints(CellGrid.over(space, max_cells=2), space)
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(inside)))
    assert certifier.certify(viewpoints.voxels(0), [0]) is None


@pytest.mark.skipif(not has("open3d"), reason="needs Open3D")
def test_both_tracers_agree() -> None:
    found = certified(everything(), CertificateConfig(limit=0.0, rays=500, checked=400))
    check = cross_check(tracer(), found.checked_o, found.checked_d)
    assert check is not None
    assert (check.rays, check.agreeing) == (400, 400)
    assert check.largest_difference <= 1e-5


def test_tracers_that_differ_are_noticed() -> None:
    g = tracer().proxies.gaussians
    found = certified(everything(), CertificateConfig(limit=0.0, rays=60, checked=60))
    rays = found.checked_o, found.checked_d
    one = tracer().contributions(*rays)
    ties = first_equal(g)
    assert compare(one, brute_force_contributions(g, *rays), ties).agreeing == 60
    lost = int(one.gaussian_ids[one.ray_offsets[7]])  # the first Gaussian of ray 7
    faint = g.opacities.copy()
    faint[lost] = 0.0
    other = brute_force_contributions(Gaussians(g.means, g.quats, g.scales, faint, g.sh0), *rays)
    without = int(np.count_nonzero([lost not in one.gaussian_ids[a:b] for a, b in rows_of(one.ray_offsets)]))
    check = compare(one, other, ties)
    assert check.agreeing == without < 60
    assert check.largest_difference >= one.weights[one.gaussian_ids == lost].max() - 1e-6


def rows_of(offsets: NDArray[np.int64]) -> list[tuple[int, int]]:
    return list(zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True))


def test_without_open3d_nothing_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    g = tracer().proxies.gaussians
    rays = np.zeros((1, 3)), np.ones((1, 3))
    assert cross_check(Tracer(EllipsoidProxies.from_scene(g), engine="embreex"), *rays) is None

    def broken(*_: object, **__: object) -> None:
        raise BackendError("no library")

    monkeypatch.setattr("gsvis.raycast.tracer.ENGINES", {"open3d": broken})
    assert cross_check(Tracer(EllipsoidProxies.from_scene(g), engine="open3d"), *rays) is None


@pytest.mark.parametrize(
    ("name", "value"), [("rays", 0), ("round_rays", 0), ("limit", -0.1), ("error", 0.0), ("tau", 0.0), ("seed", -1)]
)
def test_settings_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        CertificateConfig(**{name: value})


def test_a_cell_or_an_id_that_does_not_exist_is_refused() -> None:
    certifier, viewpoints = rooms()
    with pytest.raises(ValueError, match="cell"):
        viewpoints.voxels(999)
    with pytest.raises(ValueError, match="ids"):
        certifier.certify(viewpoints.voxels(0), [10**6])
