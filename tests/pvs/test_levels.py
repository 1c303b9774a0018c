"""Levels seen one by one: laws that tie the sets, directions and colors of a union to those of each level."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import gsvis.prepare.colors as colors_module
from gsvis.color.fit import FitConfig
from gsvis.errors import FormatError, SceneError
from gsvis.files.mapped import MappedArrays
from gsvis.jobs.workers import Workers
from gsvis.prepare.colors import ColorConfig, find_kept, prepare_colors
from gsvis.prepare.importance import importance_from_views
from gsvis.pvs import prepared
from gsvis.pvs._journal import pack_view
from gsvis.pvs.build import build_pvs, journal_of
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.certificate import CertificateConfig, Certifier
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.estimate import estimate_pvs
from gsvis.pvs.prepared import PreparedLevels
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.directions import trace_directions
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, as_levels, level_scenes, levels_record
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from gsvis.scene.view_sampling import ViewSampling
from tests.pvs.violations import most_violations

CONFIG = PvsConfig(size=16, limit=0.05, rays=128, max_inner=1)
QUICK = ColorConfig(FitConfig(max_terms=2, mean_terms=1.0), ViewSampling(2, 32, 24))


@cache
def setting() -> tuple[Levels, NavigableSpace, CellGrid]:
    """Rooms whose low level lacks most Gaussians of the high one and has some, larger, of its own."""
    made = two_rooms(1000, sh_degree=1)
    g, rng = made.gaussians, np.random.default_rng(0)
    own = g[rng.choice(len(g), 60, replace=False)]
    own = Gaussians(own.means, own.quats, own.scales * 2.0, own.opacities, own.sh0, own.shN)
    union = Gaussians.concatenate([g, own])
    kind = np.concatenate([rng.choice(3, len(g), p=[0.25, 0.25, 0.5]), np.full(60, 3)])
    first, last = np.array([0, 1, 2, 0])[kind], np.array([2, 2, 2, 0])[kind]
    mixed = rng.permutation(len(union))
    levels = Levels(union[mixed], first[mixed], last[mixed], ("low", "medium", "high"))
    assert len(as_levels(union)) == 1
    return levels, made.navigable, CellGrid.over(made.navigable, max_cells=4)


def test_cells_are_the_same_where_levels_give_their_memory_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    levels, space, grid = setting()
    viewpoints = CellViewpoints(grid, space)
    shared = SharedViewpoints(viewpoints)
    kept = Finder(levels, CONFIG)
    made = PreparedLevels(levels, CONFIG).shelve(tmp_path)
    rested = set[str]()
    release = MappedArrays.release

    def note(file: MappedArrays) -> None:
        rested.add(file.path.name)
        release(file)

    monkeypatch.setattr(prepared, "_LARGE", 0)
    monkeypatch.setattr(MappedArrays, "release", note)
    filed = Finder(levels, CONFIG, PreparedLevels(levels, CONFIG, made=made))
    for cell in range(len(grid)):
        sightings = [kept.look(shared.points[k]) for k in shared.of_cell(cell)]
        found = [finder.find_cell(viewpoints.voxels(cell), sightings) for finder in (kept, filed)]
        assert pack_view(found[0]) == pack_view(found[1])
    assert len(rested) == len(levels)  # each level was given back


def sets_of(store: VisibilityStore, ids: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(C, count) class + 1 in each cell, and (count, 10) directions, under the ids of a union."""
    levels, directions = np.zeros((len(store), count), np.int64), np.zeros((count, 10), np.uint8)
    for cell in range(len(store)):
        seen, classes = store.classes(cell)
        levels[cell, ids[seen]] = classes + 1
    directions[ids] = store.direction_sets
    return levels, directions


def test_what_is_seen_in_a_level_is_not_hidden_by_another(tmp_path: Path) -> None:
    levels, space, grid = setting()
    viewpoints = CellViewpoints(grid, space)
    shared, count = SharedViewpoints(viewpoints), len(levels.union)
    highest, ids = list(level_scenes(levels))[-1]
    finder = Finder(Levels.single(highest), CONFIG)
    with build_pvs(levels, grid, space, tmp_path / "all.pvs", CONFIG) as store:
        together, toward = sets_of(store, np.arange(count), count)
        assert store.info.config["levels"] == levels_record(levels)
        assert store.info.scene == scene_hash(levels.union)
    assert np.array_equal(toward.any(axis=1), together.any(axis=0))
    for cell in range(len(grid)):
        for k in shared.of_cell(cell):
            seen = finder.look(shared.points[k], fine=bool(shared.fine[k]))
            assert (together[cell, ids[seen.ids]] > seen.classes).all()
    with build_pvs(levels.union, grid, space, tmp_path / "drawn.pvs", CONFIG) as store:
        wrong, _ = sets_of(store, np.arange(count), count)
        assert ((wrong == 0) & (together > 0)).any()  # hidden by Gaussians of another level


