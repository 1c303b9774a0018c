"""Hold posed images of a file: names, poses, intrinsics and sizes, with checks that all camera formats share.

OpenCV axes, camera from world, intrinsics in pixels with centers at +0.5. A file may mix image sizes, but `Cameras` may
not; this module converts one to the other. It knows no format.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.fields import parse_json
from gsvis.files.limits import read_whole
from gsvis.io._wrapped import HEAD, check_pointer
from gsvis.scene.cameras import Cameras

__all__ = ["Views", "pinhole", "pose_of_camera", "read_json", "to_numbers"]

F64 = NDArray[np.float64]
Path_ = str | PathLike[str]

MAX_SIDE = 1 << 20
"""Largest side in pixels; a longer side means a broken file."""


@dataclass(frozen=True)
class Views:
    """C posed images in the order of their file.

    Args:
        path: Path of their file, for messages.
        names: C image names.
        viewmats: C matrices (4, 4), camera from world.
        Ks: C matrices (3, 3), pixels of that image.
        sizes: C pairs (width, height), pixels.
    """

    path: Path_
    names: list[str]
    viewmats: list[F64]
    Ks: list[F64]
    sizes: list[tuple[int, int]]

    def cameras(self, size: tuple[int, int] | None = None) -> Cameras:
        """Return one `Cameras`, sorted by name; `size` (width, height) rescales all images to one size.

        Raises:
            FormatError: If there is no image, if sizes are mixed and `size` is None, or if intrinsics are unusable.
        """
        if not self.names:
            raise FormatError(self.path, "", "at least one posed image", "none")
        if size is None:
            found = sorted(set(self.sizes))
            if len(found) > 1:
                text = ", ".join(f"{w} x {h}" for w, h in found[:4]) + (", ..." if len(found) > 4 else "")
                remedy = "give one size to rescale to, size=(width, height) or --width and --height"
                raise FormatError(self.path, "", "images of one size", f"{len(found)} sizes: {text}", remedy)
            size = found[0]
        order = sorted(range(len(self.names)), key=self.names.__getitem__)
        factors = np.ones((len(order), 3))
        factors[:, :2] = np.array(size) / np.array([self.sizes[i] for i in order], np.float64)
        ks = np.stack([self.Ks[i] for i in order]) * factors[:, :, None]
        poses = np.stack([self.viewmats[i] for i in order])
        try:
            return Cameras(poses, ks, size[0], size[1], tuple(self.names[i] for i in order))
        except ValueError as error:
            raise FormatError(self.path, "", "usable cameras", str(error)) from error


def pinhole(path: Path_, where: str, focals: F64, center: F64, size: tuple[int, int]) -> F64:
    """Return (3, 3) intrinsics of two focal lengths and a principal point, all in pixels of an image of `size`.

    Raises:
        FormatError: If a focal length is not positive, a number is not finite or a side is out of range.
    """
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise FormatError(path, where, f"an image size of 1 to {MAX_SIDE} pixels", f"{size[0]!s:.20} x {size[1]!s:.20}")
    if not (np.isfinite(focals).all() and focals.min() > 0):
        raise FormatError(path, where, "focal lengths > 0", " ".join(f"{f:g}" for f in focals))
    if not np.isfinite(center).all():
        raise FormatError(path, where, "a finite principal point", " ".join(f"{c:g}" for c in center))
    return np.array([[focals[0], 0.0, center[0]], [0.0, focals[1], center[1]], [0.0, 0.0, 1.0]])


def pose_of_camera(path: Path_, where: str, rotation: F64, position: F64) -> F64:
    """Return the (4, 4) camera-from-world matrix of a camera with given axes and position in the world.

    Files print rotations with few digits, so the nearest true rotation is used.

    Args:
        path: The file, for messages.
        where: The place in it, for messages.
        rotation: (3, 3) world from camera, OpenCV axes in its columns, orthonormal to 1e-2.
        position: (3,) viewpoint, world frame.

    Raises:
        FormatError: If a number is not finite or `rotation` is far from a rotation.
    """
    if not (np.isfinite(rotation).all() and np.isfinite(position).all()):
        raise FormatError(path, where, "finite numbers in a pose", "NaN or infinity")
    with np.errstate(all="ignore"):  # huge numbers become infinity or NaN, which is rejected
        defect = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if not defect <= 1e-2 or np.linalg.det(rotation) < 0:
        text = f"a matrix that is off by {defect:.2g}" if not defect <= 1e-2 else "a mirrored one (determinant -1)"
        raise FormatError(path, where, "a rotation (orthonormal columns, determinant 1)", text)
    u, _, vt = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = (u @ vt).T
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def read_json(path: Path_) -> Any:
    """Return the value in a JSON file.

    Raises:
        FormatError: If the file is not JSON, or is a pointer of Git LFS or git-annex.
        OSError: If it cannot be read.
    """
    content = read_whole(path)
    check_pointer(path, content[:HEAD])
    return parse_json(path, content)


def to_numbers(path: Path_, where: str, value: Any, shape: tuple[int, ...]) -> F64:
    """Return a float64 array of the given shape from a JSON value; () for a single number.

    Raises:
        FormatError: If its shape or type differs, or it is not finite.
    """
    expected = "a number" if not shape else f"{' x '.join(map(str, shape))} numbers"
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            raise TypeError  # a string, a boolean, an object or a ragged list
        array = array.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(path, where, expected, _short(value)) from error
    if array.shape != shape:
        raise FormatError(path, where, expected, f"an array of shape {array.shape}" if array.ndim else _short(value))
    if not np.isfinite(array).all():
        raise FormatError(path, where, f"{expected}, finite", "NaN or infinity")
    return array


def _short(value: Any) -> str:
    """Return a JSON value as a short text."""
    if value is None:
        return "nothing"
    return f"{type(value).__name__} {value!r:.60}"
