"""Read COLMAP sparse models, binary and text: the cameras, images and points of a folder.

Poses are camera from world in OpenCV axes, quaternions wxyz, and pixel centers lie at +0.5, as everywhere in gsvis.
Only undistorted cameras are accepted: PINHOLE, SIMPLE_PINHOLE, and models whose distortion is zero. Tracks are skipped.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.limits import check_regular, open_regular
from gsvis.io._wrapped import HEAD, check_pointer
from gsvis.io.views import F64, Views, pinhole
from gsvis.scene.gaussians import rotations_from_quats

__all__ = ["find_colmap", "find_colmap_points", "read_colmap", "read_colmap_points"]

# Name and number of parameters of COLMAP's camera models, by their id in the binary file.
_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
# Number of focal lengths of models that are pinholes if all parameters after the principal point are 0.
_FOCALS = {
    "SIMPLE_PINHOLE": 1,
    "PINHOLE": 2,
    "SIMPLE_RADIAL": 1,
    "RADIAL": 1,
    "SIMPLE_DIVISION": 1,
    "OPENCV": 2,
    "FULL_OPENCV": 2,
    "DIVISION": 2,
    "FOV": 2,
}
_UNDISTORT = "undistort the images with `colmap image_undistorter` and use its model"

Camera = tuple[str, int, int, F64]  # model, width, height, parameters
Image = tuple[str, int, F64, F64]  # name, camera id, quaternion wxyz, translation


def find_colmap(path: Path) -> Path | None:
    """Return the folder of a COLMAP model: `path` or its usual `sparse/0`, `sparse` or `0`; None if there is none."""
    for folder in (path, path / "sparse" / "0", path / "sparse", path / "0"):
        for suffix in (".bin", ".txt"):
            if (folder / f"cameras{suffix}").is_file() or (folder / f"images{suffix}").is_file():
                return folder
    return None


def read_colmap(folder: Path) -> Views:
    """Return the posed images of a COLMAP model.

    Args:
        folder: Folder with `cameras.bin` and `images.bin`, or the same with `.txt`; the binary pair is preferred.

    Raises:
        FormatError: If a file is missing, truncated or malformed, or a camera in use is distorted.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() or (folder / "cameras.bin").is_file() else ".txt"
    paths = folder / f"cameras{suffix}", folder / f"images{suffix}"
    for path in paths:
        if not path.is_file():
            raise FormatError(folder, "", f"{path.name} beside the other file of the model", "no such file")
    cameras = _cameras_bin(paths[0]) if suffix == ".bin" else _cameras_txt(paths[0])
    images = _images_bin(paths[1]) if suffix == ".bin" else _images_txt(paths[1])
    views = Views(paths[1], [], [], [], [])
    intrinsics = {}
    for name, camera_id, quat, translation in images:
        where = f"image {name!r}"
        if camera_id not in cameras:
            raise FormatError(paths[1], where, "the id of a camera in " + paths[0].name, str(camera_id))
        if camera_id not in intrinsics:
            intrinsics[camera_id] = _intrinsics(paths[0], camera_id, cameras[camera_id])
        with np.errstate(over="ignore"):
            length = float(np.linalg.norm(quat))
        if not (np.isfinite(length) and length > 1e-6 and np.isfinite(translation).all()):
            raise FormatError(paths[1], where, "a finite pose with a non-zero quaternion", f"{quat} {translation}")
        pose = np.eye(4)
        pose[:3, :3] = rotations_from_quats((quat / length)[None])[0]
        pose[:3, 3] = translation
        views.names.append(name)
        views.viewmats.append(pose)
        views.Ks.append(intrinsics[camera_id])
        views.sizes.append(cameras[camera_id][1:3])
    return views


def find_colmap_points(folder: Path) -> Path | None:
    """Return the points file of a COLMAP model: `points3D.bin`, `.txt`, or the `.ply` that 3DGS creates from them."""
    paths = [folder / f"points3D{suffix}" for suffix in (".bin", ".txt", ".ply")]
    return next((path for path in paths if path.is_file()), None)


