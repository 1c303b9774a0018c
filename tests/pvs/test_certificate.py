"""Certificates: known answers, laws of sets and of rays, coverage, the plain twin, and the second tracer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

from gsvis._extras import has
from gsvis.errors import BackendError
from gsvis.pvs.bound import upper_bound
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.certificate import Certificate, CertificateConfig, Certifier, compare, cross_check
from gsvis.pvs.reference import missed_light_reference
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.reference import brute_force_contributions
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from gsvis.scene.solid import buried

F64 = NDArray[np.float64]
QUICK = CertificateConfig(limit=0.0, rays=600, round_rays=256)


@cache
def rooms() -> Certifier:
    scene = two_rooms(1200, sh_degree=0)
    grid = CellGrid.over(scene.navigable, max_cells=8)
    return Certifier(Tracer(EllipsoidProxies.from_scene(scene.gaussians)), CellViewpoints(grid, scene.navigable))


def certified(ids: Sequence[int] | NDArray[np.int64], config: CertificateConfig = QUICK, **how: int) -> Certificate:
    found = rooms().certify(how.get("cell", 2), ids, config, stage=how.get("stage", 0))
    assert found is not None
    return found


def everything() -> NDArray[np.int64]:
    return np.arange(len(rooms().tracer.proxies.gaussians))


def half_space() -> Certifier:
    """Two opaque discs without end, one above and one below a room: each ray ends on one of them."""
    flat = [[1e6, 1e6, 1e-3]] * 2
    g = Gaussians([[0, 0, 2], [0, 0, -2]], [[1, 0, 0, 0]] * 2, flat, [1.0, 1.0], np.zeros((2, 1, 3)))
    space = NavigableSpace.from_box((-1, -1, -1), (1, 1, 1), 4)
    return Certifier(Tracer(EllipsoidProxies.from_scene(g)), CellViewpoints(CellGrid.over(space, max_cells=1), space))


def test_a_set_of_everything_misses_nothing_and_its_bound_is_that_of_nothing_missed() -> None:
    found = certified(everything())
    assert found.missed == 0.0
    assert found.bound == pytest.approx(upper_bound(np.zeros(600), found.weights))
    assert len(found.worst_o) == len(found.ids) == 0
    assert found.rounds == 3


def test_an_empty_set_misses_everything() -> None:
    found = certified([])
    assert found.missed == pytest.approx(1.0)
    assert found.bound == pytest.approx(1.0)
    assert np.array_equal(found.missed_weights, found.weights)
    assert found.heavy == 1.0


def test_half_of_the_light_is_missed_where_half_of_the_world_is() -> None:
    found = half_space().certify(0, [0], CertificateConfig(limit=0.0, rays=4000))
    assert found is not None
    assert found.missed == pytest.approx(0.5, abs=0.03)  # 4 standard deviations
    assert 0.5 < found.bound < 0.56
    assert found.ids.tolist() == [1]
    assert np.all(found.worst_d[:, 2] < 0.0)
    assert set(np.round(found.missed_weights, 2)) == {0.0, 1.0}


def test_rays_that_meet_nothing_do_not_count() -> None:
    g = half_space().tracer.proxies.gaussians[:1]  # rays down leave the world
    space = NavigableSpace.from_box((-1, -1, -1), (1, 1, 1), 4)
    viewpoints = CellViewpoints(CellGrid.over(space, max_cells=1), space)
    found = Certifier(Tracer(EllipsoidProxies.from_scene(g)), viewpoints).certify(0, [], QUICK)
    assert found is not None
    assert 0.4 < np.mean(found.weights > 0.0) < 0.6
    assert found.missed == 1.0


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
    hits = rooms().tracer.contributions(found.worst_o, found.worst_d)
    lost = ~np.isin(hits.gaussian_ids, ids)
    again = np.bincount(hits.ray_ids[lost], hits.weights[lost], len(hits))
    assert again == pytest.approx(found.worst_missed)


def test_the_plain_twin_finds_the_same() -> None:
    ids = everything()[::2]
    found = certified(ids, CertificateConfig(limit=0.0, rays=40, checked=40))
    plain = missed_light_reference(
        rooms().tracer.proxies.gaussians, set(ids.tolist()), found.checked_o, found.checked_d
    )
    assert found.missed_weights == pytest.approx(np.array([missed for missed, _ in plain]), abs=1e-5)
    assert found.weights == pytest.approx(np.array([whole for _, whole in plain]), abs=1e-5)


def test_rays_start_in_the_cell_outside_everything_solid_and_look_everywhere() -> None:
    found = certified(everything()[::2], CertificateConfig(limit=0.0, rays=2000, checked=2000))
    viewpoints = rooms().viewpoints
    assert np.all(viewpoints.grid.cell_at(found.checked_o) == 2)
    assert np.all(viewpoints.space.contains(found.checked_o))
    assert not buried(rooms().tracer.proxies.gaussians, found.checked_o).any()
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
    assert upper_bound(found.missed_weights[:-128], found.weights[:-128]) > 0.01
    spent = certified(ids[::2], config)
    assert len(spent) == 5000
    assert spent.bound > 0.01


def test_the_light_of_many_more_rays_lies_below_the_bound() -> None:
    rng = np.random.default_rng(0)
    violations, trials = 0, 60
    for trial in range(trials):
        kept = np.flatnonzero(rng.random(len(everything())) < (0.999, 0.99, 0.9)[trial % 3])
        found = certified(kept, CertificateConfig(limit=0.002, rays=512, round_rays=128, seed=trial), cell=trial % 6)
        many = certified(kept, CertificateConfig(limit=0.0, rays=20 * 512, round_rays=4096), cell=trial % 6, stage=9)
        violations += many.missed > found.bound
    assert violations <= int(binom.ppf(0.99, trials, 0.05))


def test_a_cell_inside_something_solid_has_no_certificate() -> None:
    inside = Gaussians([[0.5, 0.5, 0.5]], [[1, 0, 0, 0]], [[2.0, 2.0, 2.0]], [0.99], np.zeros((1, 1, 3)))
    space = NavigableSpace.from_box((0, 0, 0), (2, 1, 1), 4)
    viewpoints = CellViewpoints(CellGrid.over(space, max_cells=2), space)
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(inside)), viewpoints)
    assert certifier.certify(0, [0]) is None


@pytest.mark.skipif(not has("open3d"), reason="needs Open3D")
def test_both_tracers_agree() -> None:
    found = certified(everything(), CertificateConfig(limit=0.0, rays=500, checked=400))
    check = cross_check(rooms().tracer, found.checked_o, found.checked_d)
    assert check is not None
    assert (check.rays, check.agreeing) == (400, 400)
    assert check.largest_difference <= 1e-5


def test_tracers_that_differ_are_noticed() -> None:
    g = rooms().tracer.proxies.gaussians
    found = certified(everything(), CertificateConfig(limit=0.0, rays=60, checked=60))
    rays = found.checked_o, found.checked_d
    one = rooms().tracer.contributions(*rays)
    assert compare(one, brute_force_contributions(g, *rays), len(g)).agreeing == 60
    lost = int(one.gaussian_ids[one.ray_offsets[7]])  # the first Gaussian of ray 7
    faint = g.opacities.copy()
    faint[lost] = 0.0
    other = brute_force_contributions(Gaussians(g.means, g.quats, g.scales, faint, g.sh0), *rays)
    without = int(np.count_nonzero([lost not in one.gaussian_ids[a:b] for a, b in rows_of(one.ray_offsets)]))
    check = compare(one, other, len(g))
    assert check.agreeing == without < 60
    assert check.largest_difference >= one.weights[one.gaussian_ids == lost].max() - 1e-6


def rows_of(offsets: NDArray[np.int64]) -> list[tuple[int, int]]:
    return list(zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True))


def test_without_open3d_nothing_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    g = rooms().tracer.proxies.gaussians
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
    with pytest.raises(ValueError, match="cell"):
        rooms().certify(999, [0])
    with pytest.raises(ValueError, match="ids"):
        rooms().certify(0, [10**6])
