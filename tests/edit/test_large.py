"""Cleaning in tiles: each class is found where it was put, the room stays, order and batches change nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.edit import CLASSES, LargeCleaning, class_of, clean_large
from gsvis.edit.tiles import _load_merged, join_far
from gsvis.io import batches, load_scene, save_scene
from gsvis.io.ply import save_ply_parts
from gsvis.jobs.graph import Given, Result
from gsvis.jobs.objects import open_store
from gsvis.jobs.workers import Workers
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from gsvis.world.rows import save_gaussians
from gsvis.world.tiling import TilingConfig
from tests.edit.worlds import QUICK, dirty_room

Classes = NDArray[np.uint8]

DIRTY = dirty_room()


def cleaned(folder: Path, g: Gaussians, max_memory: int | None = None) -> LargeCleaning:
    save_scene(g, folder / "scene.ply")
    tiling, workers = TilingConfig(2500, up="+z"), Workers(1, max_memory=max_memory)
    return clean_large((str(folder / "scene.ply"), None), QUICK, tiling, open_store(folder / "work"), workers=workers)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> LargeCleaning:
    return cleaned(tmp_path_factory.mktemp("large"), DIRTY.scene)


@pytest.fixture(scope="module")
def classes(found: LargeCleaning) -> Classes:
    return np.concatenate(list(found.classes()))


def test_the_scene_is_cut(found: LargeCleaning) -> None:
    assert found.tiles >= 3  # the outside is one
    assert found.around > 0


def test_eyes_that_navigable_space_did_not_choose_judge_all_tiles(found: LargeCleaning) -> None:
    assert found.judged is not None
    assert len(found.judged.builder) == QUICK.held_out * (found.tiles - 1)  # the outside has no eyes
    assert found.judged.warning is None


@pytest.mark.parametrize("name", CLASSES)
def test_what_was_put_in_is_found_in_its_class(classes: Classes, name: str) -> None:
    there = DIRTY.classes == class_of(name)
    assert classes[there].tolist() == [class_of(name)] * int(there.sum())


def test_the_room_stays(classes: Classes) -> None:
    own = DIRTY.classes == 0
    assert (classes[own] == 0).mean() > 0.995


def test_counts_and_parts_agree_with_the_classes_in_the_order_of_the_scene(
    found: LargeCleaning, classes: Classes, tmp_path: Path
) -> None:
    assert found.gaussians == len(DIRTY.scene)
    assert found.kept == int((classes == 0).sum())
    assert found.removed == {name: int((classes == class_of(name)).sum()) for name in CLASSES}
    save_scene(DIRTY.scene, tmp_path / "whole.ply")
    save_scene(load_scene(tmp_path / "whole.ply")[classes == 0], tmp_path / "wanted.ply")
    save_ply_parts(found.parts(), tmp_path / "parts.ply", found.kept, found.sh_degree)
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "wanted.ply").read_bytes()


def test_order_and_batches_change_nothing(
    found: LargeCleaning, classes: Classes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "ROWS", 1500)
    turn = np.random.default_rng(3).permutation(len(DIRTY.scene))
    again = cleaned(tmp_path, DIRTY.scene[turn])
    assert len(again.build.batches) == 3
    np.testing.assert_array_equal(np.concatenate(list(again.classes())), classes[turn])
    assert scene_hash(Gaussians.concatenate(list(again.parts()))) == scene_hash(
        load_scene(tmp_path / "scene.ply")[classes[turn] == 0]
    )


def test_tiles_that_are_read_joined_are_those_that_were_merged(tmp_path: Path) -> None:
    """The outside, tile 3, and tile 1 are near tile 2, which is left out; tile 0 is read from the joined file."""
    tiles = [random_scene(np.random.default_rng(k), 5 + k) for k in range(4)]
    store = open_store(tmp_path / "store")
    inputs = []
    for g in tiles:
        for name in ("near", "far"):
            save_gaussians(tmp_path / name, g if name == "near" else g[:2])
        inputs.append(Result({name: store.put(tmp_path / name) for name in ("near", "far")}, {}))
    facts = join_far({}, Given(store, tuple(inputs), tmp_path), tmp_path, tmp_path)
    joined = Result({"far": store.put(tmp_path / "far")}, facts)
    params = {"whole": 0, "tile": 2, "near": {"1": [2, True], "3": [3, False]}}
    given = Given(store, (Result({}, {}), joined, inputs[1], inputs[3]), tmp_path)
    found = _load_merged(params, given)
    assert [reached for _, reached in found] == [False, True, False]
    wanted = [tiles[0][:2], tiles[1], tiles[3]]
    assert [scene_hash(g) for g, _ in found] == [scene_hash(g) for g in wanted]


def test_a_tile_that_does_not_fit_the_memory_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Gaussians in and around it for the memory, got"):
        cleaned(tmp_path, DIRTY.scene, max_memory=500 << 20)
