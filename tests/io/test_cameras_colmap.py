"""COLMAP models: both encodings give the poses that were written; damaged files are refused, never guessed."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import FormatError
from gsvis.io.cameras import load_cameras
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations

CAMERAS = Cameras.orbit((1.0, 2.0, 3.0), 4.0, 5, width=64, height=48, fov=70.0)
K = CAMERAS.Ks[0]


def write_binary(folder: Path, model: int = 1) -> Path:
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]] if model == 1 else [K[0, 0], K[0, 2], K[1, 2]]
    head = struct.pack(f"<QiiQQ{len(parameters)}d", 1, 7, model, 64, 48, *parameters)
    body = struct.pack("<Q", len(CAMERAS))
    quats = quats_from_rotations(CAMERAS.viewmats[:, :3, :3])
    for i, (quat, pose) in enumerate(zip(quats, CAMERAS.viewmats, strict=True)):
        body += struct.pack("<i7di", i + 1, *quat, *pose[:3, 3], 7) + f"{i:05d}".encode() + b"\0"
        body += struct.pack("<Q", 2) + struct.pack("<ddq", 1.0, 2.0, -1) * 2
    (folder / "cameras.bin").write_bytes(head)
    (folder / "images.bin").write_bytes(body)
    return folder


def write_text(folder: Path) -> Path:
    (folder / "cameras.txt").write_text(
        "# Camera list\n# CAMERA_ID, MODEL, ...\n\n"
        f"7 PINHOLE 64 48 {K[0, 0]:.17g} {K[1, 1]:.17g} {K[0, 2]:.17g} {K[1, 2]:.17g}\n"
        "8 OPENCV 64 48 1 1 1 1 0.1 0 0 0\n"  # distorted, but no image uses it
    )
    quats = quats_from_rotations(CAMERAS.viewmats[:, :3, :3])
    rows = ["# Image list"]
    for i, (quat, pose) in enumerate(zip(quats, CAMERAS.viewmats, strict=True)):
        numbers = " ".join(repr(float(v)) for v in (*quat, *pose[:3, 3]))
        rows += [f"{i + 1} {numbers} 7 {i:05d}", "1.0 2.0 -1 3.0 4.0 5" if i % 2 else ""]
    (folder / "images.txt").write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.parametrize("form", ["PINHOLE", "SIMPLE_PINHOLE", "text"])
def test_poses_come_back_as_written(tmp_path: Path, form: str) -> None:
    folder = write_text(tmp_path) if form == "text" else write_binary(tmp_path, int(form == "PINHOLE"))
    read = load_cameras(folder)
    np.testing.assert_allclose(read.viewmats, CAMERAS.viewmats, atol=1e-12)
    np.testing.assert_allclose(read.Ks, CAMERAS.Ks)
    assert (read.width, read.height, read.names) == (64, 48, CAMERAS.names)


def test_quaternions_of_any_length_are_one_rotation(tmp_path: Path) -> None:
    write_text(tmp_path)
    (tmp_path / "images.txt").write_text("1 2 0 0 2 0 0 0 7 a\n\n2 -0.5 0 0 -0.5 0 0 0 7 b\n\n")
    poses = load_cameras(tmp_path).viewmats
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-12)
    np.testing.assert_allclose(poses[0, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(("file", "keep"), [("cameras.bin", 64), ("images.bin", 8 + 5 * (64 + 6 + 8 + 48))])
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, file: str, keep: int) -> None:
    whole = (write_binary(tmp_path) / file).read_bytes()
    assert len(whole) == keep
    for length in range(len(whole)):
        (tmp_path / file).write_bytes(whole[:length])
        with pytest.raises(FormatError, match=file.replace(".", r"\.")):
            load_cameras(tmp_path)


@given(at=st.integers(0, 10_000), junk=st.binary(min_size=1, max_size=9), file=st.sampled_from(["cameras", "images"]))
def test_damage_is_refused_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, at: int, junk: bytes, file: str
) -> None:
    folder = write_binary(tmp_path_factory.mktemp("damaged"))
    path = folder / f"{file}.bin"
    data = bytearray(path.read_bytes())
    at %= len(data)
    data[at : at + len(junk)] = junk
    path.write_bytes(data)
    try:
        assert len(load_cameras(folder)) <= len(CAMERAS)
    except FormatError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_absurd_counts_are_refused_without_memory(tmp_path: Path, file: str) -> None:
    path = write_binary(tmp_path) / file
    path.write_bytes(struct.pack("<Q", 2**62) + path.read_bytes()[8:])
    tracemalloc.start()
    with pytest.raises(FormatError, match="a possible number"):
        load_cameras(tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_a_name_without_an_end_is_refused(tmp_path: Path) -> None:
    write_binary(tmp_path)
    pose = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 0, 7)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 1) + pose + b"n" * 5000)
    with pytest.raises(FormatError, match=r"byte 72: expected an image name that ends within 4,096 bytes"):
        load_cameras(tmp_path)


@pytest.mark.parametrize(
    ("cameras", "images", "message"),
    [
        (
            "1 OPENCV 64 48 1 1 1 1 0 0.1 0 0",
            "1 1 0 0 0 0 0 0 1 a",
            "got OPENCV with distortion 0 0.1 0 0; undistort .* image_undistorter",
        ),
        ("1 PINHOLE 64 48 50 50 32", "1 1 0 0 0 0 0 0 1 a", "line 1: expected 4 parameters of PINHOLE, got 3"),
        ("1 PINHOLE 64 48 50 50 32 x", "1 1 0 0 0 0 0 0 1 a", "line 1: expected CAMERA_ID MODEL"),
        ("1 PINHOLE 0 48 50 50 32 24", "1 1 0 0 0 0 0 0 1 a", "expected an image size"),
        ("1 PINHOLE 64 48 -1 50 32 24", "1 1 0 0 0 0 0 0 1 a", "expected focal lengths > 0, got -1 50"),
        ("1 PINHOLE 64 48 50 50 nan 24", "1 1 0 0 0 0 0 0 1 a", "finite principal point"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1 0 0 0 0 0 0 2 a", "image 'a': expected the id of a camera"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 0 0 0 0 0 0 0 1 a", "non-zero quaternion"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1 0 0 0 inf 0 0 1 a", "finite pose"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1e300 1e300 0 0 0 0 0 1 a", "finite pose"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1 0 0 0 0 0 0 1", "line 1: expected IMAGE_ID QW"),
        ("1 PINHOLE 64 48 50 50 32 24", "# none", "expected at least one posed image, got none"),
    ],
)
def test_what_is_wrong_in_text_is_reported(tmp_path: Path, cameras: str, images: str, message: str) -> None:
    (tmp_path / "cameras.txt").write_text(cameras + "\n")
    (tmp_path / "images.txt").write_text(images + "\n\n")
    with pytest.raises(FormatError, match=message):
        load_cameras(tmp_path)


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize("points", ["10 20 7 11 21.5 -1", "", None])
def test_lines_of_points_may_be_there_or_empty_or_missing(tmp_path: Path, points: str | None, ending: str) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    lines = ["# images", ""]
    for number in range(6):
        lines.append(f"{number + 1} 1 0 0 0 {number} 0 0 1 {number}.jpg")
        if points is not None:
            lines.append(points)
    for last in ("", ending):
        (tmp_path / "images.txt").write_bytes((ending.join(lines) + last).encode())
        cameras = load_cameras(tmp_path)
        assert cameras.names == tuple(f"{number}.jpg" for number in range(6))
        np.testing.assert_allclose(-cameras.viewpoints[:, 0], range(6))


@pytest.mark.parametrize(
    ("lens", "K"),
    [
        ("SIMPLE_RADIAL 64 48 50 32 24 0", (50, 50, 32, 24)),
        ("RADIAL 64 48 50 32 24 0 0", (50, 50, 32, 24)),
        ("OPENCV 64 48 50 51 32 24 0 0 0 0", (50, 51, 32, 24)),
        ("FULL_OPENCV 64 48 50 51 32 24 0 0 0 0 0 0 0 0", (50, 51, 32, 24)),
        ("FOV 64 48 50 51 32 24 0", (50, 51, 32, 24)),
        ("DIVISION 64 48 50 51 32 24 0", (50, 51, 32, 24)),
    ],
)
def test_a_model_without_distortion_is_a_pinhole(tmp_path: Path, lens: str, K: tuple[float, ...]) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 {lens}\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a\n")
    found = load_cameras(tmp_path).Ks[0]
    assert (found[0, 0], found[1, 1], found[0, 2], found[1, 2]) == K


@pytest.mark.parametrize(
    "lens", ["OPENCV_FISHEYE 64 48 50 50 32 24 0 0 0 0", "SIMPLE_FISHEYE 64 48 50 32 24", "EQUIRECTANGULAR 64 48 64 48"]
)
def test_a_fisheye_is_no_pinhole_whatever_its_distortion(tmp_path: Path, lens: str) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 {lens}\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a\n")
    with pytest.raises(FormatError, match=f"got {lens.split()[0]}; undistort"):
        load_cameras(tmp_path)


def test_an_unknown_model_and_a_missing_partner_are_reported(tmp_path: Path) -> None:
    write_binary(tmp_path)
    data = bytearray((tmp_path / "cameras.bin").read_bytes())
    data[12:16] = struct.pack("<i", 99)
    (tmp_path / "cameras.bin").write_bytes(data)
    with pytest.raises(FormatError, match="byte 12: expected a model id from 0 to 17, got 99"):
        load_cameras(tmp_path)
    (tmp_path / "cameras.bin").unlink()
    with pytest.raises(FormatError, match=r"expected cameras\.bin beside the other file of the model"):
        load_cameras(tmp_path)
