"""What viewpoints and cells see: right on scenes whose visibility is known, nothing lost, certified or mended."""

from __future__ import annotations

from dataclasses import astuple, replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import get_num_threads, set_num_threads
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.pvs import PvsConfig, cell_view
from gsvis.pvs._journal import pack_sighting, pack_view
from gsvis.pvs.cell_view import CellView, Finder
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.look import METHODS, Look, LookOptions
from gsvis.pvs.sightings import Sighting
from gsvis.pvs.viewpoints import CellViewpoints, FreeVoxels, SharedViewpoints
from gsvis.pvs.weight_classes import FAINTEST
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.directions import face_of
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OccluderScene, box_in_room, nested_shells, random_scene, two_rooms, wall_with_hole
from gsvis.scene.solid import buried
from tests.pvs.violations import most_violations

F64 = NDArray[np.float64]
MAKERS = {"wall": wall_with_hole, "box": box_in_room, "rooms": two_rooms, "shells": nested_shells}
SIZES = {"hybrid": 384, "raster": 384, "raycast": 64}
# Splats are flat and ordered by their centers, so surfaces must be of many; small Gaussians fall between coarse rays,
# so there they must be of few.
COUNTS = {"hybrid": 20_000, "raster": 20_000, "raycast": 1200}
FINDERS: dict[tuple[str, str], tuple[OccluderScene, Finder]] = {}
QUICK = PvsConfig(size=16, limit=0.05, rays=256, max_inner=2)


def finder_of(name: str, method: str) -> tuple[OccluderScene, Finder]:
    """A closed-form scene and its finder by a method; made once."""
    if (name, method) not in FINDERS:
        scene = MAKERS[name](COUNTS[method], sh_degree=0)
        config = PvsConfig(method=method, size=SIZES[method])
        FINDERS[name, method] = scene, Finder(Levels.single(scene.gaussians), config)
    return FINDERS[name, method]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", MAKERS)
def test_no_visible_gaussian_is_missing_and_none_behind_a_wall_is_kept(name: str, method: str) -> None:
    scene, finder = finder_of(name, method)
    missing, visible = 0, 0
    for eye, shown, hidden in zip(scene.viewpoints[:2], scene.visible, scene.hidden, strict=False):
        seen = finder.look(eye)
        mask = np.zeros(len(scene.gaussians), bool)
        mask[seen.ids[seen.seen]] = True
        assert seen.looks == 1
        assert np.array_equal(seen.viewpoint, eye)
        assert not (hidden & mask).any(), f"kept {np.count_nonzero(hidden & mask)}"
        missing += np.count_nonzero(shown & ~mask)
        visible += np.count_nonzero(shown)
    # Seams of walls seen edge on: splats are ordered by their centers there, rays by where they are densest.
    assert missing <= (0.003 * visible if name == "rooms" else 0)


