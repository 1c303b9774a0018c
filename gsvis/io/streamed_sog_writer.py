"""Write streamed SOG: a binary tree of leaves, each with one SOG folder for each level of detail, and `lod-meta.json`.

A folder holds the Gaussians of one leaf and one level, so a viewer can load leaves one by one. Folder names contain a
hash of the content. Level 0 is the finest. This module knows no visibility.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.files.atomic import atomic_folder
from gsvis.files.folders import GENERATOR, check_replaceable, remove_earlier
from gsvis.io.sog_writer import EncodedSog, encode_sog, report_palette_loss
from gsvis.progress import Progress, silent
from gsvis.scene.gaussians import Gaussians

__all__ = ["META", "LeafScene", "Tree", "WrittenLeaves", "check_streamed_target", "save_streamed_sog"]

META = "lod-meta.json"
Tree = int | tuple["Tree", "Tree"]
"""A leaf, or two subtrees."""

_DIGITS = 7  # significant digits of numbers in JSON
_PALETTE_SHARE = 4  # Gaussians of a leaf per set of higher coefficients
_LEAST_PALETTE = 256
_OURS = re.compile(r"(?:\d+_\d+|env)-[0-9a-f]{8}|leaves-[0-9a-f]{16}\.bin")


@dataclass(frozen=True, eq=False)
class LeafScene:
    """A scene cut into B leaves with L levels of detail.

    Attributes:
        tree: Leaves 0 to B - 1, each once, from left to right.
        bounds: (B, 2, 3) lowest and highest corner of the Gaussians of a leaf, extents included, scene frame.
        counts: (L, B) Gaussians of each leaf at each level, finest level first.
        piece: Function from (level, leaf) to its Gaussians, in the order to write.
        environment: Gaussians that are always drawn, at every level; None for none.
    """

    tree: Tree
    bounds: NDArray[np.float64]
    counts: NDArray[np.int64]
    piece: Callable[[int, int], Gaussians]
    environment: Gaussians | None = None


@dataclass(frozen=True, eq=False)
class WrittenLeaves:
    """Result of `save_streamed_sog`.

    Attributes:
        path: The folder.
        sizes: (L, B) bytes of the files of each leaf at each level.
        nbytes: Total bytes.
    """

    path: Path
    sizes: NDArray[np.int64]
    nbytes: int


def save_streamed_sog(
    scene: LeafScene,
    folder: str | os.PathLike[str],
    *,
    beside: Callable[[NDArray[np.int64], list[str]], Mapping[str, bytes]] | None = None,
    progress: Progress = silent,
) -> WrittenLeaves:
    """Write a scene as streamed SOG. The same scene gives the same bytes.

    `lod-meta.json` moves into the folder last, and files of an earlier scene are removed after that, so a reader finds
    either the old scene or the new one.

    Args:
        scene: The leaves.
        folder: The folder; made if missing.
        beside: Function from the (L, B) bytes of all leaves and the names of their files to the names and contents of
            further files. Their names are also listed in `lod-meta.json`, where readers of the format ignore them.
        progress: Called with stage "export", in pieces.

    Raises:
        ValueError: If a leaf is empty at every level.
        OSError: If the folder cannot be written.
    """
    target = _check.path("folder", folder)
    counts = scene.counts
    if (counts.sum(axis=0) == 0).any():
        raise ValueError("counts: expected a Gaussian in every leaf, got an empty leaf")
    pieces = np.argwhere(counts > 0).tolist()
    sizes = np.zeros(counts.shape, np.int64)
    names = {}
    losses = list[_PaletteLoss]()
    progress("export", 0, len(pieces))
    with atomic_folder(target, last=(META,)) as partial:
        for k, (lod, leaf) in enumerate(pieces):
            found = scene.piece(lod, leaf)
            names[lod, leaf], encoded = _write_sog(partial, f"{lod}_{leaf}", found)
            sizes[lod, leaf] = sum(len(data) for data in encoded.files.values())
            losses.append(_PaletteLoss.of(found, encoded))
            progress("export", k + 1, len(pieces))
        document: dict[str, Any] = {
            "version": 1,
            "asset": {"generator": GENERATOR},
            "count": int(counts.sum()),
            "counts": [int(n) for n in counts.sum(axis=1)],
            "lodLevels": len(counts),
        }
        total = int(sizes.sum())
        if scene.environment is not None and len(scene.environment):
            document["environment"], encoded = _write_sog(partial, "env", scene.environment)
            total += sum(len(data) for data in encoded.files.values())
            losses.append(_PaletteLoss.of(scene.environment, encoded))
        extra = {} if beside is None else beside(sizes, list(names.values()))
        for name, data in extra.items():
            (partial / name).write_bytes(data)
        if extra:
            document["gsvis"] = {"files": list(extra)}
        files = {place: k for k, place in enumerate(names)}
        document["filenames"] = list(names.values())
        document["tree"] = _node(scene, scene.tree, files)
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        (partial / META).write_bytes(text)
    kept = {name.split("/")[0] for name in names.values()} | set(extra)
    kept |= {str(document.get("environment", "")).split("/")[0]}
    remove_earlier(target, _OURS, kept)
    _report_losses(target, losses)
    return WrittenLeaves(target, sizes, total + len(text) + sum(len(data) for data in extra.values()))


def check_streamed_target(folder: str | os.PathLike[str], overwrite: bool) -> None:
    """Raise unless a folder can take a streamed SOG: it is new, empty, or holds a scene of gsvis to replace.

    Raises:
        ValueError: If it holds something else, or an earlier scene and `overwrite` is false.
    """
    check_replaceable(_check.path("folder", folder), META, _OURS, overwrite)


class _PaletteLoss(NamedTuple):
    """Loss caused by the palette of one piece; see `EncodedSog` for sets and error."""

    gaussians: int
    sets: int
    error: float

    @classmethod
    def of(cls, g: Gaussians, encoded: EncodedSog) -> _PaletteLoss:
        """Return the loss of a piece; 0 Gaussians if it has no higher coefficients."""
        return cls(len(g) if encoded.sets else 0, encoded.sets, encoded.sh_error)


def _report_losses(target: Path, losses: list[_PaletteLoss]) -> None:
    """Report the losses caused by the palettes of all pieces."""
    gaussians = sum(each.gaussians for each in losses)
    sets = sum(each.sets for each in losses)
    squares = sum(each.gaussians * each.error**2 for each in losses)
    if gaussians:
        report_palette_loss(target, gaussians, sets, math.sqrt(squares / gaussians))


def _write_sog(folder: Path, name: str, g: Gaussians) -> tuple[str, EncodedSog]:
    """Write the folder of one SOG scene; return the name of its meta.json and the encoded scene."""
    encoded = encode_sog(g, palette=max(_LEAST_PALETTE, len(g) // _PALETTE_SHARE), digits=_DIGITS)
    digest = hashlib.sha256()
    for each, data in encoded.files.items():
        digest.update(f"{each} {len(data)}\n".encode() + data)
    place = f"{name}-{digest.hexdigest()[:8]}"
    (folder / place).mkdir()
    for each, data in encoded.files.items():
        (folder / place / each).write_bytes(data)
    return f"{place}/meta.json", encoded


def _node(scene: LeafScene, tree: Tree, files: dict[tuple[int, int], int]) -> dict[str, Any]:
    """Return a node of the tree, ready for JSON."""
    if isinstance(tree, tuple):
        children = [_node(scene, part, files) for part in tree]
        low = np.min([child["bound"]["min"] for child in children], axis=0)
        high = np.max([child["bound"]["max"] for child in children], axis=0)
        return {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": children}
    low, high = ([float(f"{v:.{_DIGITS}g}") for v in end.tolist()] for end in scene.bounds[tree])
    counts = scene.counts[:, tree].tolist()
    lods = {str(k): {"file": files[k, tree], "offset": 0, "count": n} for k, n in enumerate(counts) if n}
    return {"bound": {"min": low, "max": high}, "lods": lods}
