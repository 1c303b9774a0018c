"""Scenes and statements from which nobody can tell where people stand: one clear line, never a confident answer."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.cli.options import Placed, Where
from gsvis.cli.where import find_place
from gsvis.io.poses import write_poses
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath
from gsvis.scene.place import Place
from gsvis.scene.source import Source
from tests.scene.places import apartment, discs, sheet

TURN = np.array([[0.8, -0.6, 0.0], [0.36, 0.48, -0.8], [0.48, 0.64, 0.6]])


def sky() -> Gaussians:
    """Half a sphere of large Gaussians, and nothing in it."""
    ahead = np.random.default_rng(0).normal(size=(1000, 3))
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return discs(100.0 * ahead[ahead[:, 2] > -0.05], (10.0, 10.0, 10.0))


def two_places() -> Gaussians:
    g = apartment()
    return Gaussians.concatenate([g, g.transform(np.eye(3), (400.0, 300.0, 0.0))])


SCENES = {
    "sky": sky,
    "one wall": lambda: sheet(1, 0.0, (0, 0), (4, 3), 0.1),
    "two places far apart": two_places,
    "one Gaussian": lambda: discs(np.zeros((1, 3)), (0.3, 0.3, 0.3)),
}


def lines(place: Place) -> list[str]:
    return [each.strip() for each in place.remarks]


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_that_tells_nothing_is_not_sure(name: str, turned: bool) -> None:
    g = SCENES[name]()
    place = find_place(Source(name, g.transform(TURN) if turned else g), Where())
    assert place.space is not None
    (line,) = lines(place)
    assert line.startswith("Not sure: ")
    assert "None" not in line


def test_up_that_is_stated_wrongly_is_seen_from_the_ground() -> None:
    wrong = find_place(Source("rooms", apartment()), Placed(up="+x"))
    (line,) = [each for each in lines(wrong) if each.startswith("Check the up axis")]
    assert "up is +x, but ground and walls are level with +z up: 90 degrees off?" in line
    assert not any("Check" in each for each in lines(find_place(Source("rooms", apartment()), Placed(up="+z"))))


def test_cameras_that_contradict_the_scene_are_said() -> None:
    eyes = np.array([[900.0 + k, -700.0, 40.0] for k in range(8)])
    cameras = Cameras.look_at(eyes, eyes + [[np.cos(k), np.sin(k), 0.0] for k in range(8)], width=64, height=48)
    place = find_place(Source("rooms", apartment()), Placed(up="+z"), None, cameras)
    assert place.space is not None
    assert not place.space.contains(eyes).any()
    assert place.space.contains([[2.0, 2.5, 1.5], [6.0, 2.5, 1.5]]).any()  # eyes are where the scene has them
    (line,) = [each for each in lines(place) if "ameras" in each and "decides" not in each]
    assert line.startswith("8 of 8 cameras or positions are far outside of the scene")


def test_a_walk_through_a_wall_is_said_and_taken_as_it_is(tmp_path: object) -> None:
    places = np.column_stack([np.linspace(1.0, 7.0, 41), np.full(41, 0.8), np.full(41, 1.5)])
    walk = HeadPath(np.arange(41.0), places, np.tile([1.0, 0, 0, 0], (41, 1)), up=np.array([0, 0, 1.0]))
    write_poses(walk, f"{tmp_path}/walk.csv")
    place = find_place(Source("rooms", apartment()), Placed(path=f"{tmp_path}/walk.csv", up="+z"), walk)
    assert place.space is not None
    assert place.space.contains(places).all()
    (line,) = [each for each in lines(place) if "leads through something solid" in each]
    assert 1 <= int(line.split("%")[0]) <= 30
    assert place.doubt == ""