@pytest.mark.parametrize("method", ["hybrid", "raster"])
@given(st.integers(0, 1000))
@settings(max_examples=12)
def test_a_bigger_opacity_in_front_never_enlarges_what_is_seen_behind(method: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    behind = random_scene(rng, 60)
    sheet = np.stack([rng.uniform(-3, 3, 8), rng.uniform(-3, 3, 8), np.full(8, -6.0)], axis=1)
    eye = np.array([0.0, 0.0, -9.0])
    found = []
    for opacity in (0.2, 0.6, 0.95):
        front = Gaussians(
            sheet, np.tile([1.0, 0, 0, 0], (8, 1)), np.full((8, 3), 0.5), np.full(8, opacity), np.zeros((8, 1, 3))
        )
        g = Gaussians.concatenate([behind, front])
        ids, weights = Look(g, method, 48, 1 / 255)(eye)
        largest = np.zeros(len(g))
        largest[ids] = weights
        found.append(largest[:60])
    for more, less in pairwise(found):
        assert (less <= more + 1e-5).all()


def ball_scene() -> Gaussians:
    return Gaussians([[0, 0, 0], [5, 0, 0]], [[1, 0, 0, 0]] * 2, [[0.5] * 3] * 2, [0.9, 0.9], np.zeros((2, 1, 3)))


def test_from_within_something_opaque_nothing_is_seen() -> None:
    ball = ball_scene()
    inside, outside = np.array([0.1, 0.0, 0.0]), np.array([2.5, 0.0, 0.0])
    assert buried(ball, np.stack([inside, outside])).tolist() == [True, False]
    assert buried(ball, np.zeros((0, 3))).tolist() == []
    finder = Finder(Levels.single(ball), replace(QUICK, size=64))
    assert (finder.look(inside).looks, finder.look(inside).ids.tolist()) == (0, [])
    assert (finder.look(outside).looks, finder.look(outside).ids.tolist()) == (1, [0, 1])


def test_classes_of_a_sighting_are_those_of_its_weights() -> None:
    scene, finder = finder_of("rooms", "hybrid")
    config, eye = finder.config, scene.viewpoints[0]
    seen = finder.look(eye)
    ids, weights = Look(scene.gaussians, config.method, config.size, config.tau)(eye)
    assert np.array_equal(seen.ids[seen.seen], ids)
    classes = seen.classes[seen.seen]
    edges = [*config.class_edges, np.inf]
    for level in range(len(config.class_edges)):
        some = weights[classes == level]
        assert (some >= np.float32(edges[level])).all()
        assert (some < np.float32(edges[level + 1])).all()


@cache
def rooms() -> tuple[Finder, CellViewpoints, SharedViewpoints]:
    scene = two_rooms(1000, sh_degree=0)
    viewpoints = CellViewpoints(CellGrid.over(scene.navigable, max_cells=8), scene.navigable)
    return Finder(Levels.single(scene.gaussians), QUICK), viewpoints, SharedViewpoints(viewpoints)


def another(**options: Any) -> Finder:
    """The rooms with other options."""
    return Finder(rooms()[0].levels, replace(QUICK, **options))


def sightings_of(cell: int) -> list[Sighting]:
    finder, _, shared = rooms()
    return [finder.look(shared.points[k]) for k in shared.of_cell(cell)]


def everything(eye: F64, classes: int | NDArray[np.int8] = 0) -> Sighting:
    """A viewpoint that sees all of the rooms."""
    count = len(rooms()[0].levels.union)
    return Sighting(eye, 1, np.arange(count, dtype=np.int32), np.full(count, classes, np.int8))


def same(a: CellView, b: CellView) -> bool:
    return pack_view(a) == pack_view(b)


@pytest.mark.parametrize("cell", [0, 3, 5])
def test_what_shared_viewpoints_see_is_in_the_set_with_its_class_and_direction(cell: int) -> None:
    finder, viewpoints, _ = rooms()
    sightings = sightings_of(cell)
    view = finder.find_cell(viewpoints.voxels(cell), sightings)
    assert (np.diff(view.ids) > 0).all()
    for each in sightings:
        ids = each.ids[each.seen]
        rows = np.searchsorted(view.ids, ids)
        assert np.array_equal(view.ids[rows], ids)
        assert (view.classes[rows] >= each.classes[each.seen]).all()
        faces = face_of(each.viewpoint - finder.levels.union.means[ids])
        assert ((view.directions[rows, faces >> 3] >> (faces & 7)) & 1).all()
    assert view.figures.viewpoints == sum(each.looks for each in sightings) + view.figures.inner


@pytest.mark.parametrize("cell", [1, 4])
def test_the_order_of_viewpoints_does_not_matter_nor_does_one_that_comes_twice(cell: int) -> None:
    finder, viewpoints, _ = rooms()
    voxels, sightings = viewpoints.voxels(cell), sightings_of(cell)
    view = finder.find_cell(voxels, sightings)
    assert same(view, finder.find_cell(voxels, sightings[::-1]))
    twice = finder.find_cell(voxels, [*sightings, sightings[0]])
    assert twice.figures == replace(view.figures, viewpoints=view.figures.viewpoints + sightings[0].looks)
    assert same(replace(twice, figures=view.figures), view)


def test_more_viewpoints_never_shrink_what_a_set_was_found_from() -> None:
    finder, viewpoints, _ = rooms()
    sightings = sightings_of(2)
    for count in range(len(sightings) + 1):
        view = finder.find_cell(viewpoints.voxels(2), sightings[:count])
        for each in sightings[:count]:
            assert np.isin(each.ids[each.seen], view.ids).all()


def test_a_set_that_misses_light_takes_what_was_faint_before_anyone_looks_again() -> None:
    _, viewpoints, _ = rooms()
    finder = another(probes=0, tile_limit=1.0, max_inner=1)
    eye = viewpoints.draw(1, 1, np.random.default_rng(0))[0]
    count = len(rooms()[0].levels.union)
    classes = np.where(np.arange(count) % 2, np.int8(-1), np.int8(0))
    view = finder.find_cell(viewpoints.voxels(1), [everything(eye, classes)])
    assert view.ids.tolist() == list(range(count))
    assert view.figures.inner == 0
    assert view.figures.missed == 0.0


def test_what_a_look_finds_faint_is_in_no_set_of_its_own() -> None:
    scene, finder = finder_of("rooms", "hybrid")
    found = finder.look(scene.viewpoints[0])
    assert 0 < np.count_nonzero(found.seen) < len(found.ids)
    assert (found.classes >= FAINTEST).all()
    assert (np.diff(found.ids) > 0).all()


def test_where_nothing_is_missed_the_set_is_what_viewpoints_see() -> None:
    finder, viewpoints, _ = rooms()
    g, rng = finder.levels.union, np.random.default_rng(0)
    eyes = viewpoints.draw(1, 3, rng)
    classes = rng.integers(0, 4, (3, len(g))).astype(np.int8)
    view = finder.find_cell(viewpoints.voxels(1), [everything(eye, c) for eye, c in zip(eyes, classes, strict=True)])
    assert view.ids.tolist() == list(range(len(g)))
    assert np.array_equal(view.classes, classes.max(axis=0))
    bits = np.zeros((len(g), 80), bool)
    for eye in eyes:
        bits[np.arange(len(g)), face_of(eye - g.means)] = True
    assert np.array_equal(np.unpackbits(view.directions, axis=1, bitorder="little").astype(bool), bits)
    figures = view.figures
    assert (figures.viewpoints, figures.inner, figures.missed, figures.tile) == (3, 0, 0.0, 0.0)
    assert 0.0 < figures.bound <= QUICK.limit


def test_directions_point_into_the_cell() -> None:
    finder, viewpoints, shared = rooms()
    view = finder.find_cell(viewpoints.voxels(3), sightings_of(3))
    eyes = np.concatenate([viewpoints.draw(3, 4000, np.random.default_rng(0)), shared.points[shared.of_cell(3)]])
    bits = np.unpackbits(view.directions, axis=1, bitorder="little")
    assert (bits.sum(axis=1) >= 1).all()
    extra = 0
    for row in range(0, len(view.ids), 7):
        mean = finder.levels.union.means[view.ids[row]].astype(np.float64)
        extra += len(np.setdiff1d(np.flatnonzero(bits[row]), face_of(eyes - mean)))
    assert extra <= 0.02 * bits[::7].sum()  # faces that no drawn point has met


@pytest.mark.parametrize("max_inner", [0, 1, 3])
@pytest.mark.parametrize("shared", [False, True])
def test_what_rays_find_is_in_the_set(max_inner: int, shared: bool) -> None:
    _, viewpoints, _ = rooms()
    finder = another(max_inner=max_inner, rays=64, limit=1e-6)
    view = finder.find_cell(viewpoints.voxels(5), sightings_of(5) if shared else [])
    tracer = Tracer(EllipsoidProxies.from_scene(finder.levels.union))
    assert len(view.checked)
    hits = tracer.contributions(view.checked[:, :3], view.checked[:, 3:])
    assert np.isin(hits.gaussian_ids[hits.weights >= np.float32(finder.config.tau)], view.ids).all()
    assert (viewpoints.grid.cell_at(view.checked[:, :3]) == 5).all()
    assert viewpoints.space.contains(view.checked[:, :3]).all()


@pytest.mark.parametrize("limit", [0.005, 0.05, 0.9])
@pytest.mark.parametrize("max_inner", [0, 1, 4])
def test_a_cell_is_finished_or_was_mended_as_often_as_allowed(limit: float, max_inner: int) -> None:
    _, viewpoints, _ = rooms()
    finder = another(limit=limit, max_inner=max_inner, tile_limit=0.2)
    for cell in (0, 2, 6):
        figures = finder.find_cell(viewpoints.voxels(cell), sightings_of(cell)).figures
        stages, rest = divmod(figures.rays, QUICK.rays)
        assert rest == 0
        assert 1 <= stages <= max_inner + 1
        assert figures.inner <= stages - 1 + finder.config.probes
        assert 0.0 <= figures.missed <= figures.bound <= 1.0
        assert 0.0 <= figures.tile <= 1.0
        finished = figures.bound <= limit and figures.tile <= 0.2
        assert finished or stages == max_inner + 1


def test_a_looser_limit_never_needs_more_rays_and_mending_never_shrinks_a_set() -> None:
    _, viewpoints, _ = rooms()
    voxels, sightings = viewpoints.voxels(4), sightings_of(4)
    rays = [another(limit=limit).find_cell(voxels, sightings).figures.rays for limit in (0.9, 0.05, 0.005)]
    assert rays == sorted(rays)
    sets = [another(limit=1e-6, max_inner=k).find_cell(voxels, sightings) for k in range(4)]
    for fewer, more in pairwise(sets):
        assert np.isin(fewer.ids, more.ids).all()
        assert (more.classes[np.searchsorted(more.ids, fewer.ids)] >= fewer.classes).all()
        assert fewer.figures.rays < more.figures.rays


def test_a_set_is_found_without_any_viewpoint() -> None:
    _, viewpoints, _ = rooms()
    view = another(max_inner=8, limit=0.05).find_cell(viewpoints.voxels(0), [])
    assert view.figures.bound <= 0.05
    assert view.figures.viewpoints == view.figures.inner > 0


@pytest.mark.parametrize("tau", [0.1, 0.3, 0.5])
def test_a_set_of_only_what_is_seen_well_can_be_found(tau: float) -> None:
    view = another(tau=tau, size=64, rays=0, probes=12).find_cell(rooms()[1].voxels(0), [])
    assert view.figures.inner > 0  # a probe found something
    assert len(view.ids) > 0


def test_without_rays_a_set_is_what_looks_and_probes_find_and_has_no_certificate() -> None:
    """The paper's way: z-buffer and hidden points, and nothing after them."""
    voxels, sightings = rooms()[1].voxels(3), sightings_of(3)
    bare = another(rays=0).find_cell(voxels, sightings)
    assert (bare.figures.rays, len(bare.checked)) == (0, 0)
    assert np.isnan([bare.figures.missed, bare.figures.bound, bare.figures.tile]).all()
    unprobed = another(rays=0, probes=0).find_cell(voxels, sightings)
    assert np.array_equal(unprobed.ids, np.unique(np.concatenate([each.ids[each.seen] for each in sightings])))
    assert np.isin(unprobed.ids, bare.ids).all()
    assert np.isin(bare.ids, rooms()[0].find_cell(voxels, sightings).ids).all()


def test_both_tracers_find_the_same_set() -> None:
    voxels, sightings = rooms()[1].voxels(3), sightings_of(3)
    by_embree = another(tracer="embree")
    assert by_embree.tracer.search == "faces"
    assert same(by_embree.find_cell(voxels, sightings), rooms()[0].find_cell(voxels, sightings))


def test_the_light_that_a_found_set_misses_lies_below_its_bound() -> None:
    finder, viewpoints, _ = rooms()
    tracer, rng = Tracer(EllipsoidProxies.from_scene(finder.levels.union)), np.random.default_rng(0)
    n, light = len(finder.levels.union), {}
    for cell in range(3):
        directions = rng.normal(size=(8000, 3))
        origins = viewpoints.draw(cell, 8000, rng)
        free = ~buried(finder.levels.union, origins)
        hits = tracer.contributions(origins[free], directions[free] / np.linalg.norm(directions[free], axis=1)[:, None])
        light[cell] = np.bincount(hits.gaussian_ids, hits.weights, n)
    finder, violations, trials = another(rays=256, limit=0.02, max_inner=1), 0, 36
    for trial in range(trials):
        cell = trial % 3
        voxels = viewpoints.voxels(cell)
        other = FreeVoxels(1000 + trial, voxels.voxels, voxels.origin, voxels.voxel_size)  # its number names the rays
        view = finder.find_cell(other, sightings_of(cell)[: trial % 4])
        missed = light[cell].sum() - light[cell][view.ids].sum()
        violations += missed / light[cell].sum() > view.figures.bound
    assert violations <= most_violations(trials)


def one_cell(high: float) -> FreeVoxels:
    space = NavigableSpace.from_box((0, 0, 0), (high, high, high), 8)
    return CellViewpoints(CellGrid.over(space, max_cells=1), space).voxels(0)


def test_a_cell_whose_viewpoints_are_all_buried_finds_its_set_from_another_point() -> None:
    ball = Gaussians([[0.5, 0.5, 0.5]], [[1, 0, 0, 0]], [[1.0, 1.0, 1.0]], [0.99], np.zeros((1, 1, 3)))
    finder = Finder(Levels.single(ball), replace(QUICK, rays=1024, max_inner=3))
    blind = finder.look(np.array([0.5, 0.5, 0.5]))
    assert blind.looks == 0
    view = finder.find_cell(one_cell(2.0), [blind])
    assert view.ids.tolist() == [0]
    assert view.figures.inner == view.figures.viewpoints >= 1
    assert view.figures.bound <= QUICK.limit


def test_a_cell_that_is_buried_everywhere_sees_nothing_and_is_not_certified() -> None:
    finder = Finder(Levels.single(ball_scene()), QUICK)
    voxels = one_cell(0.2)
    view = finder.find_cell(voxels, [finder.look(np.array([0.1, 0.1, 0.1]))])
    assert len(view.ids) == len(view.classes) == len(view.directions) == len(view.checked) == 0
    assert astuple(view.figures)[:3] == (0, 0, 0)
    assert np.isnan(astuple(view.figures)[3:]).all()


def test_threads_and_earlier_work_do_not_change_a_bit() -> None:
    finder, viewpoints, shared = rooms()
    fresh = another()
    fresh.warm()
    found = [pack_view(each.find_cell(viewpoints.voxels(3), sightings_of(3))) for each in (finder, fresh)]
    seen = [pack_sighting(each.look(shared.points[0])) for each in (finder, fresh)]
    threads = get_num_threads()
    set_num_threads(1)
    try:
        found.append(pack_view(fresh.find_cell(viewpoints.voxels(3), sightings_of(3))))
        seen.append(pack_sighting(fresh.look(shared.points[0])))
    finally:
        set_num_threads(threads)
    assert len(set(found)) == len(set(seen)) == 1


def test_the_order_of_gaussians_is_only_a_matter_of_names() -> None:
    finder, _, shared = rooms()
    g, order = finder.levels.union, np.random.default_rng(0).permutation(len(finder.levels.union))
    mixed = Finder(Levels.single(g[order]), QUICK)
    plain, other = (each.look(shared.points[0]) for each in (finder, mixed))
    back = np.argsort(order[other.ids])
    assert np.array_equal(order[other.ids][back], plain.ids)
    assert np.array_equal(other.classes[back], plain.classes)


def level_discs() -> Levels:
    """Two levels of one disc each: that of the lower one stands before that of the higher one, wherever one looks."""
    flat = [[1e6, 1e6, 1e-3]] * 2
    g = Gaussians([[0, 0, 2], [0, 0, 4]], [[1, 0, 0, 0]] * 2, flat, [1.0, 1.0], np.zeros((2, 1, 3)))
    return Levels(g, np.array([0, 1]), np.array([0, 1]), ("low", "high"))


@pytest.mark.parametrize("held", [[], [0], [1], [0, 1]])
def test_each_level_is_certified_alone_and_the_worst_one_counts(held: list[int]) -> None:
    finder = Finder(level_discs(), replace(QUICK, max_inner=0, tile_limit=1.0, probes=0))
    seen = Sighting(np.full(3, 0.5), 1, np.array(held, np.int32), np.zeros(len(held), np.int8))
    view = finder.find_cell(one_cell(1.0), [seen])
    assert view.ids.tolist() == [0, 1]  # neither disc hides the other
    assert view.figures.missed == float(len(held) < 2)
    assert (view.figures.bound <= QUICK.limit) == (len(held) == 2)
    assert view.figures.rays == 2 * QUICK.rays
    assert set(finder.look(np.full(3, 0.5)).ids.tolist()) <= {0, 1}


def test_a_level_in_which_a_cell_is_buried_does_not_count() -> None:
    discs = level_discs()
    block = Gaussians([[0.5, 0.5, 0.5]], [[1, 0, 0, 0]], [[9.0, 9.0, 9.0]], [0.99], np.zeros((1, 1, 3)))
    union = Gaussians.concatenate([discs.union, block])
    levels = Levels(union, np.array([0, 1, 1]), np.array([0, 1, 1]), ("low", "high"))
    view = Finder(levels, replace(QUICK, max_inner=0)).find_cell(one_cell(1.0), [])
    assert view.ids.tolist() == [0]
    assert (view.figures.rays, view.figures.missed) == (QUICK.rays, 1.0)


@pytest.mark.parametrize(
    "bad",
    [
        {"method": "magic"},
        {"tau": 0.0},
        {"tau": 0.6},
        {"tau": float("nan")},
        {"size": 3},
        {"size": 5000},
        {"size": 16.5},
        {"limit": 0.0},
        {"limit": 1.5},
        {"limit": float("nan")},
        {"tile_limit": 0.0},
        {"tile_limit": 2.0},
        {"rays": -1},
        {"tracer": "optix"},
        {"rays": 1.5},
        {"max_inner": -1},
        {"max_inner": True},
        {"class_ratio": 1.0},
    ],
)
def test_bad_settings_are_refused_by_name(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(bad))}: expected"):
        PvsConfig(**bad)


