"""Read `transforms.json` of NeRF tools (instant-ngp, nerfstudio): one JSON object with a list of frames.

`transform_matrix` is world from camera in OpenGL axes (+x right, +y up, +z backward). The reader returns camera from
world in OpenCV axes. Intrinsics are at the top level or in a frame; those of the frame win. Images are not opened.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsvis.errors import FormatError
from gsvis.io.views import F64, Views, pinhole, pose_of_camera, to_numbers

__all__ = ["read_transforms"]

_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
# Camera models that are pinholes if all distortion is 0.
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL")
_ACROSS = ("fl_x", "camera_angle_x")
_DOWN = ("fl_y", "camera_angle_y")
_UNDISTORT = "undistort the images, for example with `colmap image_undistorter`, and use its model"


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
        k, pixels = _intrinsics(path, where, _merge(content, frame), size)
        views.names.append(name.removeprefix("./"))
        views.Ks.append(k)
        views.sizes.append(pixels)
    return views


def _merge(content: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """Return the values for one frame: its own, and those at the top level that do not contradict them.

    Focal length and field of view are equivalent: one in the frame replaces both at the top level. If the frame gives
    only one axis, pixels keep the aspect ratio of the top level. The principal point at the top level belongs to the
    image size there.
    """
    top = dict(content)
    if any(key in frame and frame[key] != content.get(key) for key in ("w", "h")):
        for key in ("cx", "cy"):
            top.pop(key, None)
    across, down = (any(frame.get(key) is not None for key in keys) for keys in (_ACROSS, _DOWN))
    shape = _pixel_shape(content)
    stale = (*(_ACROSS if across else ()), *(_DOWN if down or (across and shape is not None) else ()))
    for key in stale:
        top.pop(key, None)
    if across and not down and shape is not None:
        top["pixel_shape"] = shape
    return {**top, **frame}


def _pixel_shape(values: dict[str, Any]) -> float | None:
    """Return fl_y / fl_x; None if one of them is missing or not a number above 0."""
    across = values.get("fl_x")
    down = values.get("fl_y")
    if not isinstance(across, int | float) or not isinstance(down, int | float) or not (across > 0 and down > 0):
        return None
    return float(down) / float(across)


def _check_pinhole(path: Path, where: str, values: dict[str, Any], distorted: list[str]) -> None:
    """Raise unless a frame has a pinhole camera.

    Raises:
        FormatError: If its model is not a pinhole, or it is distorted.
    """
    model = str(values.get("camera_model") or "PINHOLE")
    parameters = values.get("distortion_params")
    got = ""
    if model.upper() not in _PINHOLES:
        got = f"camera_model {model}"
    elif values.get("is_fisheye"):
        got = "is_fisheye"
    elif distorted:
        got = f"distortion {' '.join(distorted)}"
    elif isinstance(parameters, list) and any(parameters):
        got = f"distortion_params {parameters}"
    if got:
        raise FormatError(path, where, "a pinhole camera", got, _UNDISTORT)


def _intrinsics(
    path: Path, where: str, values: dict[str, Any], size: tuple[int, int] | None
) -> tuple[F64, tuple[int, int]]:
    """Return the pinhole matrix of one frame and its image size."""

    def number(key: str) -> float | None:
        """Return a number of the frame; None if it is missing."""
        return None if values.get(key) is None else float(to_numbers(path, f"{where}: {key}", values[key], ()))

    _check_pinhole(path, where, values, [key for key in _DISTORTION if number(key)])
    width = number("w")
    height = number("h")
    if width is None or height is None:
        if size is None:
            remedy = "give one, size=(width, height) or --width and --height"
            raise FormatError(path, where, "an image size (w, h)", "none", remedy)
        width, height = size
    focal_x = number("fl_x")
    focal_y = number("fl_y")
    if focal_x is None:
        focal_x = _focal(path, where, width, number("camera_angle_x"))
    if focal_y is None:
        focal_y = _focal(path, where, height, number("camera_angle_y"))
    if focal_y is None and focal_x is not None:
        focal_y = focal_x * float(values.get("pixel_shape", 1.0))
    if focal_x is None:
        focal_x = focal_y
    if focal_x is None or focal_y is None:
        raise FormatError(path, where, "fl_x or camera_angle_x", "neither")
    center_x = number("cx")
    center_y = number("cy")
    center = [width / 2 if center_x is None else center_x, height / 2 if center_y is None else center_y]
    pixels = (int(width), int(height))
    return pinhole(path, where, np.array([focal_x, focal_y]), np.array(center), pixels), pixels


def _focal(path: Path, where: str, side: float, angle: float | None) -> float | None:
    """Return the focal length in pixels for a field of view in radians across `side` pixels."""
    if angle is None:
        return None
    if not 0.0 < angle < np.pi:
        raise FormatError(path, where, "a field of view in (0, pi) radians", f"{angle:g}")
    return float(0.5 * side / np.tan(angle / 2.0))
