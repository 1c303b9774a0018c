"""What says where people stand: cameras, a walk, a box, the scene itself, in this order; up in any direction."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import parse
from gsvis.cli.options import Placed, Where, value_of
from gsvis.cli.where import check_where, find_place, parse_up
from gsvis.scene.cameras import Cameras
from gsvis.scene.source import Source
from tests.scene.places import apartment

OBLIQUE = np.array([0.1, -0.98, 0.17])


@pytest.mark.parametrize("words", [["0.1 -0.98 0.17"], ["0.1,-0.98,0.17"], ["0.1", "-0.98", "0.17"]])
def test_up_takes_any_direction(words: list[str]) -> None:
    command = parse(["pvs", "--up", *words, "scene.ply", "-o", "x"])
    up = parse_up(value_of(command, "up"))
    assert up is not None
    assert np.allclose(up, OBLIQUE / np.linalg.norm(OBLIQUE), atol=1e-15)
    assert value_of(command, "scene") == "scene.ply"


@pytest.mark.parametrize("scale", [1e-300, 1.0, 1e300])
def test_the_length_of_up_does_not_matter(scale: float) -> None:
    up = parse_up(" ".join(str(float(value)) for value in scale * np.array([0.0, 3.0, -4.0])))
    assert up is not None
    assert np.allclose(up, [0.0, 0.6, -0.8], atol=1e-15)


@pytest.mark.parametrize("text", ["0 0 0", "1 2", "up", "nan 0 1", "inf 0 0", "1 2 3 4", ""])
def test_what_is_no_direction_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"^--up: expected one of .* or three numbers"):
        parse_up(text)


def test_cameras_say_where_eyes_are_and_which_way_is_up(tmp_path: Path) -> None:
    g = apartment()
    eyes = np.array([[1.0 + 0.2 * k, 1.5, 1.5] for k in range(6)])
    targets = eyes + [[np.cos(k), np.sin(k), 0.0] for k in range(6)]
    cameras = Cameras.look_at(eyes, targets, up=(0, 0, 1), width=64, height=48, fov=60.0)
    poses = np.linalg.inv(cameras.viewmats) * [1.0, -1.0, -1.0, 1.0]  # OpenGL axes
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose.tolist()} for k, pose in enumerate(poses)]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({"fl_x": 55.4, "w": 64, "h": 48, "frames": frames}))
    where = Where(cameras=str(file))
    check_where(where)
    place = find_place(Source("rooms", g), where)
    assert place.evidence is not None
    assert place.evidence.source == "cameras"
    assert place.cameras is not None
    assert np.allclose(place.cameras.viewpoints, eyes)
    assert place.upright is not None
    assert np.allclose(place.upright.up, [0, 0, 1], atol=1e-6)
    assert place.space is not None
    assert place.space.contains(eyes).mean() >= 0.5
    assert place.doubt == ""


def test_a_box_keeps_the_direction_that_is_given() -> None:
    place = find_place(Source("rooms", apartment()), Placed(box=(1.0, 1.0, 1.0, 2.0, 2.0, 2.0), up="0.1 -0.98 0.17"))
    assert place.space is not None
    assert np.allclose(place.space.up, OBLIQUE / np.linalg.norm(OBLIQUE))
    assert any("Check the up axis" in each for each in place.remarks)  # the floor lies elsewhere


def test_a_missing_file_of_cameras_is_said_before_work_begins() -> None:
    with pytest.raises(FileNotFoundError):
        check_where(Where(cameras="nowhere.json"))


@pytest.mark.parametrize(("box", "judging"), [(None, 10), ((0.5, 0.5, 0.5, 2.0, 2.0, 2.0), 20)])
def test_cameras_that_the_space_was_not_found_by_are_kept_as_judges(
    box: tuple[float, ...] | None, judging: int
) -> None:
    eyes = np.array([[1.0 + 0.05 * k, 1.5, 1.5] for k in range(20)])
    cameras = Cameras.look_at(eyes, eyes + np.array([1.0, 0.3, 0.0]), up=(0, 0, 1), width=64, height=48)
    place = find_place(Source("rooms", apartment()), Where(box=box), cameras=cameras)
    assert place.space is not None
    assert place.space.witnesses is not None
    assert len(place.space.witnesses.cameras) == judging
    assert f"{judging} of the 20 cameras" in place.space.witnesses.named
    if box is None:
        assert np.allclose(place.space.witnesses.cameras.viewpoints, eyes[1::2])
