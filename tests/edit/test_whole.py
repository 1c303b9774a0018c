"""What is known of a whole scene: found from parts, it is what is found at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.edit import Shape, clean, core_of, gather_evidence
from gsvis.edit.whole import Whole, core_within, find_space, load_whole, save_whole
from gsvis.errors import SceneError
from gsvis.scene.density import Density
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from tests.edit.worlds import QUICK, dirty_room, dots

SCENE = dirty_room().scene
THIRDS = [SCENE[k::3] for k in range(3)]


def known_of(parts: list[Gaussians]) -> Whole:
    return Whole.from_parts(parts, SCENE, find_space(parts, SCENE, up="+z"), QUICK)


@pytest.fixture(scope="module")
def whole() -> Whole:
    return known_of([SCENE])


def test_the_grids_of_parts_are_those_of_the_scene() -> None:
    at_once, parts = (Density.from_parts(each, (-1, -1, -1), (7, 6, 4), 48) for each in ([SCENE], THIRDS))
    np.testing.assert_allclose(parts.depth, at_once.depth, rtol=1e-4, atol=1e-5)
    spaces = (
        NavigableSpace.from_scene(core_of(SCENE), up="+z"),
        NavigableSpace.from_parts([core_of(SCENE)], core_of(SCENE), up="+z"),
    )
    assert np.array_equal(spaces[0].free, spaces[1].free)
    assert spaces[0].kind == spaces[1].kind


def test_a_scene_in_parts_is_known_as_at_once(whole: Whole) -> None:
    parts = known_of(THIRDS)
    assert np.mean(parts.navigable.free != whole.navigable.free) < 1e-3
    assert np.mean(parts.air.labels != whole.air.labels) < 1e-3
    np.testing.assert_array_equal(parts.low, whole.low)


def test_evidence_by_what_is_known_of_the_whole_is_that_at_once(whole: Whole) -> None:
    found = clean(SCENE, navigable=whole.navigable, config=QUICK).evidence
    shape = Shape.within(SCENE, whole.low, whole.high)
    known = gather_evidence(SCENE, shape, whole.navigable, QUICK, air=whole.air)
    for name in ("seen", "faces", "air", "alone", "large", "far", "enclosed"):
        np.testing.assert_array_equal(getattr(known, name), getattr(found, name), err_msg=name)


def test_evidence_is_of_the_first_alone_if_only_these_are_judged(whole: Whole) -> None:
    shape = Shape.within(SCENE, whole.low, whole.high)
    some, all_of = (
        gather_evidence(SCENE, shape, whole.navigable, QUICK, air=whole.air, judged=judged) for judged in (900, None)
    )
    assert len(some.seen) == 900
    np.testing.assert_array_equal(some.air, all_of.air[:900])
    assert not (all_of.seen[:900] & ~some.seen).any()  # fewer are asked, so by finer rays


def test_what_is_known_is_read_as_it_was_written(whole: Whole, tmp_path: Path) -> None:
    save_whole(tmp_path, whole)
    again = load_whole(tmp_path / "space", tmp_path / "air")
    np.testing.assert_array_equal(again.navigable.free, whole.navigable.free)
    for name in ("labels", "open_air", "eyes", "origin", "voxel_size"):
        np.testing.assert_array_equal(getattr(again.air, name), getattr(whole.air, name))


def test_a_scene_of_many_places_has_more_eyes_and_finer_voxels_of_air(whole: Whole) -> None:
    space = NavigableSpace.from_scene(core_of(SCENE), resolution=48, up="+z")
    many = Whole.from_parts([SCENE], SCENE, replace(space, parcels=3), QUICK)
    assert len(many.air.eyes) == 3 * len(whole.air.eyes)
    assert many.air.voxel_size == pytest.approx(0.4 * space.voxel_size, rel=0.05)
    once = Whole.from_parts([SCENE], SCENE, space, QUICK)
    assert once.air.voxel_size == pytest.approx(whole.air.voxel_size, rel=0.02)


def test_a_scene_of_haze_is_one_line() -> None:
    haze = dots(np.random.default_rng(1).random((50, 3)), 0.4, 0.05)
    assert len(core_within(haze, *haze.bounds(0.98))) == 0
    with pytest.raises(SceneError, match="nothing but haze"):
        find_space([haze], haze)
