"""Read streamed SOG, an octree of SOG scenes in `lod-meta.json`, at one level of detail.

Every leaf of the tree refers, for each level, to a run of Gaussians in one of the listed SOG scenes. Level 0 is the
finest. Files of a level may be absent; the error then lists the levels that are present.
"""

from __future__ import annotations

import os
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import Budget, inside, read_whole, safe_name
from gsvis.io._sog_files import FolderStore, ZipStore
from gsvis.io.sog import SogMeta, read_sog
from gsvis.scene.gaussians import Gaussians

__all__ = ["files_of_level", "list_lods", "load_streamed_file", "load_streamed_sog", "streamed_files"]

Runs = dict[int, list[tuple[int, int]]]
_MAX_COUNT = 1 << 40
_ENVIRONMENT = -1  # used instead of a file number


def list_lods(path: str | os.PathLike[str]) -> tuple[int, ...]:
    """Return the levels of detail that are present, finest first.

    Args:
        path: A folder with `lod-meta.json`, or that file.

    Raises:
        FormatError: If the file is damaged.
    """
    tree = _Tree(path)
    return tuple(lod for lod in sorted(tree.runs) if not tree.absent(lod))


def load_streamed_sog(path: str | os.PathLike[str], lod: int | None = None) -> Gaussians:
    """Read one level of detail of a streamed SOG scene, with its environment if it has one.

    Args:
        path: A folder with `lod-meta.json`, or that file.
        lod: The level; None takes the finest present.

    Returns:
        The Gaussians of all leaves, in the order of the listed files and of the Gaussians in them.

    Raises:
        FormatError: If the level or the environment is absent (the message names the levels that are present), or
            a file is damaged.
        ValueError: If `lod` is not an integer >= 0.
        OSError: If the file cannot be opened.
    """
    tree, lod = _open_level(path, lod)
    environment = tree.environment
    parts = []
    for file, runs in sorted(tree.runs[lod].items()):
        parts.append(_pieces(tree, file, runs))
    if environment:
        parts.append(_scene(tree, environment))
    return parts[0] if len(parts) == 1 else Gaussians.concatenate(parts)


def files_of_level(path: str | os.PathLike[str], lod: int | None = None) -> list[str]:
    """Return the names of the files that a level of detail needs, relative to `lod-meta.json`; they may be absent.

    Args:
        path: That file, or its folder.
        lod: The level; None means the finest.

    Raises:
        FormatError: If the file is damaged or names no such level.
    """
    tree = _Tree(path)
    level = min(tree.runs, default=0) if lod is None else lod
    if level not in tree.runs:
        named = ", ".join(map(str, sorted(tree.runs))) or "none"
        raise FormatError(tree.path, "", f"a LOD {level}", f"LODs named in the file: {named}")
    names = [tree.files[file] for file in sorted(tree.runs[level])]
    return [*names, *([tree.environment] if tree.environment else [])]


def streamed_files(path: str | os.PathLike[str], lod: int | None = None) -> tuple[int, list[tuple[int, int, Path]]]:
    """Return the level of detail, and for each file its number, its count of Gaussians, and its path.

    The path is a zip or the folder of a meta.json. The environment, if there is one, comes last, with a count of -1.

    Args:
        path: As for `load_streamed_sog`.
        lod: As for `load_streamed_sog`.

    Raises:
        FormatError: As `load_streamed_sog` does.
        ValueError: If `lod` is not an integer >= 0.
    """
    tree, level = _open_level(path, lod)
    found = [
        (file, sum(count for _, count in runs), tree.home(file)) for file, runs in sorted(tree.runs[level].items())
    ]
    return level, [*found, *([(_ENVIRONMENT, -1, _home(tree.at(tree.environment)))] if tree.environment else [])]


def load_streamed_file(path: str | os.PathLike[str], lod: int, file: int) -> Gaussians:
    """Return the Gaussians in one file that belong to leaves of one level.

    Args:
        path: As for `load_streamed_sog`.
        lod: The level.
        file: Number of the file, from `streamed_files`.

    Raises:
        FormatError: As `load_streamed_sog` does, or if the level has no such file.
    """
    tree, level = _open_level(path, lod)
    if file == _ENVIRONMENT and tree.environment:
        return _scene(tree, tree.environment)
    if file not in tree.runs[level]:
        raise FormatError(tree.path, "filenames", f"a file {file} of LOD {lod}", "none", "did the scene change?")
    return _pieces(tree, file, tree.runs[level][file])


