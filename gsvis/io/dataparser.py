"""Read `dataparser_transforms.json` of nerfstudio: the similarity from the cameras' frame to the trained scene's.

nerfstudio rotates, moves and scales a capture before training, and writes the transform beside the model:
`x -> scale * (R x + t)` with `transform` = [R | t]. World frames are right-handed; camera axes do not change.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsvis.errors import FormatError
from gsvis.io.views import F64, read_json, to_numbers
from gsvis.scene.similarity import Similarity

__all__ = ["NAME", "find_dataparser", "read_applied", "read_dataparser"]

NAME = "dataparser_transforms.json"
"""Name of the file in nerfstudio."""
_UP = 3  # folders above the cameras to search: data/colmap/sparse/0 is three below data
_ROTATION = 1e-3


def find_dataparser(*beside: Path | str | None) -> Path | None:
    """Return the first `dataparser_transforms.json` beside or above some files or folders; None if there is none."""
    for each in beside:
        if not each:
            continue
        folder = Path(each).absolute()
        folder = folder if folder.is_dir() else folder.parent
        for place in (folder, *list(folder.parents)[:_UP]):
            if (place / NAME).is_file():
                return place / NAME
    return None


def read_dataparser(path: Path | str) -> Similarity:
    """Return the similarity of the file: scene's frame from the frame of the captured cameras.

    Raises:
        FormatError: If the file is malformed, or its matrix is no rotation.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise FormatError(path, "", "an object with transform and scale", type(content).__name__)
    matrix = _matrix(path, "transform", content.get("transform"))
    scale = float(to_numbers(path, "scale", content.get("scale", 1.0), ()))
    if not scale > 0.0:
        raise FormatError(path, "scale", "a number > 0", f"{scale:g}")
    return _similarity(path, "transform", matrix, scale)


def read_applied(path: Path | str) -> Similarity | None:
    """Return the similarity from the frame of the capture to that of a `transforms.json`; None if it states none.

    Raises:
        FormatError: If its `applied_transform` or `applied_scale` is malformed.
    """
    content = read_json(path)
    if not isinstance(content, dict) or "applied_transform" not in content:
        return None
    matrix = _matrix(path, "applied_transform", content["applied_transform"])
    scale = float(to_numbers(path, "applied_scale", content.get("applied_scale", 1.0), ()))
    return _similarity(path, "applied_transform", matrix, scale)


def _matrix(path: Path | str, key: str, value: object) -> F64:
    """Return a checked (3, 4) matrix."""
    rows = 4 if isinstance(value, list) and len(value) == 4 else 3
    return to_numbers(path, key, value, (rows, 4))[:3]


def _similarity(path: Path | str, key: str, matrix: F64, scale: float) -> Similarity:
    """Return the similarity of a (3, 4) matrix and a scale; raise unless the matrix holds a rotation."""
    rotation = matrix[:, :3]
    own = float(np.cbrt(max(np.linalg.det(rotation), 0.0)))  # some tools multiply the scale into the matrix
    if not own > 0.0 or not np.allclose(rotation @ rotation.T, own**2 * np.eye(3), atol=_ROTATION * own**2):
        got = f"a matrix with determinant {np.linalg.det(rotation):.4g} and axes that are not at right angles"
        got = got if own > 0.0 else f"a matrix with determinant {np.linalg.det(rotation):.4g}"
        raise FormatError(path, key, "a rotation and a translation, 3 x 4", got)
    return Similarity.from_rotation(scale * own, rotation / own, scale * matrix[:, 3])
