"""Selections: the class of each Gaussian of a scene as `.npy`, with a `.json` beside it that names the scene.

`NAME.npy` holds (N,) uint8, 0 for Gaussians that stay. `NAME.json` holds the hash of the scene and the names of the
classes 1, 2 and on. Other programs may write the `.npy` alone; then only its length is checked.
"""

from __future__ import annotations

import io
import json
import os
import tokenize
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import open_regular, read_whole
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians

__all__ = ["load_selection", "note_of", "save_selection"]

_FORMAT = "gsvis-selection"
_NOTE_BYTES = 1 << 20
_HEADER_BYTES = 1 << 16
# The header of an `.npy` file is Python code; parsing it can raise many kinds of errors.
_FAULTS = (ValueError, TypeError, LookupError, ArithmeticError, EOFError, SyntaxError, RecursionError, MemoryError)


def note_of(path: str | os.PathLike[str]) -> Path:
    """Return the path of the `.json` beside a selection."""
    return Path(path).with_suffix(".json")


def save_selection(
    path: str | os.PathLike[str], classes: NDArray[np.uint8], g: Gaussians, names: tuple[str, ...]
) -> None:
    """Write a selection and the note on its scene, each atomically.

    Args:
        path: The `.npy` file.
        classes: (N,) uint8, 0 for Gaussians that stay.
        g: The scene, N Gaussians.
        names: Names of the classes 1, 2 and on.

    Raises:
        ValueError: If the path does not end in .npy, or the length is not that of the scene.
        OutputError: If a file cannot be written.
    """
    target = _check.path("path", path)
    if target.suffix != ".npy":
        raise ValueError(f"path: expected a name that ends in .npy, got {os.fspath(path)!r}")
    values = _check.integers("classes", classes, (len(g),), np.uint8)
    note = {"format": _FORMAT, "version": 1, "scene": scene_hash(g), "gaussians": len(g), "classes": list(names)}
    data = io.BytesIO()  # np.save to a file does not report a full disk for small arrays
    np.save(data, values)
    with atomic_path(target) as partial:
        partial.write_bytes(data.getvalue())
    with atomic_path(note_of(target)) as partial:
        partial.write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")


def load_selection(path: str | os.PathLike[str], g: Gaussians) -> NDArray[np.uint8]:
    """Return the classes (N,) of a selection for a scene of N Gaussians.

    Args:
        path: A `.npy` file of N integers in 0 to 255, or N booleans: True for Gaussians that go.
        g: The scene.

    Raises:
        FormatError: If the file is not such an array, or is not a selection of this scene.
        FileNotFoundError: If there is no file.
    """
    target = _check.path("path", path)
    array = _read_npy(target, _HEADER_BYTES + 8 * len(g))
    if array.ndim != 1 or array.dtype.kind not in "bui":
        raise FormatError(path, "", "one whole number for each Gaussian", f"shape {array.shape} of {array.dtype}")
    if len(array) != len(g):
        numbers = f"{len(array):,}, a selection of a different scene"
        raise FormatError(path, "", f"{len(g):,} numbers, one for each Gaussian", numbers)
    if len(array) and not 0 <= int(array.min()) <= int(array.max()) <= 255:
        raise FormatError(path, "", "numbers of 0 to 255", f"{array.min()} to {array.max()}")
    _check_note(note_of(target), g)
    return array.astype(np.uint8)


def _read_npy(path: Path, most: int) -> NDArray[Any]:
    """Return the array of an `.npy` file of at most `most` bytes."""
    data = read_whole(path)
    if not data.startswith(b"\x93NUMPY"):
        raise FormatError(path, "", "an .npy file of numbers", f"a file beginning {data[:6]!r}")
    if len(data) > most:
        raise FormatError(path, "", f"at most {most:,} bytes for this scene", f"{len(data):,}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy warns about headers written by Python 2
            return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except (*_FAULTS, tokenize.TokenError):
        raise FormatError(path, "", "an .npy file of numbers", "a damaged one, or one of objects") from None


def _check_note(path: Path, g: Gaussians) -> None:
    """Raise if the note of a selection names a different scene; the note may be missing."""
    if not path.is_file():
        return
    try:
        with open_regular(path) as file:
            note: Any = json.loads(file.read(_NOTE_BYTES))
    except (ValueError, RecursionError):
        return  # not a note of gsvis
    if not isinstance(note, dict) or note.get("format") != _FORMAT:
        return
    if note.get("scene") != scene_hash(g):
        got = f"one for the scene with hash {str(note.get('scene'))[:12]}...; has this scene changed?"
        raise FormatError(path, "scene", "a selection of this scene", got)
