"""Kinds of space: objects are seen from around, rooms from inside, open places from the height of a person."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from gsvis.errors import SceneError
from gsvis.scene.content import space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import Evidence, SpaceKind, find_kind
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import buried
from tests.scene.places import KINDS, apartment, ball, box, discs, filled, statue, street

Place = Callable[[], Gaussians]
PLACES = [(kind, place) for kind, places in KINDS.items() for place in places]


@cache
def found(place: Place) -> NavigableSpace:
    return NavigableSpace.from_scene(place(), resolution=96, up="+z")


def eyes_of(space: NavigableSpace, count: int = 400) -> np.ndarray:
    return space.sample_viewpoints(count, np.random.default_rng(0))


class TestKinds:
    @pytest.mark.parametrize(("kind", "place"), PLACES, ids=[place.__name__ for _, place in PLACES])
    def test_every_kind_is_recognized(self, kind: str, place: Place) -> None:
        space = found(place)
        assert space.kind.kind == kind, space.kind
        assert str(space.kind).startswith(f"{kind}: ")
        assert "\n" not in str(space.kind)
        assert json.loads(json.dumps(space.kind.as_dict()))["text"] == str(space.kind)

    @pytest.mark.parametrize("place", [statue, street, apartment])
    def test_the_frame_does_not_matter(self, place: Place) -> None:
        turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])  # +z becomes -y
        moved = place().transform(turn, (40.0, -7.0, 3.0), 1.0)
        space = NavigableSpace.from_scene(moved, resolution=96, up="-y")
        assert space.kind.kind == found(place).kind.kind
        assert space.volume == pytest.approx(found(place).volume, rel=0.1)

    @pytest.mark.parametrize("place", [statue, street, apartment])
    def test_the_same_scene_gives_the_same_eyes(self, place: Place) -> None:
        again = NavigableSpace.from_scene(place(), resolution=96, up="+z")
        assert space_hash(again) == space_hash(found(place))
        assert again.kind == found(place).kind

    @pytest.mark.parametrize("place", [statue, street, apartment])
    def test_flyaways_change_no_kind(self, place: Place) -> None:
        far = np.random.default_rng(7).normal(size=(30, 3))
        far *= 1e4 / np.linalg.norm(far, axis=1)[:, None]
        g = Gaussians.concatenate([place(), discs(far, (0.5, 0.5, 0.5))])
        space = NavigableSpace.from_scene(g, resolution=96, up="+z")
        assert space.kind.kind == found(place).kind.kind
        assert space.voxel_size == pytest.approx(found(place).voxel_size, rel=0.1)

    def test_a_sky_far_away_changes_nothing(self) -> None:
        lawn = Gaussians.concatenate([KINDS["object"][3]()] * 3)
        dome = ball((0.0, 0.0, 0.0), 200.0, 150)
        bare, under_sky = (
            NavigableSpace.from_scene(g, resolution=96, up="+z") for g in (lawn, Gaussians.concatenate([lawn, dome]))
        )
        assert bare.kind.kind == under_sky.kind.kind
        assert bare.kind.confidence == under_sky.kind.confidence
        assert np.abs(eyes_of(under_sky)).max() < 10.0
        assert under_sky.voxel_size == pytest.approx(bare.voxel_size, rel=0.02)

    def test_every_rule_by_its_figures(self) -> None:
        object_ = {
            "seen_within": 0.1, "seen_outside": 0.9, "roofed": 1.0, "surrounded": 0.2, "walkable": 0.5, "flatness": 2.0
        }  # fmt: skip
        cases = [
            ({}, "object"),
            ({"seen_within": 0.95}, "rooms"),
            ({"seen_within": 0.95, "roofed": 0.4}, "object"),
            ({"surrounded": 0.6}, "open place"),
            ({"flatness": 0.1}, "open place"),
            ({"flatness": 0.1, "walkable": 0.0}, "object"),
        ]
        for changed, kind in cases:
            assert find_kind(Evidence(**{**object_, **changed})).kind == kind


class TestObjects:
    @pytest.mark.parametrize("bottom", [False, True])
    def test_a_statue_is_seen_from_around_and_not_from_its_plinth(self, bottom: bool) -> None:
        space = NavigableSpace.from_scene(statue(bottom), resolution=96, up="+z")
        assert space.kind.kind == "object"
        eyes = eyes_of(space)
        outside = np.maximum(np.abs(eyes[:, :2]) - 0.5, 0.0)
        assert not ((outside == 0.0).all(axis=1) & (eyes[:, 2] < 2.4)).any()
        assert eyes[:, 2].min() > -0.1  # not below
        angles = np.arctan2(eyes[:, 1], eyes[:, 0])
        assert np.histogram(angles, 8, (-np.pi, np.pi))[0].min() > 25  # from all sides

    def test_nothing_free_inside_is_an_object(self) -> None:
        lattice = np.stack(np.meshgrid(*[np.arange(12.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        space = NavigableSpace.from_scene(discs(lattice, (0.5, 0.5, 0.5)), resolution=16, up="+z")
        assert "nothing in its box is free" in str(space.kind)
        assert not space.contains([[5.5, 5.5, 5.5]])[0]

    def test_around_by_hand(self) -> None:
        g = apartment()
        space = NavigableSpace.around(g, (2.0, 2.5, 1.0), 0.5, up="+z")
        away = np.linalg.norm(eyes_of(space) - (2.0, 2.5, 1.0), axis=1)
        assert away.min() >= 0.6
        assert away.max() <= np.sqrt(3.0) * 0.5 + 0.5
        assert space.kind.kind == "given"
        whole = NavigableSpace.around(statue(), up="+z", resolution=96)
        assert np.array_equal(whole.free, found(statue).free)

    def test_around_by_hand_is_checked(self) -> None:
        with pytest.raises(ValueError, match="radius: expected center and radius together"):
            NavigableSpace.around(statue(), (0.0, 0.0, 0.0))
        with pytest.raises(ValueError, match="radius: expected a finite number > 0"):
            NavigableSpace.around(statue(), (0.0, 0.0, 0.0), -1.0)
        solid = discs(np.random.default_rng(0).uniform(-3, 3, (4000, 3)), (0.4, 0.4, 0.4))
        with pytest.raises(SceneError, match="no navigable space"):
            NavigableSpace.around(solid, (0.0, 0.0, 0.0), 0.5, resolution=48)


class TestOpenPlaces:
    @pytest.mark.parametrize("behind", [False, True])
    def test_eyes_stand_in_the_street_and_not_behind_facades_or_in_the_air(self, behind: bool) -> None:
        space = NavigableSpace.from_scene(street(behind), resolution=160, up="+z")
        assert space.kind.kind == "open place"
        eyes = eyes_of(space)
        assert np.mean(np.abs(eyes[:, 1]) < 6.0) > 0.97
        assert eyes[:, 2].max() < 4.7  # 3 above a car
        assert np.mean(eyes[:, 2] < 3.4) > 0.8
        assert ndimage.label(space.free)[1] == 1

    def test_eyes_follow_the_ground(self) -> None:
        space = found(KINDS["open place"][3])
        eyes = eyes_of(space)
        hills = 2.0 * np.sin(eyes[:, 0] / 9.0) * np.cos(eyes[:, 1] / 7.0)
        assert np.quantile(eyes[:, 2] - hills, 0.9) < 3.0 + 3.0 * space.voxel_size


class TestRooms:
    def test_rooms_stay_as_they_were(self) -> None:
        space = found(apartment)
        assert space.rule == "free, 70% enclosed, ground below"
        assert space.contains([[2.0, 2.5, 1.5], [6.0, 2.5, 1.5]]).all()

    def test_cameras_hold_their_part(self) -> None:
        cameras = np.array([[2.0, 2.5, 1.5], [6.0, 2.5, 1.5]])
        space = NavigableSpace.from_scene(apartment(), resolution=96, up="+z", seeds=cameras)
        assert space.contains(cameras).all()
        assert space.kind.kind == "rooms"
        assert "hold the cameras" in space.kind.eyes


def test_no_eye_of_any_kind_is_buried() -> None:
    for place in (statue, street, apartment, filled):
        assert buried(place(), eyes_of(found(place))).mean() < 0.01


def test_a_space_given_by_hand_says_so() -> None:
    assert NavigableSpace.from_box((0, 0, 0), (1, 1, 1), 4).kind == SpaceKind("given", "a box given by hand")
    closed = box((0, 0, 0), (1, 1, 1), 0.1)
    assert NavigableSpace.from_scene(closed, resolution=32, up="+z").kind.kind == "rooms"


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "lod", "kind"),
    [
        ("showroom/lod-meta.json", 3, "rooms"),
        ("nika_sh3/lod-meta.json", 0, "open place"),
        ("flowers_sh2/lod-meta.json", 3, "object"),
        ("formats/guitar.compressed.ply", None, "object"),
        ("statues/massa.sog", None, "object"),
        ("statues/trumpet.sog", None, "object"),
    ],
)
def test_kinds_of_real_scenes(
    realdata: Path, real_space: Callable[[Gaussians], NavigableSpace], name: str, lod: int | None, kind: str
) -> None:
    from gsvis.io import load_scene

    path = realdata / "scenes" / name
    if not path.exists():
        pytest.skip(f"{name} is not there")
    assert real_space(load_scene(path, lod=lod)).kind.kind == kind
