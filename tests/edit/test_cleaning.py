"""Cleaning: each class is found where it was put, nothing else goes, and what is found obeys laws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import gsvis
from gsvis.edit import CLASSES, CleanConfig, Cleaning, Shape, class_of, classify, clean, core_of
from gsvis.errors import SceneError
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from tests.edit.worlds import QUICK, Dirty, dirty_room, dots


@pytest.fixture(scope="module")
def dirty() -> Dirty:
    return dirty_room()


@pytest.fixture(scope="module")
def found(dirty: Dirty) -> Cleaning:
    return clean(dirty.scene, navigable=dirty.space, config=QUICK)


@pytest.mark.parametrize("name", CLASSES)
def test_what_was_put_in_is_found_in_its_class(dirty: Dirty, found: Cleaning, name: str) -> None:
    there = dirty.classes == class_of(name)
    assert found.found[there].tolist() == [class_of(name)] * int(there.sum())
    assert found.mask(name)[there].all()


def test_the_room_stays(dirty: Dirty, found: Cleaning) -> None:
    own = dirty.classes == 0
    assert found.kept[own].mean() > 0.995
    assert not np.isin(found.classes[own], [class_of("fog"), class_of("floaters"), class_of("flyaways")]).any()


def test_counts_masks_and_costs_agree(found: Cleaning) -> None:
    assert sum(found.counts.values()) == int((~found.kept).sum())
    assert set(found.costs) <= {*CLASSES, "all"}
    assert found.costs["interior"].worst_db >= QUICK.least_db
    assert found.costs["fog"].mean_db < 100.0


def test_the_order_of_the_gaussians_does_not_matter(dirty: Dirty, found: Cleaning) -> None:
    turn = np.random.default_rng(3).permutation(len(dirty.scene))
    again = clean(dirty.scene[turn], navigable=dirty.space, config=replace(QUICK, held_out=0))
    assert np.mean(again.found == found.found[turn]) > 0.999  # looks may differ where weights are equal
    assert np.array_equal(again.found >= class_of("fog"), found.found[turn] >= class_of("fog"))


def test_classes_can_be_chosen(dirty: Dirty, found: Cleaning) -> None:
    some = classify(found.evidence, replace(QUICK, classes=("fog", "flyaways")))
    assert set(np.unique(some).tolist()) == {0, class_of("fog"), class_of("flyaways")}
    everything = classify(found.evidence, QUICK)
    assert np.array_equal(some[some > 0], everything[some > 0])


def test_more_strength_never_finds_fewer(dirty: Dirty) -> None:
    before = np.zeros(len(dirty.scene), bool)
    for strength in (0.3, 1.0, 2.0):
        config = replace(QUICK, strength=strength, held_out=0, eyes=2)
        now = clean(dirty.scene, navigable=dirty.space, config=config).found > 0
        assert not (before & ~now).any()
        before = now


def test_a_clean_scene_is_found_clean_again(dirty: Dirty, found: Cleaning) -> None:
    again = clean(dirty.scene[found.kept], navigable=dirty.space, config=QUICK)
    assert np.mean(again.kept) > 0.998
    assert again.counts["fog"] == again.counts["floaters"] == again.counts["flyaways"] == 0


def test_eyes_of_photographs_see_too(dirty: Dirty, found: Cleaning) -> None:
    inside_the_box = Cameras.look_at([[3.3, 2.8, 2.0]], (3.0, 2.5, 1.5), up=(0, 0, 1), width=8, height=8)
    again = clean(dirty.scene, navigable=dirty.space, cameras=inside_the_box, config=replace(QUICK, held_out=0))
    interior = dirty.classes == class_of("interior")
    assert found.evidence.seen[interior].sum() == 0
    assert again.evidence.seen[interior].all()


def test_without_a_guard_nothing_is_drawn(dirty: Dirty) -> None:
    bare = clean(dirty.scene, navigable=dirty.space, config=replace(QUICK, held_out=0, eyes=2))
    assert bare.costs == {}
    assert bare.cameras is None
    assert np.array_equal(bare.classes, bare.found)


def test_flyaways_do_not_change_the_rest(dirty: Dirty, found: Cleaning) -> None:
    more = Gaussians.concatenate([dirty.scene, dots(np.eye(3) * 1e6, 1e3, 0.9)])
    again = clean(more, navigable=dirty.space, config=replace(QUICK, held_out=0))
    assert (again.found[-3:] == class_of("flyaways")).all()
    assert np.array_equal(again.found[:-3], found.found)


def test_a_sky_is_no_flyaway(dirty: Dirty) -> None:
    rng = np.random.default_rng(0)
    sky = 200.0 * np.array([0.3, 0.2, 0.9]) + 4.0 * rng.normal(size=(40, 3))
    alone = dots([[0.0, 0.0, -9000.0]], 0.1, 0.9)
    shape = Shape.from_scene(Gaussians.concatenate([dirty.scene, alone]))
    assert shape.far[-1]
    domed = Gaussians.concatenate([dirty.scene, dots(sky, 20.0, 0.9), alone])
    result = clean(domed, navigable=dirty.space, config=replace(QUICK, held_out=0, eyes=1))
    assert result.evidence.far[-41:].all()
    assert result.found[-41:].tolist() == [0] * 40 + [class_of("flyaways")]


def test_haze_is_no_surface(dirty: Dirty) -> None:
    shape = Shape.from_scene(dirty.scene)
    fog = dirty.classes == class_of("fog")
    assert shape.hazy[fog].all()
    assert not shape.surfaces[fog].any()
    assert len(core_of(dirty.scene)) == int(shape.surfaces.sum()) < int(shape.core.sum()) < len(dirty.scene)


def test_gsvis_clean_is_this_one(dirty: Dirty) -> None:
    assert gsvis.clean is clean


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"classes": ()}, "classes"),
        ({"classes": ("mist",)}, "classes"),
        ({"strength": 0.0}, "strength"),
        ({"strength": 2.5}, "strength"),
        ({"eyes": 0}, "eyes"),
        ({"held_out": -1}, "held_out"),
        ({"tau": 0.9}, "tau"),
        ({"least_db": -1.0}, "least_db"),
        ({"most_changed": 2.0}, "most_changed"),
    ],
)
def test_wrong_settings_are_named(changes: dict[str, Any], wanted: str) -> None:
    with pytest.raises(ValueError, match=wanted):
        CleanConfig(**changes)


def test_a_scene_without_a_surface_is_refused() -> None:
    box = NavigableSpace.from_box((0, 0, 0), (1, 1, 1), 8)
    with pytest.raises(SceneError, match="nothing to see"):
        clean(dots(np.random.default_rng(0).random((50, 3)), 0.1, 0.001), navigable=box, config=QUICK)
    with pytest.raises(SceneError, match="haze"):
        clean(dots(np.random.default_rng(0).random((50, 3)), 0.1, 0.1), navigable=box, config=QUICK)
    with pytest.raises(SceneError):
        clean(Gaussians.empty(), config=QUICK)


@pytest.mark.parametrize(("count", "size"), [(1, 0.1), (2, 0.001), (300, 0.004)])
@pytest.mark.parametrize("inside", [True, False])
def test_a_scene_without_a_surface_keeps_what_it_has(count: int, size: float, inside: bool) -> None:
    scene = dots(np.random.default_rng(count).random((count, 3)), size, 0.01)
    assert not Shape.from_scene(scene).lonely.any()
    box = NavigableSpace.from_box((-0.5, -0.5, -0.5), (1.5, 1.5, 1.5), 8) if inside else None
    result = clean(scene, navigable=box, config=QUICK)
    assert result.counts["fog"] == result.counts["floaters"] == 0


def test_a_scene_of_one_gaussian_keeps_it() -> None:
    assert clean(dots([[1.0, 2.0, 3.0]], 0.1, 0.9), config=QUICK).kept.tolist() == [True]
