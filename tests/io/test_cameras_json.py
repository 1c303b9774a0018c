"""`transforms.json` and INRIA's `cameras.json`: the axes, the intrinsics, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import FormatError
from gsvis.io.cameras import load_cameras
from gsvis.scene.cameras import Cameras

CAMERAS = Cameras.orbit((1.0, 2.0, 3.0), 4.0, 5, width=64, height=48, fov=70.0)
EYE = np.eye(4).tolist()


def load(folder: Path, content: Any, **options: Any) -> Cameras:
    path = folder / "file.json"
    path.write_text(json.dumps(content))
    return load_cameras(path, **options)


def as_transforms(cameras: Cameras) -> dict[str, Any]:
    world_from_camera = np.linalg.inv(cameras.viewmats) @ np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": f"./{name}", "transform_matrix": matrix.tolist()}
        for name, matrix in zip(cameras.names, world_from_camera, strict=True)
    ]
    k = cameras.Ks[0]
    top = {"w": cameras.width, "h": cameras.height, "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
    return {**top, "frames": frames}


def as_inria(cameras: Cameras) -> list[dict[str, Any]]:
    return [
        {
            "id": i,
            "img_name": name,
            "width": cameras.width,
            "height": cameras.height,
            "position": cameras.viewpoints[i].tolist(),
            "rotation": cameras.viewmats[i, :3, :3].T.tolist(),
            "fx": cameras.Ks[i, 0, 0],
            "fy": cameras.Ks[i, 1, 1],
        }
        for i, name in enumerate(cameras.names)
    ]


@pytest.mark.parametrize("write", [as_transforms, as_inria])
def test_poses_come_back_as_written(tmp_path: Path, write: Any) -> None:
    read = load(tmp_path, write(CAMERAS))
    np.testing.assert_allclose(read.viewmats, CAMERAS.viewmats, atol=1e-12)
    np.testing.assert_allclose(read.Ks, CAMERAS.Ks)
    assert (read.width, read.height, read.names) == (64, 48, CAMERAS.names)


def test_an_unturned_opengl_camera_looks_along_minus_z_with_y_up(tmp_path: Path) -> None:
    camera = load(tmp_path, {"w": 4, "h": 4, "fl_x": 2.0, "frames": [{"transform_matrix": EYE}]})
    np.testing.assert_allclose(camera.forwards, [[0, 0, -1]])
    np.testing.assert_allclose(camera.viewmats[0, 1, :3], [0, -1, 0])  # image down is world -y


def test_three_rows_make_a_matrix_too(tmp_path: Path) -> None:
    content = as_transforms(CAMERAS)
    for frame in content["frames"]:
        frame["transform_matrix"] = frame["transform_matrix"][:3]
    np.testing.assert_allclose(load(tmp_path, content).viewmats, CAMERAS.viewmats, atol=1e-12)


@pytest.mark.parametrize(
    ("values", "focals", "center"),
    [
        ({"camera_angle_x": np.pi / 2}, (40.0, 40.0), (40.0, 30.0)),
        ({"camera_angle_x": np.pi / 2, "camera_angle_y": np.pi / 2}, (40.0, 30.0), (40.0, 30.0)),
        ({"fl_x": 50.0}, (50.0, 50.0), (40.0, 30.0)),
        ({"fl_x": 50.0, "fl_y": 51.0, "cx": 1.0, "cy": 2.0, "k1": 0, "p1": 0.0}, (50.0, 51.0), (1.0, 2.0)),
    ],
)
def test_intrinsics_stand_at_the_top_or_in_a_frame(
    tmp_path: Path, values: dict[str, float], focals: tuple[float, float], center: tuple[float, float]
) -> None:
    wrong = {"w": 7, "h": 7, "fl_x": 7.0} if "fl_x" in values else {"w": 7, "h": 7}
    expected = [[focals[0], 0, center[0]], [0, focals[1], center[1]], [0, 0, 1]]
    top = {"w": 80, "h": 60, **values, "frames": [{"transform_matrix": EYE}]}
    inside = {**wrong, "frames": [{"transform_matrix": EYE, "w": 80, "h": 60, **values}]}
    for content in (top, inside):
        np.testing.assert_allclose(load(tmp_path, content).Ks, [expected])


def test_a_file_without_a_size_takes_the_given_one(tmp_path: Path) -> None:
    content = {"camera_angle_x": np.pi / 2, "frames": [{"transform_matrix": EYE}]}
    with pytest.raises(FormatError, match=r"expected an image size \(w, h\), got none; give one, size="):
        load(tmp_path, content)
    camera = load(tmp_path, content, size=(100, 50))
    np.testing.assert_allclose(camera.Ks, [[[50, 0, 50], [0, 50, 25], [0, 0, 1]]])


def test_rotations_printed_with_few_digits_become_true_ones(tmp_path: Path) -> None:
    content = as_inria(CAMERAS)
    for entry in content:
        entry["rotation"] = np.round(entry["rotation"], 3).tolist()
    poses = load(tmp_path, content).viewmats
    np.testing.assert_allclose(poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), [np.eye(3)] * 5, atol=1e-12)
    np.testing.assert_allclose(poses, CAMERAS.viewmats, atol=1e-2)


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 3}, "frames: expected a list, got int"),
        ({"frames": []}, "expected at least one posed image, got none"),
        ({"frames": [3]}, r"frames\[0\]: expected an object"),
        ({"frames": [{}]}, r"frames\[0\].transform_matrix: expected 4 x 4 numbers, got nothing"),
        ({"frames": [{"transform_matrix": [[1, 2], [3]]}]}, "expected 4 x 4 numbers, got list"),
        ({"frames": [{"transform_matrix": [["a"] * 4] * 4}]}, "expected 4 x 4 numbers, got list"),
        ({"frames": [{"transform_matrix": [[float("nan")] * 4] * 4}]}, "finite, got NaN or infinity"),
        ({"frames": [{"transform_matrix": [[2.0] * 4] * 4}]}, "expected a rotation"),
        ({"frames": [{"transform_matrix": MIRROR}]}, "got a mirrored one"),
        ({"frames": [{"transform_matrix": EYE, "file_path": 3}]}, r"file_path: expected a string, got int"),
        ({"k1": 0.1}, "expected a pinhole camera, got distortion k1; undistort"),
        ({"camera_model": "EQUIRECTANGULAR"}, "got camera_model EQUIRECTANGULAR; undistort"),
        ({"is_fisheye": True}, "got is_fisheye; undistort"),
        ({"k6": 0.1}, "got distortion k6"),
        ({"distortion_params": [0, 0, 0.2]}, "got distortion_params"),
        ({"camera_model": "OPENCV_FISHEYE"}, "got camera_model OPENCV_FISHEYE; undistort"),
        ({"fl_x": None}, "expected fl_x or camera_angle_x, got neither"),
        ({"fl_x": None, "camera_angle_x": 4.0}, r"field of view in \(0, pi\)"),
        ({"fl_x": -1.0}, "expected focal lengths > 0"),
        ({"fl_x": "5"}, "fl_x: expected a number, got str '5'"),
        ({"fl_x": True}, "fl_x: expected a number, got bool True"),
        ({"fl_x": 10**400}, "fl_x: expected a number"),
        ({"w": 10**12}, "expected an image size"),
        ({"w": 0.5}, "expected an image size"),
    ],
)
def test_what_is_wrong_in_transforms_is_reported(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    content = {"w": 64, "h": 48, "fl_x": 50.0, "frames": [{"transform_matrix": EYE}]} | change
    with pytest.raises(FormatError, match=message):
        load(tmp_path, content)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotation": [1, 2, 3]}, r"\[0\].rotation: expected 3 x 3 numbers, got an array of shape \(3,\)"),
        ({"rotation": None}, r"\[0\].rotation: expected 3 x 3 numbers, got nothing"),
        ({"position": [1, 2]}, r"\[0\].position: expected 3 numbers"),
        ({"fx": 0}, "expected focal lengths > 0"),
        ({"width": -5}, "expected an image size"),
        ({"img_name": None}, r"\[0\].img_name: expected a string"),
    ],
)
def test_what_is_wrong_in_inria_cameras_is_reported(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        load(tmp_path, [as_inria(CAMERAS)[0] | change])
    with pytest.raises(FormatError, match=r"\[0\]: expected an object"):
        load(tmp_path, [3])
    with pytest.raises(FormatError, match="at least one"):
        load(tmp_path, [])


LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just(EYE)
ANYTHING = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=4), max_leaves=8)
KEYS = ["w", "h", "fl_x", "cx", "k1", "camera_angle_y", "transform_matrix", "file_path", "width", "fx", "rotation"]


@given(st.dictionaries(st.sampled_from(KEYS), ANYTHING, max_size=3))
def test_any_json_is_refused_or_read(tmp_path_factory: pytest.TempPathFactory, junk: dict[str, Any]) -> None:
    folder = tmp_path_factory.mktemp("json")
    whole = as_transforms(CAMERAS)
    for content in (whole | junk, {**whole, "frames": [whole["frames"][0] | junk]}, [as_inria(CAMERAS)[0] | junk]):
        try:
            assert len(load(folder, content)) >= 1
        except FormatError as error:
            assert len(str(error)) < 1000


@pytest.mark.parametrize(
    ("top", "of_frame", "focal"),
    [
        ({"fl_x": 100.0}, {"camera_angle_x": 2 * np.arctan(0.64)}, (50.0, 50.0)),
        ({"fl_x": 100.0, "fl_y": 100.0}, {"camera_angle_x": 2 * np.arctan(0.64)}, (50.0, 50.0)),
        ({"fl_x": 100.0, "fl_y": 110.0}, {"fl_x": 50.0}, (50.0, 55.0)),
        ({"camera_angle_x": 0.5}, {"fl_x": 50.0}, (50.0, 50.0)),
        ({"fl_x": 50.0}, {"fl_y": 45.0}, (50.0, 45.0)),
        ({"fl_x": 100.0, "camera_angle_y": 0.5}, {"fl_x": 50.0, "fl_y": 45.0}, (50.0, 45.0)),
    ],
)
def test_what_a_frame_states_wins(
    tmp_path: Path, top: dict[str, float], of_frame: dict[str, float], focal: tuple[float, float]
) -> None:
    frames = [{"file_path": "a", "transform_matrix": EYE, **of_frame}]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"w": 64, "h": 48, **top, "frames": frames}))
    found = load_cameras(path).Ks[0]
    np.testing.assert_allclose((found[0, 0], found[1, 1]), focal)


def test_the_principal_point_at_the_top_belongs_to_the_size_at_the_top(tmp_path: Path) -> None:
    frames = [{"file_path": "a", "transform_matrix": EYE, "w": 32, "h": 24, "fl_x": 50.0}]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"w": 64, "h": 48, "cx": 30.0, "cy": 20.0, "frames": frames}))
    np.testing.assert_allclose(load_cameras(path).Ks[0][:2, 2], (16.0, 12.0))
