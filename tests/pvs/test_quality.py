"""Measured quality: laws that hold for any sets, sets of known quality, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.errors import FormatError, SceneError
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.quality import (
    PSNR_CAP,
    Quality,
    QualityConfig,
    box_space,
    bytes_of_one,
    dense_union,
    measure_quality,
)
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash, space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OccluderScene, two_rooms

TAU = 1.0 / 255.0
QUICK = QualityConfig(cells=3, viewpoints=2, size=24, dense=3, width=32, height=24, certify=200)
Maker = Callable[[int], CellSet]


@cache
def rooms() -> tuple[OccluderScene, CellGrid, CellViewpoints]:
    scene = two_rooms(1500, sh_degree=1)
    grid = CellGrid.over(scene.navigable, max_cells=8)
    return scene, grid, CellViewpoints(grid, scene.navigable)


def stored(path: Path, of_cell: Maker) -> VisibilityStore:
    scene, grid, _ = rooms()
    n = len(scene.gaussians)
    info = StoreInfo(n, scene_hash(scene.gaussians), TAU, np.array([TAU, 1 / 16, 1 / 4]))
    write_store(path / "some.pvs", grid, info, [of_cell(c) for c in range(len(grid))], np.zeros((n, 10), np.uint8))
    return VisibilityStore.open(path / "some.pvs")


def everything(level: int = 2) -> Maker:
    ids = np.arange(len(rooms()[0].gaussians))
    return lambda cell: CellSet(ids, np.full(len(ids), level), 3)


def nothing(cell: int) -> CellSet:
    return CellSet(np.zeros(0, np.int64), np.zeros(0, np.uint8))


def half(cell: int) -> CellSet:
    """Every second Gaussian, in classes by its number."""
    ids = np.arange(cell % 2, len(rooms()[0].gaussians), 2)
    return CellSet(ids, ids % 3, 5)


def measured(path: Path, of_cell: Maker, config: QualityConfig = QUICK) -> Quality:
    scene, _, viewpoints = rooms()
    with stored(path, of_cell) as store:
        return measure_quality(store, scene.gaussians, viewpoints, config)


def weights_around(eye: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    seen = view_weights(rooms()[0].gaussians, Cameras.cubemap(eye[None], QUICK.size))
    return seen.summed.sum(axis=0, dtype=np.float64), seen.largest.max(axis=0)


def test_a_set_of_everything_keeps_everything(tmp_path: Path) -> None:
    found = measured(tmp_path, everything())
    assert np.all(found.weighted_recall == 1.0)
    assert np.all(found.recall == 1.0)
    assert np.all(found.psnr == PSNR_CAP)
    assert np.all(found.kept == found.gaussians)
    assert found.dense_shared is not None
    assert np.array_equal(found.dense_shared, found.dense)
    assert np.all(found.size_over_dense > 1.0)
    assert np.all(found.confirmed < 1.0)  # nobody sees into the other room's corners
    assert all(each.lost == 0.0 and each.lost_per_megabyte is None for each in found.trades())


def test_an_empty_set_keeps_nothing_and_shows_black(tmp_path: Path) -> None:
    found = measured(tmp_path, nothing)
    assert np.all(found.weighted_recall == 0.0)
    assert np.all(found.recall == 0.0)
    assert np.all(found.psnr < 20.0)
    assert np.all(found.confirmed == 1.0)  # there is nothing wrong in it
    assert np.all(found.dense_recall == 0.0)
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False))["figures"]["weighted_recall"]["mean"] == 0.0


def test_recall_and_precision_are_what_the_weights_say(tmp_path: Path) -> None:
    found = measured(tmp_path, half)
    for m, cell in enumerate(found.cells.tolist()):
        ids = np.asarray(half(cell).ids)
        ever = np.zeros(found.gaussians, bool)
        for v, eye in enumerate(found.eyes[m]):
            summed, largest = weights_around(eye)
            seen = largest >= np.float32(TAU)
            ever |= seen
            for k in range(3):
                assert found.weighted_recall[m, v, k] == pytest.approx(summed[ids[ids % 3 >= k]].sum() / summed.sum())
            assert found.recall[m, v] == pytest.approx(seen[ids].sum() / seen.sum())
        assert found.confirmed[m] >= ever[ids].mean()
        assert found.kept[m].tolist() == [np.count_nonzero(ids % 3 >= k) for k in range(3)]


def test_random_rays_bound_the_light_that_sets_miss(tmp_path: Path) -> None:
    found, light = measured(tmp_path, half), measured(tmp_path, half).light
    assert light is not None
    assert light.rays == 3 * 200
    figures = {each.key: each for each in found.figures()}
    assert figures["missed_light"].mean == light.missed
    assert figures["missed_light"].worst == light.missed_by_cell.max()
    assert figures["missed_light_bound"].worst == light.bound_by_cell.max()
    assert light.missed < figures["missed_light_bound"].mean < light.bound_by_cell.max()
    assert figures["missed_light"].met(1) is False
    # Every second Gaussian is about half of the light, on rays as on faces of pixels.
    assert light.missed == pytest.approx(1.0 - found.weighted_recall[..., 0].mean(), abs=0.1)
    for each, cell in zip(light.certificates, found.cells.tolist(), strict=True):
        assert each.cell == cell
        assert not np.isin(each.ids, np.asarray(half(cell).ids)).any()
    row = found.as_dict()["cells"][0]["certificate"]
    assert row["rays"] == 200
    assert row["worst_ray"]["missed"] == light.certificates[0].missed_weights.max()
    document = found.as_dict()["certificate"]
    assert document["rays_traced_twice"] in (3 * 64, 0)  # 0 without Open3D
    assert document["rays_agreeing"] == document["rays_traced_twice"]


def test_sets_of_everything_and_of_nothing_are_certified(tmp_path: Path) -> None:
    whole, none = measured(tmp_path, everything()).light, measured(tmp_path, nothing).light
    assert whole is not None
    assert none is not None
    assert (whole.missed, none.missed) == (0.0, 1.0)
    assert whole.bound < 0.02 < none.bound
    assert none.heavy > 0.99
    off = QualityConfig(**{**vars(QUICK), "certify": 0})
    assert measured(tmp_path, half, off).light is None
    assert measured(tmp_path, half, off).as_dict()["certificate"] is None


def test_leaving_out_classes_never_brings_light_back(tmp_path: Path) -> None:
    found = measured(tmp_path, half)
    assert np.all(np.diff(found.weighted_recall, axis=2) <= 0.0)
    assert np.all(np.diff(found.kept, axis=1) <= 0)
    whole, *fewer = found.trades()
    assert whole.saved == 0.0
    assert whole.bytes == pytest.approx(found.kept[:, 0].mean() * bytes_of_one(rooms()[0].gaussians))
    for each in fewer:
        assert each.saved + each.bytes == pytest.approx(whole.bytes)
        assert each.lost == pytest.approx(whole.psnr - each.psnr)
        assert each.lost_per_megabyte == pytest.approx(each.lost / each.saved * 1e6)


def test_the_exact_set_of_an_image_draws_it_better_than_half_of_the_scene(tmp_path: Path) -> None:
    found = measured(tmp_path, half)
    assert np.all(found.ceiling > found.psnr[..., 0])
    assert np.all(found.ceiling > 30.0)
    assert np.all(found.exact < found.gaussians)


def test_viewpoints_are_fresh_seeded_and_a_cells_own(tmp_path: Path) -> None:
    scene, grid, viewpoints = rooms()
    some = measured(tmp_path, half)
    again = measured(tmp_path, half)
    every = measured(tmp_path, half, QualityConfig(**{**vars(QUICK), "cells": None}))
    other = measured(tmp_path, half, QualityConfig(**{**vars(QUICK), "seed": 1}))
    assert some.as_dict() == again.as_dict()
    assert every.cells.tolist() == list(range(len(grid)))
    for name in ("eyes", "weighted_recall", "psnr", "ceiling", "dense"):
        assert np.array_equal(getattr(some, name), getattr(every, name)[some.cells]), name
    assert not np.isin(other.eyes, every.eyes).any()
    for m, cell in enumerate(every.cells.tolist()):
        assert np.all(grid.cell_at(every.eyes[m]) == cell)
        assert np.all(scene.navigable.contains(every.eyes[m]))
        assert not np.isin(every.eyes[m], viewpoints.spread(cell, 50)).any()


def test_a_built_store_holds_what_fresh_viewpoints_see(tmp_path: Path) -> None:
    scene, grid, viewpoints = rooms()
    config = PvsConfig(method="raster", size=24, limit=0.05, rays=256, max_inner=1)
    with build_pvs(scene.gaussians, grid, scene.navigable, tmp_path / "rooms.pvs", config) as store:
        found = measure_quality(store, scene.gaussians, viewpoints, QUICK)
        assert store.info.config["space"] == space_hash(scene.navigable)
    figures = {each.key: each for each in found.figures()}
    assert figures["weighted_recall"].mean > 0.97
    assert figures["weighted_recall"].worst is not None
    assert figures["weighted_recall_viewpoint"].worst <= figures["weighted_recall"].worst <= 1.0
    assert 0.3 < figures["precision"].mean <= 1.0  # five viewpoints confirm only part of a set
    assert figures["psnr"].met(0) == (figures["psnr"].mean >= 45.0)
    assert figures["visible_share"].met(0) is None


def test_the_worst_cells_come_first(tmp_path: Path) -> None:
    n = len(rooms()[0].gaussians)
    found = measured(tmp_path, lambda cell: nothing(cell) if cell == 4 else everything()(cell), QualityConfig(
        cells=None, viewpoints=1, size=16, dense=0, width=16, height=12))  # fmt: skip
    assert found.cells[found.worst()][0] == 4
    assert len(found.worst(3)) == 3
    assert found.as_dict()["worst_cells"][0] == 4
    assert found.gaussians == n


def test_without_a_dense_union_there_are_no_figures_of_one(tmp_path: Path) -> None:
    found = measured(tmp_path, half, QualityConfig(cells=1, viewpoints=1, size=16, dense=0, width=16, height=12))
    assert found.dense is None and found.dense_psnr is None and found.size_over_dense is None  # noqa: PT018
    assert not {"dense_psnr", "size_over_dense", "dense_recall"} & {each.key for each in found.figures()}
    assert found.as_dict()["cells"][0]["dense"] is None


def test_rays_give_much_the_same(tmp_path: Path) -> None:
    config = QualityConfig(cells=1, viewpoints=2, size=24, dense=0, width=16, height=12, rays=True)
    found = measured(tmp_path, half, config)
    assert found.ray_recall == pytest.approx(found.recall, abs=0.1)
    assert "ray_recall" in found.as_dict()["figures"]


def test_more_viewpoints_never_shrink_the_dense_union() -> None:
    scene, _, viewpoints = rooms()
    eyes = viewpoints.draw(0, 4, np.random.default_rng(0))
    few, many = (dense_union(scene.gaussians, eyes[:k], TAU, size=16) for k in (2, 4))
    assert np.all(many[few])
    assert np.count_nonzero(many) > 0


def test_whole_boxes_serve_where_the_space_is_not_known(tmp_path: Path) -> None:
    scene, grid, _ = rooms()
    space = box_space(grid, scene.gaussians)
    with stored(tmp_path, everything()) as store:
        found = measure_quality(store, scene.gaussians, CellViewpoints(grid, space), QUICK)
    assert np.all(grid.cell_at(found.eyes.reshape(-1, 3)) == np.repeat(found.cells, QUICK.viewpoints))
    assert np.all(found.weighted_recall == 1.0)


def test_bytes_of_a_gaussian_are_those_of_its_attributes() -> None:
    g = rooms()[0].gaussians
    assert bytes_of_one(g) == 4 * (11 + 12)
    assert bytes_of_one(Gaussians.empty(3)) == 4 * 59


def test_cells_inside_something_solid_are_left_out(tmp_path: Path) -> None:
    inside = Gaussians([[0.5, 0.5, 0.5]], [[1, 0, 0, 0]], [[2.0, 2.0, 2.0]], [0.99], np.zeros((1, 1, 3)))
    space = NavigableSpace.from_box((0, 0, 0), (2, 1, 1), 4)
    grid = CellGrid.over(space, max_cells=2)
    info = StoreInfo(1, scene_hash(inside), TAU, np.array([TAU]))
    write_store(tmp_path / "x.pvs", grid, info, [nothing(0), nothing(1)], np.zeros((1, 10), np.uint8))
    with VisibilityStore.open(tmp_path / "x.pvs") as store, pytest.raises(SceneError, match="nothing to measure"):
        measure_quality(store, inside, CellViewpoints(grid, space), QUICK)


def test_a_store_of_another_scene_or_other_cells_is_refused(tmp_path: Path) -> None:
    scene, _, viewpoints = rooms()
    with stored(tmp_path, nothing) as store:
        with pytest.raises(FormatError, match="scene"):
            measure_quality(store, two_rooms(1400, sh_degree=1).gaussians, viewpoints, QUICK)
        finer = CellViewpoints(CellGrid.over(scene.navigable, max_cells=40), scene.navigable)
        with pytest.raises(ValueError, match=r"viewpoints: expected those of the store's cells"):
            measure_quality(store, scene.gaussians, finer, QUICK)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("viewpoints", 0),
        ("cells", 0),
        ("dense", -1),
        ("certify", -1),
        ("fov", 180.0),
        ("seed", -1),
        ("bytes_per_gaussian", 0),
    ],
)
def test_settings_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        QualityConfig(**{name: value})


def test_progress_rises_to_its_total(tmp_path: Path) -> None:
    calls: list[tuple[str, int, int]] = []
    scene, _, viewpoints = rooms()
    with stored(tmp_path, half) as store:
        measure_quality(store, scene.gaussians, viewpoints, QUICK, progress=lambda *step: calls.append(step))
    for stage, total in (("quality", 15), ("certificate", 4)):
        some = [step for step in calls if step[0] == stage]
        assert some[0] == (stage, 0, total)
        assert some[-1] == (stage, total, total)
        assert [done for _, done, _ in some] == sorted(done for _, done, _ in some)
    assert calls[-1] == ("certificate", 4, 4)