@given(st.floats(1e-6, 0.5), st.floats(1.25, 1e6))
def test_class_edges_rise_from_tau_and_stay_below_one(tau: float, ratio: float) -> None:
    edges = PvsConfig(tau=tau, class_ratio=ratio).class_edges
    assert edges[0] == tau
    assert (np.diff(edges) > 0).all()
    assert 1 <= len(edges) <= 16
    assert edges[-1] < 1.0


def test_a_scene_of_nothing_cannot_be_looked_at() -> None:
    for method in METHODS:
        with pytest.raises(SceneError, match="nothing to see"):
            Look(Gaussians.empty(), method, 16, 1 / 255)


def test_where_few_rays_meet_anything_there_are_more_of_them_and_no_looks() -> None:
    ball = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[0.3, 0.3, 0.3]], [0.9], np.zeros((1, 1, 3)))
    space = NavigableSpace.from_box((3, -1, -1), (5, 1, 1), 4)
    viewpoints = CellViewpoints(CellGrid.over(space, max_cells=1), space)
    finder = Finder(Levels.single(ball), replace(QUICK, limit=0.05, max_inner=8))
    shared = SharedViewpoints(viewpoints)
    view = finder.find_cell(viewpoints.voxels(0), [finder.look(point) for point in shared.points])
    assert view.ids.tolist() == [0]
    assert view.figures.inner == 0
    assert view.figures.bound <= 0.05
    assert view.figures.rays > 8 * QUICK.rays  # in fewer stages than these


