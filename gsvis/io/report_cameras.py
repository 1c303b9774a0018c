"""Read and write cameras in files of gsvis: `report.json` of `gsvis analyze`, and the output of `gsvis render --json`.

Matrices keep every digit, so that a view repeats exactly. OpenCV axes, camera from world.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsvis.errors import FormatError
from gsvis.io.views import Views, pinhole, to_numbers
from gsvis.scene.cameras import Cameras

__all__ = ["describe_cameras", "holds_own_cameras", "read_own_cameras"]

_FORMATS = ("gsvis-report", "gsvis-rendering")
_RIGID = 1e-4


def describe_cameras(cameras: Cameras) -> list[dict[str, Any]]:
    """Return one entry per camera, ready for JSON, that `load_cameras` reads back bit by bit."""
    return [
        {
            "name": cameras.names[i],
            "width": cameras.width,
            "height": cameras.height,
            "eye": cameras.viewpoints[i].tolist(),
            "viewmat": cameras.viewmats[i].tolist(),
            "K": cameras.Ks[i].tolist(),
        }
        for i in range(len(cameras))
    ]


def holds_own_cameras(content: Any) -> bool:
    """Return whether a JSON value is a gsvis document that may hold cameras."""
    return isinstance(content, dict) and content.get("format") in _FORMATS


def read_own_cameras(path: Path, content: dict[str, Any]) -> Views:
    """Return the posed views of a document of gsvis.

    Args:
        path: The file, for messages.
        content: Its JSON value.

    Raises:
        FormatError: If it has no cameras, or one is malformed.
    """
    entries = content.get("cameras")
    if not isinstance(entries, list):
        got = "a report of an earlier version of gsvis, without cameras" if entries is None else type(entries).__name__
        raise FormatError(path, "cameras", "a list of cameras", got, "write the report again")
    views = Views(path, [], [], [], [])
    for index, entry in enumerate(entries):
        where = f"cameras[{index}]"
        if not isinstance(entry, dict):
            raise FormatError(path, where, "an object", type(entry).__name__)
        name = entry.get("name")
        if not isinstance(name, str):
            raise FormatError(path, f"{where}.name", "a string", type(name).__name__)
        sides = [float(to_numbers(path, f"{where}.{key}", entry.get(key), ())) for key in ("width", "height")]
        pose = to_numbers(path, f"{where}.viewmat", entry.get("viewmat"), (4, 4))
        with np.errstate(all="ignore"):  # huge numbers become infinity or NaN, which is rejected
            defect = float(np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max())
        if not defect <= _RIGID or (pose[3] != (0, 0, 0, 1)).any():
            got = f"a rotation off by {defect:.2g}" if not defect <= _RIGID else f"a last row of {pose[3].tolist()}"
            raise FormatError(path, f"{where}.viewmat", "a rigid matrix, camera from world", got)
        size = (int(sides[0]), int(sides[1]))
        k = to_numbers(path, f"{where}.K", entry.get("K"), (3, 3))
        pinhole(path, f"{where}.K", k[[0, 1], [0, 1]], k[:2, 2], size)  # checks
        views.names.append(name)
        views.viewmats.append(pose)
        views.Ks.append(k)
        views.sizes.append(size)
    return views