def _open_level(path: str | os.PathLike[str], lod: int | None) -> tuple[_Tree, int]:
    """Return the tree and the number of a level, after checking that its files are present."""
    if lod is not None:
        _check.positive_int("lod", lod, at_least=0)
    tree = _Tree(path)
    present = [level for level in sorted(tree.runs) if not tree.absent(level)]
    remedy = f"LODs present: {', '.join(map(str, present)) or 'none'}"
    named = f"LODs named in the file: {', '.join(map(str, sorted(tree.runs))) or 'none'}"
    if lod is None:
        if not present:
            raise FormatError(tree.path, "", "the files of at least one LOD", "none", named)
        lod = present[0]
    if lod not in tree.runs:
        raise FormatError(tree.path, "", f"a LOD {lod}", named, remedy)
    absent = tree.absent(lod)
    if absent:
        raise FormatError(tree.path, "", f"the files of LOD {lod}", f"no {_some(absent)}", remedy)
    environment = tree.environment
    if environment and not tree.at(environment).is_file():
        raise FormatError(tree.path, "environment", f"the file {environment}", "none", remedy)
    return tree, lod


def _some(names: list[str]) -> str:
    """Return the first three names, and the number of the others."""
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"


class _Tree:
    """The checked content of a `lod-meta.json`.

    Args:
        path: A folder with that file, or the file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        file = _check.path("path", path)
        self.path = file / "lod-meta.json" if file.is_dir() else file
        self.folder = self.path.parent
        if file.is_dir():
            inside(self.path, "", self.folder, self.path.name)
        data = read_whole(self.path)
        self.budget = Budget(self.path, len(data))
        fields = parse_object(self.path, data, self.budget)
        self.files = [safe_name(self.path, f"filenames[{i}]", n) for i, n in enumerate(fields.items("filenames"))]
        if len(set(self.files)) < len(self.files):
            raise FormatError(self.path, "filenames", "every file once", "a file named twice")
        self.environment: str | None = None
        if "environment" in fields:
            self.environment = safe_name(self.path, "environment", fields.raw("environment"))
        self.runs: dict[int, Runs] = defaultdict(lambda: defaultdict(list))
        self._collect(fields.raw("tree"))

    def _collect(self, tree: Any) -> None:
        """Fill `runs`: for each level and file the (offset, count) of all leaves."""
        stack = [tree]
        while stack:
            node = Fields(self.path, "tree", stack.pop())
            if "children" in node:
                stack.extend(node.items("children"))
            if "lods" not in node:
                continue
            for key, value in node.child("lods").value.items():
                if not (key.isascii() and key.isdecimal() and len(key) < 4):
                    raise FormatError(self.path, "tree.lods", "levels 0, 1, 2, ...", repr(key[:40]))
                run = Fields(self.path, f"tree.lods.{key}", value)
                file = run.integer("file", 0, len(self.files) - 1)
                offset = run.integer("offset", 0, _MAX_COUNT)
                count = run.integer("count", 0, _MAX_COUNT)
                if count:
                    self.runs[int(key)][file].append((offset, count))

    def absent(self, lod: int) -> list[str]:
        """Return the missing files of a level."""
        names = [self.files[file] for file in sorted(self.runs[lod])]
        return [name for name in names if not self.at(name).is_file()]

    def home(self, file: int) -> Path:
        """Return the zip of a file, or the folder of its meta.json."""
        return _home(self.at(self.files[file]))

    def at(self, name: str) -> Path:
        """Return the path of a file of the tree; raise if a link leads out of the folder."""
        return inside(self.path, name, self.folder, name)


def _home(path: Path) -> Path:
    """Return the zip, or the folder of a meta.json."""
    return path.parent if path.suffix.lower() == ".json" else path


def _scene(tree: _Tree, name: str) -> Gaussians:
    """Return one of the SOG scenes of the tree, a meta.json or a zip, in full."""
    path = tree.at(name)
    if path.suffix.lower() != ".json":
        with ZipStore(path) as archive:
            tree.budget.file_bytes += archive.size
            meta = SogMeta(parse_object(path, archive.read("meta.json", tree.budget), tree.budget))
            return read_sog(meta, archive, tree.budget)
    data = read_whole(path)
    tree.budget.file_bytes += len(data)
    meta = SogMeta(parse_object(path, data, tree.budget))
    store = FolderStore(path.parent, path, tree.folder)
    tree.budget.file_bytes += store.file_bytes(meta.names)
    return read_sog(meta, store, tree.budget)


def _pieces(tree: _Tree, file: int, runs: list[tuple[int, int]]) -> Gaussians:
    """Return the Gaussians of one file that belong to the runs, in file order.

    Raises:
        FormatError: If a run ends beyond the file or runs overlap.
    """
    scene = _scene(tree, tree.files[file])
    first, count = np.array(sorted(runs), np.int64).T
    last = first + count
    if last.max() > len(scene):
        raise FormatError(
            tree.path,
            f"leaves of {tree.files[file]}",
            f"runs within {len(scene):,} Gaussians",
            f"an end at {last.max():,}",
        )
    if (first[1:] < last[:-1]).any():
        raise FormatError(tree.path, f"leaves of {tree.files[file]}", "runs that do not overlap", "two that do")
    if count.sum() == len(scene):
        return scene
    kept = np.zeros(len(scene) + 1, np.int8)
    np.add.at(kept, first, 1)
    np.add.at(kept, last, -1)
    return scene[np.cumsum(kept[:-1], dtype=np.int8).astype(bool)]
