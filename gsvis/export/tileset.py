"""Lay out leaves as a tileset of 3D Tiles 1.1: boxes, errors of levels, and the boxes of the cells that need a leaf.

Tiles are in the frame of 3D Tiles, +z up, in scene units; the transform of the root converts to meters. Contents are
glTF, +y up, which viewers rotate. This module writes no file.

References:
    https://docs.ogc.org/cs/22-025r4/22-025r4.html, sections 6.7 (tiles) and 7 (JSON).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.export.leaves import Leaves
from gsvis.export.needs import LeafNeeds
from gsvis.files.folders import GENERATOR
from gsvis.io.gltf_splats import SPLATS, SPZ
from gsvis.io.streamed_sog_writer import Tree

__all__ = ["DOCUMENT", "Volumes", "find_volumes", "level_errors", "tileset_document"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

DOCUMENT = "tileset.json"
DEVIATIONS = 3.0
"""Standard deviations that boxes hold, at which the kernel of the extension ends."""

ERROR_PIXELS = 16.0
"""Pixels of error that CesiumJS and 3d-tiles-renderer allow by default."""

_DIGITS = 7
_FROM_GLTF = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # +y up to +z up, as viewers do


@dataclass(frozen=True, eq=False)
class Volumes:
    """Boxes of the cells that need each of B leaves.

    Attributes:
        boxes: (B, 2, 3) box of the cells that need a leaf, scene frame.
        needed: (B,) whether any cell needs it.
        bounded: (B,) whether the box is smaller than that of all cells, so that it is useful to a viewer.
        inside: (K, B) whether the middle of each cell lies in the box of each leaf, or the leaf has no box.
    """

    boxes: F64
    needed: Mask
    bounded: Mask
    inside: Mask


def find_volumes(needs: LeafNeeds) -> Volumes:
    """Return the boxes of the cells that need each leaf."""
    low = needs.origin + needs.size * needs.boxes
    high = low + needs.size
    needed = needs.needed
    lows = np.where(needed[:, :, None], low[:, None], np.inf).min(axis=0)
    highs = np.where(needed[:, :, None], high[:, None], -np.inf).max(axis=0)
    some: Mask = np.asarray(needed.any(axis=0))
    close = 1e-6 * needs.size
    bounded = np.asarray(some & ((lows > low.min(axis=0) + close) | (highs < high.max(axis=0) - close)).any(axis=1))
    middles = ((low + high) / 2.0)[:, None]
    inside = ((middles > lows) & (middles < highs)).all(axis=2)
    return Volumes(np.stack([lows, highs], axis=1), some, bounded, inside)


def level_errors(leaves: Leaves) -> F64:
    """Return (L, B) geometric errors of leaves, finest level first, scene units.

    The error of a level in a leaf is the root mean square distance from a Gaussian of the finest level to the nearest
    one of that level, times 16. So a viewer that allows 16 pixels refines where that distance has one pixel. No level
    has a smaller error than the next finer one; the finest has 0.
    """
    from scipy.spatial import cKDTree  # here: it takes long to import

    means = leaves.levels.union.means.astype(np.float64)
    errors = np.zeros(leaves.counts.shape)
    for leaf in range(len(leaves)):
        finest = means[leaves.ids(0, leaf)]
        for lod in range(1, len(errors)):
            some = means[leaves.ids(lod, leaf)]
            away = cKDTree(some).query(finest)[0] if len(some) and len(finest) else np.zeros(1)
            errors[lod, leaf] = ERROR_PIXELS * float(np.sqrt(np.square(away).mean()))
    return np.maximum.accumulate(errors, axis=0)


def tileset_document(
    leaves: Leaves,
    contents: Mapping[tuple[int, int], str],
    upright: F64,
    *,
    environment: str | None = None,
    volumes: Volumes | None = None,
    meters: float = 1.0,
    packed: bool = False,
) -> dict[str, Any]:
    """Return the content of `tileset.json`.

    Boxes and contents are in the coordinates of the scene's source; nodes of contents hold the origin.

    Inner tiles have no content. A leaf is a chain of tiles, its coarsest level first, each replaced by the next.

    Args:
        leaves: The leaves.
        contents: File of each (level, leaf) that has one.
        upright: (3, 3) rotation from the frame of the scene to that of glTF.
        environment: File of the Gaussians far outside; None for none.
        volumes: Boxes where leaves are needed; leaves that no cell needs are omitted. None requests all from anywhere.
        meters: Length of a scene unit.
        packed: Whether contents are SPZ-compressed.
    """
    turn = _FROM_GLTF @ upright
    origin = np.asarray(leaves.levels.union.facts.origin)
    boxes = leaves.boxes(DEVIATIONS)
    whole = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    widest = float(np.linalg.norm(whole[1] - whole[0]))
    errors = np.minimum(level_errors(leaves), widest)

    def leaf_tile(leaf: int) -> dict[str, Any] | None:
        if volumes is not None and not volumes.needed[leaf]:
            return None
        made: dict[str, Any] | None = None
        for lod in range(len(errors)):  # finest first, so that each is the child of the next
            if (lod, leaf) not in contents:
                continue
            error = 0.0 if made is None else float(errors[lod, leaf])
            tile = _tile(turn, boxes[leaf] + origin, error)
            tile["content"] = {"uri": contents[lod, leaf]}
            if made is not None:
                tile["children"] = [made]
            made = tile
        if made is not None and volumes is not None and volumes.bounded[leaf]:
            made["viewerRequestVolume"] = {"box": _box(turn, volumes.boxes[leaf] + origin)}
        return made

    def node(tree: Tree) -> tuple[dict[str, Any] | None, F64]:
        """Return the tile of a node of the tree and its box; None if it has no content."""
        if not isinstance(tree, tuple):
            return leaf_tile(tree), boxes[tree]
        found = [(tile, box) for tile, box in map(node, tree) if tile is not None]
        if len(found) < 2:
            return found[0] if found else (None, whole)
        box = np.stack([np.min([b[0] for _, b in found], axis=0), np.max([b[1] for _, b in found], axis=0)])
        return _tile(turn, box + origin, widest) | {"children": [tile for tile, _ in found]}, box

    top, box = node(leaves.tree)
    children = [] if top is None else [top]
    if environment is not None:
        far = leaves.environment_box(DEVIATIONS)
        children.append(_tile(turn, far + origin, 0.0) | {"content": {"uri": environment}})
        box = np.stack([np.minimum(box[0], far[0]), np.maximum(box[1], far[1])])
    root = _tile(turn, box + origin, widest) | {"refine": "REPLACE", "children": children}
    if meters != 1.0:
        root["transform"] = np.diag([meters, meters, meters, 1.0]).ravel().tolist()
    return {
        "asset": {"version": "1.1", "generator": GENERATOR},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": _extensions_of(packed)},
        "geometricError": _rounded(widest * meters),
        "root": root,
    }


def _extensions_of(packed: bool) -> dict[str, list[str]]:
    """Return the extensions that glTF contents use; packed contents require them."""
    if packed:
        return {"extensionsUsed": [SPLATS, SPZ], "extensionsRequired": [SPLATS, SPZ]}
    return {"extensionsUsed": [SPLATS]}


def _tile(turn: F64, box: F64, error: float) -> dict[str, Any]:
    """Return a tile with a box and an error."""
    return {"boundingVolume": {"box": _box(turn, box)}, "geometricError": _rounded(error)}


def _box(turn: F64, box: F64) -> list[float]:
    """Return the 12 numbers of a rotated box of the scene: its middle, then half of each side."""
    low, high = box
    half = np.maximum((high - low) / 2.0, 1e-9)
    middle = turn @ ((low + high) / 2.0)
    away = float(np.abs(middle).max() / half.max())
    digits = _DIGITS + max(0, int(np.log10(max(away, 1.0))) - 2)  # more digits far from (0, 0, 0)
    return [*(_rounded(v, digits) for v in middle.tolist()), *(_rounded(v) for v in (turn * half).T.ravel().tolist())]


def _rounded(value: float, digits: int = _DIGITS) -> float:
    """Return a number with significant digits."""
    return float(f"{value:.{digits}g}") + 0.0