def test_a_shell_of_outliers_makes_no_look_at_a_small_object_coarser() -> None:
    rng = np.random.default_rng(0)
    ball, shell = rng.normal(size=(400, 3)), rng.normal(size=(8, 3))
    far = shell / np.linalg.norm(shell, axis=1, keepdims=True) * np.geomspace(60.0, 3000.0, 8)[:, None]
    means, scales = np.concatenate([0.1 * ball, far]), np.repeat([0.002, 0.0], [400, 8])
    scales[400:] = 0.3 * np.linalg.norm(far, axis=1)
    count = len(means)
    quats, sizes, opacities = np.tile([1.0, 0, 0, 0], (count, 1)), np.tile(scales[:, None], (1, 3)), np.full(count, 0.6)
    whole = Gaussians(means, quats, sizes, opacities, np.zeros((count, 1, 3)))
    config, eye = PvsConfig(size=96), np.array([4.0, 0.3, 0.2])
    alone, within = (Finder(Levels.single(g), config).look(eye).ids for g in (whole[np.arange(400)], whole))
    assert len(alone) > 300
    assert np.isin(alone, within).mean() > 0.95


def dust() -> tuple[Finder, CellViewpoints]:
    """A cloud of Gaussians that are smaller than the pixels of coarse faces, and one cell beside it."""
    rng = np.random.default_rng(3)
    count = 20_000
    quats, scales = np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 0.02)
    g = Gaussians(0.3 * rng.normal(size=(count, 3)), quats, scales, np.full(count, 0.9), np.zeros((count, 1, 3)))
    space = NavigableSpace.from_box((3, -1, -1), (5, 1, 1), 4)
    viewpoints = CellViewpoints(CellGrid.over(space, max_cells=1), space)
    return Finder(Levels.single(g), PvsConfig(size=8, limit=0.01, rays=1024, probes=0)), viewpoints


