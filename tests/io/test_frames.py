"""Cameras of another frame: what brings them back, and what is said of those that see nothing."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gsvis import Cameras, Gaussians
from gsvis.errors import ArgumentError, FormatError
from gsvis.io.dataparser import read_dataparser
from gsvis.io.frames import fit_cameras, move_cameras
from gsvis.scene.sight import blind
from gsvis.scene.similarity import Similarity

MOVE = Similarity(0.2355, (0.8, 0.3, -0.2, 0.5), (1.9, -1.2, 0.7))


def room(scale: float = 1.0) -> Gaussians:
    """The faces of a box 6 x 4 x 3."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-0.5, 0.5, (600, 3))
    faces = rng.integers(0, 3, 600)
    means[np.arange(600), faces] = np.where(rng.random(600) < 0.5, -0.5, 0.5)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (600, 1))
    scales = np.full((600, 3), 0.15 * scale)
    return Gaussians(means * np.array([6, 4, 3]) * scale, still, scales, np.full(600, 0.9), np.zeros((600, 1, 3)))


def inside(scale: float = 1.0) -> Cameras:
    """24 cameras in the room that look in all directions."""
    rng = np.random.default_rng(1)
    eyes = rng.uniform(-0.3, 0.3, (24, 3)) * np.array([6, 4, 3]) * scale
    return Cameras.look_at(eyes, eyes + rng.normal(size=(24, 3)) * scale, up=(0, 0, 1), width=64, height=48)


def write(folder, move, **more):
    """Write what nerfstudio writes of `move`: x -> scale (R x + t)."""
    matrix = np.column_stack([move.rotation, move.translation / move.scale])
    path = folder / "dataparser_transforms.json"
    path.write_text(json.dumps({"transform": matrix.tolist(), "scale": move.scale, **more}))
    return path


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_cameras_in_a_room_see_it_in_any_units(scale):
    assert not blind(room(scale), inside(scale)).any()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_cameras_far_outside_are_blind_in_any_units(scale):
    cameras = move_cameras(inside(scale), Similarity(translation=(900.0 * scale, 0, 0)))
    assert blind(room(scale), cameras).all()


@pytest.mark.parametrize("beside", ["cameras", "scene"])
def test_the_dataparser_is_applied_where_it_helps(tmp_path, beside):
    (tmp_path / "cameras" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "scene").mkdir()
    write(tmp_path / beside, MOVE)
    scene = room().transform(MOVE.rotation, MOVE.translation, MOVE.scale)
    found = fit_cameras(scene, inside(), tmp_path / "cameras" / "sparse" / "0", tmp_path / "scene" / "splat.ply")
    assert found.blind == 0.0
    np.testing.assert_allclose(found.cameras.viewpoints, MOVE.apply(inside().viewpoints), atol=1e-12)
    assert len(found.remarks) == 1
    assert "dataparser_transforms.json: 24 of 24 see it" in found.remarks[0]


def test_what_transforms_json_applied_is_undone_first(tmp_path):
    write(tmp_path, MOVE)
    applied = Similarity(1.0, (0.7071067811865476, 0.7071067811865476, 0, 0), (0, 3.0, 0))
    matrix = np.column_stack([applied.rotation, applied.translation])
    (tmp_path / "transforms.json").write_text(json.dumps({"applied_transform": matrix.tolist(), "frames": []}))
    scene = room().transform(MOVE.rotation, MOVE.translation, MOVE.scale)
    found = fit_cameras(scene, move_cameras(inside(), applied), tmp_path / "transforms.json")
    np.testing.assert_allclose(found.cameras.viewpoints, MOVE.apply(inside().viewpoints), atol=1e-9)


def test_cameras_that_see_the_scene_stay(tmp_path):
    write(tmp_path, MOVE)
    cameras = inside()
    found = fit_cameras(room(), cameras, tmp_path)
    assert found.cameras is cameras
    assert not found.remarks


def test_a_line_says_that_most_see_nothing():
    found = fit_cameras(room(), move_cameras(inside(), Similarity(translation=(70.0, 0, 0))), None)
    assert found.blind > 0.5
    assert len(found.remarks) == 1
    assert "of 24 cameras see nothing of the scene" in found.remarks[0]
    assert "dataparser_transforms.json" in found.remarks[0]


def test_moved_cameras_see_the_moved_scene_alike():
    moved = move_cameras(inside(), MOVE)
    points = room().means.astype(float)
    for before, after in zip(inside().viewmats, moved.viewmats, strict=True):
        there = MOVE.apply(points) @ after[:3, :3].T + after[:3, 3]
        np.testing.assert_allclose(there, MOVE.scale * (points @ before[:3, :3].T + before[:3, 3]), atol=1e-9)


@pytest.mark.parametrize(
    "change", [{"transform": [[1, 2], [3, 4]]}, {"scale": -1}, {"transform": np.ones((3, 4)).tolist()}]
)
def test_a_malformed_file_is_named(tmp_path, change):
    path = write(tmp_path, MOVE, **change)
    with pytest.raises(FormatError, match="dataparser_transforms"):
        read_dataparser(path)


def test_a_stated_frame_is_obeyed(tmp_path):
    write(tmp_path, MOVE)
    path = tmp_path / "transforms.json"
    far = room().transform(MOVE.rotation, MOVE.translation, MOVE.scale)
    kept = fit_cameras(far, inside(), path, frame="scene")
    assert kept.transform is None
    np.testing.assert_array_equal(kept.cameras.viewpoints, inside().viewpoints)
    moved = fit_cameras(room(), inside(), path, frame="capture")  # even where they see the scene as they are
    np.testing.assert_allclose(moved.cameras.viewpoints, MOVE.apply(inside().viewpoints), atol=1e-12)
    assert "dataparser_transforms.json" in moved.remarks[0]


def test_a_stated_capture_needs_the_file(tmp_path):
    with pytest.raises(ArgumentError, match=r"dataparser_transforms.json beside .*cams for capture"):
        fit_cameras(room(), inside(), tmp_path / "cams", frame="capture")
