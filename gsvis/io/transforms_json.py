"""Read `transforms.json` of NeRF tools (instant-ngp, nerfstudio): one JSON object with a list of frames.

`transform_matrix` is world from camera in OpenGL axes (+x right, +y up, +z backward). The reader returns camera from
world in OpenCV axes. Intrinsics are at the top or in a frame; the frame wins. Images are not opened.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsvis.errors import FormatError
from gsvis.io.views import F64, Views, pinhole, pose_of_camera, to_numbers

__all__ = ["read_transforms"]

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(path: Path, content: dict[str, Any], size: tuple[int, int] | None = None) -> Views:
    """Return the posed images of a `transforms.json`.

    Args:
        path: The file, for messages.
        content: Its JSON value.
        size: (width, height) in pixels to assume if the file states none, as in synthetic NeRF data.

    Raises:
        FormatError: If a key is missing or malformed, or the images are distorted.
    """
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise FormatError(path, "frames", "a list", type(frames).__name__)
    views = Views(path, [], [], [], [])
    for index, frame in enumerate(frames):
        where = f"frames[{index}]"
        if not isinstance(frame, dict):
            raise FormatError(path, where, "an object", type(frame).__name__)
        name = frame.get("file_path", f"{index:05d}")
        if not isinstance(name, str):
            raise FormatError(path, f"{where}.file_path", "a string", type(name).__name__)
        matrix = frame.get("transform_matrix")
        rows = 3 if isinstance(matrix, list) and len(matrix) == 3 else 4
        opengl = to_numbers(path, f"{where}.transform_matrix", matrix, (rows, 4))
        axes = opengl[:3, :3] * np.array([1.0, -1.0, -1.0])  # OpenGL's y and z are reversed
        views.viewmats.append(pose_of_camera(path, f"{where}.transform_matrix", axes, opengl[:3, 3]))
        k, pixels = _intrinsics(path, where, {**content, **frame}, size)
        views.names.append(name.removeprefix("./"))
        views.Ks.append(k)
        views.sizes.append(pixels)
    return views


def _intrinsics(
    path: Path, where: str, values: dict[str, Any], size: tuple[int, int] | None
) -> tuple[F64, tuple[int, int]]:
    """Return the pinhole matrix of one frame and its image size."""

    def number(key: str) -> float | None:
        return None if values.get(key) is None else float(to_numbers(path, f"{where}: {key}", values[key], ()))

    distorted = [key for key in _DISTORTION if number(key)]
    if distorted or "FISHEYE" in str(values.get("camera_model", "")).upper():
        got = f"distortion {' '.join(distorted)}" if distorted else str(values["camera_model"])
        remedy = "undistort the images, for example with `colmap image_undistorter`, and use the model that it writes"
        raise FormatError(path, where, "a pinhole camera", got, remedy)
    width, height = number("w"), number("h")
    if width is None or height is None:
        if size is None:
            remedy = "give one, size=(width, height) or --width and --height"
            raise FormatError(path, where, "an image size (w, h)", "none", remedy)
        width, height = size
    focal_x, focal_y = number("fl_x"), number("fl_y")
    if focal_x is None:
        focal_x = _focal(path, where, width, number("camera_angle_x"))
    if focal_y is None:
        focal_y = _focal(path, where, height, number("camera_angle_y")) if "camera_angle_y" in values else focal_x
    if focal_x is None or focal_y is None:
        raise FormatError(path, where, "fl_x or camera_angle_x", "neither")
    center_x, center_y = number("cx"), number("cy")
    center = [width / 2 if center_x is None else center_x, height / 2 if center_y is None else center_y]
    pixels = (int(width), int(height))
    return pinhole(path, where, np.array([focal_x, focal_y]), np.array(center), pixels), pixels


def _focal(path: Path, where: str, side: float, angle: float | None) -> float | None:
    """Return the focal length in pixels for a full angle in radians across `side` pixels."""
    if angle is None:
        return None
    if not 0.0 < angle < np.pi:
        raise FormatError(path, where, "a field of view in (0, pi) radians", f"{angle:g}")
    return float(0.5 * side / np.tan(angle / 2.0))
