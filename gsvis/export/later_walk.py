"""Where one can walk in a bare scene, written after the scene is shown: it takes seconds that nobody should wait for.

`scene.json` names the file at once, so that a page finds it; a server of the folder holds the answer back until the
file is there.
"""

from __future__ import annotations

import json
import secrets
from os import PathLike
from pathlib import Path

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.export.static import SCENE
from gsvis.files.atomic import atomic_path
from gsvis.files.fields import parse_object
from gsvis.files.limits import read_whole
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.walk import find_walk
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["promise_walk", "write_walk"]

_MOST_JSON = 64 << 20


def promise_walk(folder: str | PathLike[str]) -> None:
    """Name the file of walking in the `scene.json` of a static scene that has none. `write_walk` must write it.

    The name is random, because browsers keep such files for ever.

    Raises:
        FormatError: If the folder holds no static scene.
        OSError: If it cannot be written.
    """
    path = _check.path("folder", folder) / SCENE
    document = parse_object(path, read_whole(path, _MOST_JSON)).value
    files = document.get("files")
    if not isinstance(files, dict) or "walk" in files:
        raise FormatError(path, "files", "the files of a static scene without one of walking", "others")
    files["walk"] = {"name": f"walk-{secrets.token_hex(8)}.bin", "bytes": 0, "count": 1}
    with atomic_path(path) as partial:
        partial.write_bytes(json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode())


def write_walk(folder: str | PathLike[str], g: Gaussians, space: NavigableSpace, meters_per_unit: float = 0.0) -> Path:
    """Write the file that `promise_walk` has named, atomically; an empty one where nobody can walk. Return its path.

    Args:
        folder: Folder of the static scene.
        g: Its Gaussians.
        space: Where eyes may be.
        meters_per_unit: Meters in a scene unit, 0 if unknown.

    Raises:
        FormatError: If `scene.json` names no such file.
        OSError: If it cannot be written.
    """
    path = _check.path("folder", folder) / SCENE
    fields = parse_object(path, read_whole(path, _MOST_JSON))
    target = path.parent / fields.child("files").child("walk").text("name")
    found = find_walk(g, CellGrid.over(space), meters_per_unit)
    with atomic_path(target) as partial:
        partial.write_bytes(b"" if found is None else found.to_bytes())
    return target
