"""Read `cameras.json` of INRIA's 3DGS: a JSON list of the training cameras, beside the trained model.

`rotation` is world from camera in OpenCV axes and `position` the viewpoint in the world. The file states no principal
point; the middle of the image is used.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsvis.errors import FormatError
from gsvis.io.views import Views, pinhole, pose_of_camera, to_numbers

__all__ = ["read_inria_cameras"]


def read_inria_cameras(path: Path, content: list[Any]) -> Views:
    """Return the posed images of a `cameras.json`.

    Args:
        path: The file, for messages.
        content: Its JSON value.

    Raises:
        FormatError: If a key is missing or malformed.
    """
    views = Views(path, [], [], [], [])
    for index, entry in enumerate(content):
        where = f"[{index}]"
        if not isinstance(entry, dict):
            raise FormatError(path, where, "an object", type(entry).__name__)
        name = entry.get("img_name", f"{index:05d}")
        if not isinstance(name, str):
            raise FormatError(path, f"{where}.img_name", "a string", type(name).__name__)
        width, height, fx, fy = (
            float(to_numbers(path, f"{where}.{key}", entry.get(key), ())) for key in ("width", "height", "fx", "fy")
        )
        rotation = to_numbers(path, f"{where}.rotation", entry.get("rotation"), (3, 3))
        position = to_numbers(path, f"{where}.position", entry.get("position"), (3,))
        size = (int(width), int(height))
        views.names.append(name)
        views.viewmats.append(pose_of_camera(path, f"{where}.rotation", rotation, position))
        views.Ks.append(pinhole(path, where, np.array([fx, fy]), np.array([width, height]) / 2.0, size))
        views.sizes.append(size)
    return views