def test_the_bound_of_a_cell_holds_for_each_level_drawn_alone(tmp_path: Path) -> None:
    levels, space, grid = setting()
    viewpoints, certificate = CellViewpoints(grid, space), CertificateConfig(limit=0.0, rays=4000, seed=7)
    with build_pvs(levels, grid, space, tmp_path / "all.pvs", CONFIG) as store:
        violations = 0
        for scene, ids in level_scenes(levels):
            certifier = Certifier(Tracer(EllipsoidProxies.from_scene(scene)))
            for cell in range(len(grid)):
                held = np.flatnonzero(np.isin(ids, store.visible_ids(cell)))
                found = certifier.certify(viewpoints.voxels(cell), held, certificate)
                assert found is not None
                violations += found.missed > store.certificates.bound[cell]
        trials = len(levels) * len(grid)
        assert violations <= most_violations(trials)
        assert (store.certificates.rays >= len(levels) * CONFIG.rays).all()


def test_a_single_level_is_the_scene_to_the_byte(tmp_path: Path) -> None:
    levels, space, grid = setting()
    g = levels.level(2)
    build_pvs(g, grid, space, tmp_path / "scene.pvs", CONFIG).close()
    build_pvs(Levels.single(g), grid, space, tmp_path / "level.pvs", CONFIG).close()
    assert (tmp_path / "scene.pvs").read_bytes() == (tmp_path / "level.pvs").read_bytes()
    with VisibilityStore.open(tmp_path / "scene.pvs", scene=Levels.single(g)) as store:
        store.check_scene(g)
    plain, single = (prepare_colors(each, space, QUICK) for each in (g, Levels.single(g)))
    for name in ("sets", "importance", "sets_from"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(single, name))
    for name in ("base", "offsets", "centers", "decays", "intensities"):
        np.testing.assert_array_equal(getattr(plain.fit.colors, name), getattr(single.fit.colors, name))
    one, other = (find_kept(each, space, QUICK, "x") for each in (g, Levels.single(g)))
    assert one is not None
    assert other is not None
    assert one.folder == other.folder


def test_a_permutation_of_the_union_permutes_ids(tmp_path: Path) -> None:
    levels, space, grid = setting()
    order = np.random.default_rng(1).permutation(len(levels.union))
    turned = Levels(levels.union[order], levels.first[order], levels.last[order], levels.names)
    with (
        build_pvs(levels, grid, space, tmp_path / "a.pvs", CONFIG) as plain,
        build_pvs(turned, grid, space, tmp_path / "b.pvs", CONFIG) as mixed,
    ):
        wanted = sets_of(plain, np.arange(len(order)), len(order))
        for a, b in zip(wanted, sets_of(mixed, order, len(order)), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("stage", "after"), [("viewpoints", 4), ("cells", 2)])
def test_workers_and_stops_do_not_change_a_byte(tmp_path: Path, stage: str, after: int) -> None:
    levels, space, grid = setting()

    def stop(now: str, done: int, total: int) -> None:
        if now == stage and done == after:
            raise KeyboardInterrupt

    build_pvs(levels, grid, space, tmp_path / "here.pvs", CONFIG).close()
    with pytest.raises(KeyboardInterrupt):
        build_pvs(levels, grid, space, tmp_path / "again.pvs", CONFIG, progress=stop)
    kept = journal_of(levels, grid, space, tmp_path / "again.pvs", CONFIG)
    assert len(list(kept.glob(f"{stage[:-1]}-*.bin"))) == after
    finished = estimate_pvs(levels, grid, space, tmp_path / "again.pvs", CONFIG, sample=1).finished
    assert finished == (2 if stage == "cells" else 0)
    build_pvs(levels, grid, space, tmp_path / "again.pvs", CONFIG, workers=Workers(2)).close()
    assert (tmp_path / "here.pvs").read_bytes() == (tmp_path / "again.pvs").read_bytes()


