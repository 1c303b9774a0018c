"""Find the light of each leaf of a streamed scene in each cell, and write it as the sidecar, with a table of levels.

docs/streamed.md describes the file to the byte. A row belongs to one or more cells: a bitmap of leaves, lowest bit
first, and a byte for the light of each leaf in it. Row 0 is for eyes outside of all cells, and has every leaf. The
table has the splats, bytes and error of each leaf at each level. This module knows no file format of scenes.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.index import extents
from gsvis.errors import SceneError
from gsvis.export.columns import GAIN_STEPS, quantize_gains
from gsvis.export.leaves import Leaves
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.stream.source import class_weights

__all__ = ["ABSENT", "FORMAT", "LOST", "VERSION", "LeafNeeds", "LevelTable", "find_needs", "scene_sum"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

FORMAT = "gsvis-leaves"
VERSION = 2

LOST = 1e-4
"""Largest share of the light of a cell that omitted leaves may have."""

ABSENT = 0.125
"""Error of a leaf that is not drawn at all: about the mean squared difference of two colors of a picture."""

CELL_ROW = np.dtype([("box", "<u2", 3), ("row", "<u2")])
_MOST = 0xFFFF
_SPHERE = 4.0 * np.pi


class LevelTable(NamedTuple):
    """The cost and the error of B leaves at L levels of detail, finest first.

    Attributes:
        counts: (L, B) Gaussians; 0 where a leaf has no such level.
        sizes: (L, B) bytes.
        errors: (L, B) mean squared difference from the finest level over what a leaf covers, in [0, 1].
    """

    counts: I64
    sizes: I64
    errors: F64

    def encode(self) -> bytes:
        """Return the table as it lies in the file; an error of 2^-64 or less is none."""
        bytes_of = np.where(self.errors > 2.0**-64, quantize_gains(np.maximum(self.errors, 1e-300), 0), 0)
        whole = (np.asarray(part, "<u4").tobytes() for part in (self.counts, self.sizes))
        return b"".join(whole) + bytes_of.astype(np.uint8).tobytes()


def scene_sum(names: list[str]) -> int:
    """Return the 32-bit FNV-1a sum of the names of all files, which hold hashes of their contents."""
    total = 0x811C9DC5
    for byte in "\n".join(names).encode():
        total = ((total ^ byte) * 0x01000193) & 0xFFFFFFFF
    return total


@dataclass(frozen=True, eq=False)
class LeafNeeds:
    """The needs of K cells for B leaves.

    Attributes:
        origin: (3,) lowest corner of box (0, 0, 0), scene frame.
        size: Side of a cell, scene units; 0 without cells.
        boxes: (K, 3) int64 box of each cell.
        lights: (K, B) light of each leaf in each cell: weight times solid angle, summed over Gaussians; 0 where the
            cell does not need the leaf.
        everywhere: (B,) light of each leaf for eyes outside of all cells.
    """

    origin: F64
    size: float
    boxes: I64
    lights: F64
    everywhere: F64

    @property
    def needed(self) -> Mask:
        """(K, B) whether each cell needs each leaf."""
        return self.lights > 0.0

    def coarsen(self) -> LeafNeeds:
        """Return the needs of cells twice as wide; a leaf has the light of the cell where it is brightest."""
        boxes, owner = np.unique(self.boxes // 2, axis=0, return_inverse=True)
        lights = np.zeros((len(boxes), self.lights.shape[1]))
        np.maximum.at(lights, owner.reshape(-1), self.lights)
        return LeafNeeds(self.origin, 2.0 * self.size, boxes, lights, self.everywhere)

    def encode(self, facts: dict[str, Any], table: LevelTable) -> bytes:
        """Return the file; `facts` go into its header.

        Raises:
            ValueError: If there are more than 65,535 rows.
        """
        bitmaps = np.packbits(self.needed, axis=1, bitorder="little")
        distinct, row_of = np.unique(bitmaps, axis=0, return_inverse=True)
        top = int(np.ceil(GAIN_STEPS * np.log2(max(self.lights.max(initial=0.0), self.everywhere.max(), 1e-300))))
        rows = [_row(np.ones(len(self.everywhere), np.bool_), self.everywhere, top)]
        for k in range(len(distinct)):
            mine = np.flatnonzero(row_of.reshape(-1) == k)
            rows.append(_row(self.needed[mine[0]], self.lights[mine].max(axis=0), top))
        if len(rows) > _MOST or self.boxes.max(initial=0) > _MOST:
            raise ValueError(f"needs: expected at most {_MOST:,} rows and boxes along an axis, got more")
        cells = np.zeros(len(self.boxes), CELL_ROW)
        cells["box"], cells["row"] = self.boxes, row_of.reshape(-1) + 1
        header = {
            "format": FORMAT,
            "version": VERSION,
            **facts,
            "leaves": len(self.everywhere),
            "levels": len(table.counts),
            "absent": ABSENT,
            "cells": len(cells),
            "rows": len(rows),
            "origin": [float(v) for v in self.origin],
            "size": float(self.size),
            "top": top,
        }
        text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-(len(text) + 4) % 4)
        return struct.pack("<I", len(text)) + text + table.encode() + cells.tobytes() + b"".join(rows)

    def encode_within(self, facts: dict[str, Any], table: LevelTable, most: int) -> bytes:
        """Return the file, with cells merged until it has at most `most` bytes or one cell is left."""
        needs = self
        data = needs.encode(facts, table)
        while len(data) > most and len(needs.boxes) > 1:
            needs = needs.coarsen()
            data = needs.encode(facts, table)
        return data


def find_needs(
    leaves: Leaves, store: VisibilityStore | None, *, lost: float = LOST, progress: Progress = silent
) -> LeafNeeds:
    """Return the needs of each cell: the brightest leaves, until at most a share `lost` of the light is missing.

    Args:
        leaves: The leaves.
        store: Visible sets of the union of their levels; None gives no cells, and orders leaves by opacity times area.
        lost: Largest share of the light of a cell, in [0, 1), in omitted leaves; 0 keeps every leaf of which the cell
            sees a Gaussian.
        progress: Called with stage "sets", in cells.

    Raises:
        ValueError: If `lost` is out of range.
        SceneError: If no cell sees a Gaussian that is in a leaf.
    """
    if not 0.0 <= lost < 1.0:
        raise ValueError(f"lost: expected a share in [0, 1), got {lost!r}")
    g = leaves.levels.union
    count = len(leaves)
    areas = np.minimum(extents(g)[1].astype(np.float64), 1e30)
    inside = leaves.finest
    if store is None:
        everywhere = _sums(leaves.of_ids[inside], (areas * g.opacities)[inside], count)
        return LeafNeeds(np.zeros(3), 0.0, np.zeros((0, 3), np.int64), np.zeros((0, count)), everywhere)
    weights = class_weights(store)
    centers = store.grid.centers
    near = store.grid.cell_size / 2.0
    lights = np.zeros((len(store), count))
    progress("sets", 0, len(store))
    for cell in range(len(store)):
        ids, classes = store.classes(cell)
        use = inside[ids]
        ids = ids[use]
        classes = classes[use]
        squared = np.square(g.means[ids] - centers[cell]).sum(axis=1)
        light = weights[classes] * np.minimum(areas[ids] / np.maximum(squared, near * near), _SPHERE)
        lights[cell] = _largest(_sums(leaves.of_ids[ids], light, count), lost)
        progress("sets", cell + 1, len(store))
    everywhere = lights.max(axis=0)
    if not everywhere.any():
        raise SceneError("leaves: no cell sees a Gaussian of the scene; build its visible sets again")
    grid = store.grid
    return LeafNeeds(grid.origin, grid.cell_size, grid.coords.astype(np.int64), lights, everywhere)


def _sums(owners: NDArray[np.int32], values: NDArray[np.floating], count: int) -> F64:
    """Return the sums of values by owner."""
    return np.asarray(np.bincount(owners, values, minlength=count), np.float64)


def _largest(lights: F64, lost: float) -> F64:
    """Return lights (B,) without the smallest, whose sum is at most a share of all."""
    order = np.argsort(lights, kind="stable")
    out: F64 = lights.copy()
    out[order[np.cumsum(lights[order]) <= lost * lights.sum()]] = 0.0
    return out


def _row(needed: Mask, lights: F64, top: int) -> bytes:
    """Return the row of a cell."""
    bits: NDArray[np.uint8] = np.packbits(needed, bitorder="little")
    return bits.tobytes() + quantize_gains(lights[needed], top).tobytes()