def read_colmap_points(path: Path) -> tuple[F64, NDArray[np.uint8]]:
    """Return the points of a `points3D.bin` or `points3D.txt`, in file order; positions are not checked.

    Returns:
        positions: (N, 3), frame of the model.
        colors: (N, 3) sRGB, 255 is white.

    Raises:
        FormatError: If the file is truncated or malformed.
    """
    return _points_bin(path) if path.suffix == ".bin" else _points_txt(path)


def _intrinsics(path: Path, camera_id: int, camera: Camera) -> F64:
    """Return the pinhole matrix of a camera; raise if it is distorted."""
    model, width, height, p = camera
    where = f"camera {camera_id}"
    expected = "a camera without distortion, such as PINHOLE"
    if model not in _FOCALS:
        raise FormatError(path, where, expected, model, _UNDISTORT)
    focals = _FOCALS[model]
    distortion = p[focals + 2 :]
    if distortion.any():
        got = f"{model} with distortion {' '.join(f'{value:g}' for value in distortion)}"
        raise FormatError(path, where, expected, got, _UNDISTORT)
    focal = p[[0, 0]] if focals == 1 else p[:2]
    return pinhole(path, where, focal, p[focals : focals + 2], (width, height))


class _Bytes:
    """A file that is read from front to back, never past its end."""

    def __init__(self, path: Path, data: mmap.mmap | bytes) -> None:
        self.path = path
        self.data = data
        self.at = 0

    def take(self, form: str, what: str) -> tuple[Any, ...]:
        """Return the next values of a `struct` format."""
        self.require(struct.calcsize(form), what)
        values = struct.unpack_from(form, self.data, self.at)
        self.at += struct.calcsize(form)
        return values

    def count(self, least: int, what: str) -> int:
        """Return a 64-bit count of records of at least `least` bytes; raise if the file is too short for them."""
        (number,) = self.take("<Q", f"the number of {what}")
        rest = len(self.data) - self.at
        if number * least > rest:
            got = f"a count of {number:,} and {rest:,} bytes to hold them"
            raise FormatError(self.path, f"byte {self.at - 8:,}", f"a possible number of {what}", got)
        return int(number)

    def require(self, size: int, what: str) -> None:
        """Raise unless the file has that many bytes left."""
        rest = len(self.data) - self.at
        if size > rest:
            where = f"byte {self.at:,}"
            raise FormatError(self.path, where, f"{size:,} bytes for {what}", f"the end of the file after {rest:,}")

    def name(self, what: str) -> str:
        """Return the next text that ends with a zero byte."""
        end = self.data.find(b"\0", self.at, self.at + 4096)
        if end < 0:
            raise FormatError(self.path, f"byte {self.at:,}", f"{what} that ends within 4,096 bytes", "no end")
        raw = bytes(self.data[self.at : end])
        self.at = end + 1
        return raw.decode("utf-8", errors="replace")


@contextmanager
def _open(path: Path) -> Iterator[_Bytes]:
    """Map a file into memory as bytes."""
    if check_regular(path).st_size == 0:  # an empty file cannot be mapped
        yield _Bytes(path, b"")
        return
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        check_pointer(path, data[:HEAD])
        yield _Bytes(path, data)


def _cameras_bin(path: Path) -> dict[int, Camera]:
    """Return the cameras of a binary file by id."""
    cameras: dict[int, Camera] = {}
    with _open(path) as data:
        for _ in range(data.count(24 + 2 * 8, "cameras")):
            start = data.at
            camera_id, model, width, height = data.take("<iiQQ", "a camera")
            if not 0 <= model < len(_MODELS):
                raise FormatError(path, f"byte {start + 4:,}", f"a model id from 0 to {len(_MODELS) - 1}", str(model))
            name, number = _MODELS[model]
            parameters = data.take(f"<{number}d", f"the parameters of camera {camera_id}")
            cameras[camera_id] = (name, width, height, np.array(parameters))
    return cameras