def test_one_level_in_memory_changes_no_byte_and_leaves_no_file(tmp_path: Path) -> None:
    levels, space, grid = setting()
    for name, one_level in (("all.pvs", False), ("one.pvs", True)):
        build_pvs(levels, grid, space, tmp_path / name, CONFIG, one_level=one_level).close()
    assert (tmp_path / "one.pvs").read_bytes() == (tmp_path / "all.pvs").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.pvs", "one.pvs"]


def test_a_build_of_other_levels_is_another_build() -> None:
    levels, space, grid = setting()
    shorter = np.where(levels.first == 0, np.uint8(0), levels.last)
    others = [
        levels,
        levels.union,
        Levels(levels.union, levels.first, shorter, levels.names),
        Levels(levels.union, levels.first, levels.last, ("a", "b", "c")),
    ]
    assert len({journal_of(each, grid, space, "x.pvs", CONFIG) for each in others}) == len(others)
    kept = [find_kept(each, space, QUICK, "x.arrow") for each in others]
    assert len({work.folder for work in kept if work is not None}) == len(others)


def test_a_store_knows_its_levels(tmp_path: Path) -> None:
    levels, space, grid = setting()
    build_pvs(levels, grid, space, tmp_path / "all.pvs", CONFIG).close()
    other = Levels(levels.union, levels.first, np.full(len(levels.last), 2), levels.names)
    with VisibilityStore.open(tmp_path / "all.pvs", scene=levels) as store:
        store.check_scene(levels.union)
        for wrong, message in ((other, "other levels"), (Levels.single(levels.union), "other levels")):
            with pytest.raises(FormatError, match=message):
                store.check_scene(wrong)
        with pytest.raises(FormatError, match="the union of levels"):
            store.check_scene(levels.level(2))


def test_a_level_that_shows_nothing_is_named(tmp_path: Path) -> None:
    levels, space, grid = setting()
    u = levels.union
    dim = np.where(levels.first == 0, np.float32(0.001), u.opacities)
    faint = Levels(Gaussians(u.means, u.quats, u.scales, dim, u.sh0), levels.first, levels.last, levels.names)
    with pytest.raises(SceneError, match=r"level 'low'.*nothing to see"):
        build_pvs(faint, grid, space, tmp_path / "x.pvs", CONFIG)
    assert list(tmp_path.iterdir()) == []


def test_directions_and_importance_come_from_each_level(tmp_path: Path) -> None:
    levels, space, _ = setting()
    found = prepare_colors(levels, space, QUICK)
    views = QUICK.views.cameras(levels, space)
    sets = np.zeros((len(levels.union), 10), np.uint8)
    faces, have = np.zeros((len(levels.union), 80)), np.zeros(len(levels.union))
    for scene, ids in level_scenes(levels):
        seen = importance_from_views(scene, views)
        sets[ids] |= trace_directions(Tracer(EllipsoidProxies.from_scene(scene)), space) | seen.sets
        faces[ids] += seen.faces
        have[ids] += 1
    np.testing.assert_array_equal(found.sets, sets)
    together = importance_from_views(levels, views)
    np.testing.assert_allclose(together.faces, faces / have[:, None], rtol=1e-6)
    np.testing.assert_array_equal(found.importance, together.importance)
    assert len(found.fit.colors) == len(levels.union)  # what levels share has one fit
    known = prepare_colors(levels, space, QUICK, sets=sets)
    np.testing.assert_array_equal(known.fit.colors.intensities, found.fit.colors.intensities)


def test_tracing_of_levels_goes_on_where_it_stood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    levels, space, _ = setting()
    monkeypatch.setattr(colors_module, "_BLOCK", 200)
    stop_at, calls = levels.counts[0] + 150, []  # inside the second level

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "directions" and done > stop_at:
            raise KeyboardInterrupt

    out = tmp_path / "levels.srbf.arrow"
    with pytest.raises(KeyboardInterrupt):
        prepare_colors(levels, space, QUICK, keep=out, progress=stop)
    again = prepare_colors(levels, space, QUICK, keep=out, progress=lambda *each: calls.append(each))
    assert calls[0][0] == "directions"
    assert 0 < calls[0][1] <= stop_at
    assert max(done for stage, done, _ in calls if stage == "directions") == sum(levels.counts)
    np.testing.assert_array_equal(again.sets, prepare_colors(levels, space, QUICK).sets)