def note_looks(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bytes, int]]:
    """The eye and the pixels of every look from now on."""
    looks: list[tuple[bytes, int]] = []
    look = Look.__call__

    def noted(self: Look, viewpoint: F64, options: LookOptions) -> Any:
        looks.append((viewpoint.tobytes(), options.size))
        return look(self, viewpoint, options)

    monkeypatch.setattr(Look, "__call__", noted)
    return looks


def test_an_eye_looks_once_in_a_repair_and_that_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    voxels = rooms()[1].voxels(0)
    looks = note_looks(monkeypatch)
    view = another(max_inner=8, limit=0.0001, tile_limit=0.001, probes=0).find_cell(voxels, [])
    assert len(set(looks)) == len(looks) > 2
    begin = cell_view._Looks.see
    monkeypatch.setattr(cell_view._Looks, "see", lambda self, eye: (self._seen.clear(), begin(self, eye))[1])
    again = another(max_inner=8, limit=0.0001, tile_limit=0.001, probes=0).find_cell(voxels, [])
    assert len(looks) > 2 * len(set(looks))
    assert pack_view(view) == pack_view(again)


def test_of_what_is_smaller_than_a_pixel_a_set_takes_what_was_faint_and_nobody_looks_again() -> None:
    finder, viewpoints = dust()
    sightings = [finder.look(point) for point in SharedViewpoints(viewpoints).points]
    seen = np.unique(np.concatenate([each.ids[each.seen] for each in sightings]))
    view = finder.find_cell(viewpoints.voxels(0), sightings)
    assert view.figures.bound <= finder.config.limit
    assert view.figures.inner == 0
    assert len(seen) < len(view.ids) < len(finder.levels.union)
    assert same(view, finder.find_cell(viewpoints.voxels(0), sightings[::-1]))