def _images_bin(path: Path) -> Iterator[Image]:
    """Yield the images of a binary file."""
    with _open(path) as data:
        for _ in range(data.count(64 + 1 + 8, "images")):
            _, *pose, camera_id = data.take("<i7di", "an image")
            name = data.name("an image name")
            points = data.count(24, f"points in image {name!r}")
            data.at += 24 * points
            yield name, camera_id, np.array(pose[:4]), np.array(pose[4:])


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file, stripped, with their numbers."""
    with TextIOWrapper(open_regular(path), encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if number == 1:
                check_pointer(path, line.encode()[:HEAD])
            yield number, line.strip()


def _cameras_txt(path: Path) -> dict[int, Camera]:
    """Return the cameras of a text file by id."""
    cameras: dict[int, Camera] = {}
    counts = dict(_MODELS)
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        camera_id, model, width, height, *parameters = [*line.split(), "", "", "", ""]
        try:
            values = np.array([float(p) for p in parameters if p])
            camera = (model, int(width), int(height), values)
            key = int(camera_id)
        except ValueError as error:
            expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
            raise FormatError(path, f"line {number}", expected, repr(line[:80])) from error
        if len(values) != counts.get(model, len(values)):
            got = f"{len(values)} parameters"
            raise FormatError(path, f"line {number}", f"{counts[model]} parameters of {model}", got)
        cameras[key] = camera
    return cameras


def _images_txt(path: Path) -> Iterator[Image]:
    """Yield the images of a text file; the line of points after an image may be empty or missing."""
    may_be_points = False
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        if may_be_points and _are_points(line):
            may_be_points = False
            continue
        fields = line.split(maxsplit=9)
        try:
            _, *pose = [float(f) for f in fields[:8]]
            camera_id = int(fields[8])
            name = fields[9]
        except (ValueError, IndexError) as error:
            expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise FormatError(path, f"line {number}", expected, repr(line[:80])) from error
        may_be_points = True
        yield name, camera_id, np.array(pose[:4]), np.array(pose[4:])


def _are_points(line: str) -> bool:
    """Return whether a line holds X Y POINT3D_ID for each point of an image; an id is a whole number."""
    fields = line.split()
    if len(fields) % 3:
        return False
    try:
        for x, y, point in zip(fields[::3], fields[1::3], fields[2::3], strict=True):
            float(x)
            float(y)
            int(point)
    except ValueError:
        return False
    return True


def _points_bin(path: Path) -> tuple[F64, NDArray[np.uint8]]:
    """Return positions and colors of a binary file."""
    with _open(path) as data:
        number = data.count(51, "points")
        positions = np.empty((number, 3))
        colors = np.empty((number, 3), np.uint8)
        for i in range(number):
            _, *position, red, green, blue, _ = data.take("<Q3d3Bd", f"point {i:,}")
            images = data.count(8, f"images that see point {i:,}")
            data.at += 8 * images
            positions[i] = position
            colors[i] = (red, green, blue)
    return positions, colors


def _points_txt(path: Path) -> tuple[F64, NDArray[np.uint8]]:
    """Return positions and colors of a text file."""
    positions: list[list[float]] = []
    colors: list[list[int]] = []
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        fields = line.split(maxsplit=8)
        try:
            _, x, y, z, *rgb = fields[:7]
            positions.append([float(x), float(y), float(z)])
            colors.append([int(c) for c in rgb])
            good = len(rgb) == 3 and all(0 <= c <= 255 for c in colors[-1])
        except ValueError:
            good = False
        if not good:
            raise FormatError(path, f"line {number}", "POINT3D_ID X Y Z R G B ERROR", repr(line[:80]))
    return np.array(positions, np.float64).reshape(-1, 3), np.array(colors, np.uint8).reshape(-1, 3)
