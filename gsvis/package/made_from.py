"""The source scenes of a package: name, size and hash of each, and its relative path if it is near the package.

A published package must not reveal folders of the machine that made it. So the manifest has a path only for a scene
beside the package, or below the folder that has the package. Full paths are kept in the work folder, which is not
published.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import digest_of, read_whole

__all__ = ["MadeFrom", "candidates_of", "made_from_of", "note_paths", "path_from_package"]

KEY = "made_from"
"""Name of the list in the provenance of a package or a world."""

_NOTE = "made_from.json"
_MOST_SCENES = 1 << 16
_MOST_BYTES = 1 << 24
_MOST_NAME = 1_000
_MOST = 1 << 53
_DIGITS = 64


@dataclass(frozen=True)
class MadeFrom:
    """A scene that a package was made from.

    Attributes:
        name: Name of the file or folder; `builtin:NAME` of a built-in scene.
        sha256: Hash of the file; None for a scene of several files and a built-in scene.
        scene: `scene_hash` of its Gaussians if there is no single file; None if the scene was not read as a whole.
        nbytes: Bytes of the file; None if there is no single file.
        gaussians: Number of Gaussians; None if they were not counted.
        lod: Level of detail that was read; None for a scene without levels.
        path: Path of the file relative to the folder of the package, with `/`; None if it is not near the package.
    """

    name: str
    sha256: str | None = None
    scene: str | None = None
    nbytes: int | None = None
    gaussians: int | None = None
    lod: int | None = None
    path: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the facts for JSON."""
        return asdict(self)

    def matches_file(self, path: Path) -> bool:
        """Return whether a file is readable and has the content of the scene; True if no hash of a file is known."""
        if self.sha256 is None:
            return True
        try:
            return digest_of(path) == self.sha256
        except (FormatError, OSError):
            return False


def made_from_of(provenance: Mapping[str, Any]) -> tuple[MadeFrom, ...]:
    """Return the source scenes of a package from its provenance; empty if they are missing or incomplete."""
    rows = provenance.get(KEY)
    if not isinstance(rows, list) or not 1 <= len(rows) <= _MOST_SCENES:
        return ()
    found = [_parse(row) for row in rows]
    return tuple(each for each in found if each is not None) if None not in found else ()


def path_from_package(scene: str | os.PathLike[str], package: str | os.PathLike[str]) -> str | None:
    """Return the path of a scene relative to the folder of a package; None if the scene is not beside it or below.

    None too if a name in the path is not valid on every system, such as one with a colon: `made_from_of` refuses those.

    Args:
        scene: File or folder of the scene.
        package: Folder of the package, which may not exist yet.
    """
    parent = Path(os.path.abspath(package)).parent
    try:
        inner = Path(os.path.abspath(scene)).relative_to(parent)
    except ValueError:
        return None
    found = PurePosixPath("..", *inner.parts).as_posix()
    return found if _is_near(found) else None


def candidates_of(made: Sequence[MadeFrom], package: str | os.PathLike[str]) -> list[list[Path]]:
    """Return for each scene the existing paths at which it may be, the likeliest first.

    These are the path in the manifest, the path in the work folder, and the same name beside the package.

    Args:
        made: From `made_from_of`.
        package: Folder of the package.
    """
    folder = Path(os.path.abspath(package))
    noted = _read_note(folder, len(made))
    found = []
    for each, note in zip(made, noted, strict=True):
        stated = [] if each.path is None else [Path(os.path.normpath(folder / each.path))]
        named = [folder.parent / each.name] if _is_name(each.name) else []
        paths = [*stated, *([] if note is None else [note]), *named]
        found.append([path for path in dict.fromkeys(paths) if path.exists()])
    return found


def note_paths(package: str | os.PathLike[str], paths: Sequence[str | os.PathLike[str] | None]) -> None:
    """Write the full path of each scene to the work folder beside a package, if that folder exists.

    Args:
        package: Folder of the package.
        paths: Paths in the order of the scenes; None for a built-in scene.

    Raises:
        OSError: If the file cannot be written.
    """
    note = _note_of(Path(os.path.abspath(package)))
    if not note.parent.is_dir():
        return
    full = [None if path is None else os.path.abspath(path) for path in paths]
    with atomic_path(note) as partial:
        partial.write_text(json.dumps({"paths": full}), encoding="utf-8")


def _note_of(package: Path) -> Path:
    """Return the file in the work folder that has the full paths."""
    return package.with_name(f"{package.name}.work") / _NOTE


def _read_note(package: Path, count: int) -> list[Path | None]:
    """Return the full path of each scene from the work folder; None if it is unknown."""
    none: list[Path | None] = [None] * count
    try:
        value = json.loads(read_whole(_note_of(package), _MOST_BYTES))
    except (FormatError, OSError, ValueError, RecursionError):
        return none
    paths = value.get("paths") if isinstance(value, dict) else None
    if not isinstance(paths, list) or len(paths) != count:
        return none
    return [
        Path(path) if isinstance(path, str) and "\0" not in path and os.path.isabs(path) else None for path in paths
    ]


def _parse(row: Any) -> MadeFrom | None:
    """Return a scene from JSON; None if a value is missing or invalid."""
    if not isinstance(row, dict):
        return None
    name = row.get("name")
    path = row.get("path")
    hashes = {key: row.get(key) for key in ("sha256", "scene")}
    if not (isinstance(name, str) and 0 < len(name) <= _MOST_NAME and (path is None or _is_near(path))):
        return None
    if any(value is not None and not (isinstance(value, str) and len(value) == _DIGITS) for value in hashes.values()):
        return None
    counts = {key: row.get(key) for key in ("nbytes", "gaussians", "lod")}
    if any(value is not None and not _is_count(value) for value in counts.values()):
        return None
    return MadeFrom(name, path=path, **hashes, **counts)


def _is_count(value: Any) -> bool:
    """Return whether a JSON value is an integer >= 0 of at most 53 bits."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _MOST


def _is_name(name: str) -> bool:
    """Return whether a text is a plain file name, without a folder."""
    return name not in ("", ".", "..") and not set(name) & set("/\\\0:")


def _is_near(path: Any) -> bool:
    """Return whether a value is a path that `path_from_package` can return."""
    if not isinstance(path, str) or not 0 < len(path) <= _MOST_NAME or set(path) & set("\\\0:"):
        return False
    first, *rest = path.split("/")
    return first == ".." and len(rest) > 0 and all(part not in ("", ".", "..") for part in rest)
