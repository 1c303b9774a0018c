"""Write contents of a package as the batches that a viewer's source gives, for pages under test.

    python -m tests.viewer.batches scene.gsvis folder --level low

`scene.json` has the header and, for each batch, where its arrays lie in `scene.bin`.
"""

from __future__ import annotations

import argparse
import base64
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.package import Package
from gsvis.package.codec import ChunkTable
from gsvis.package.contents import Contents
from gsvis.package.layout import TermLayout
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations
from gsvis.scene.symlog import from_symlog

I64 = NDArray[np.int64]


class Batches:
    """Arrays of batches, one after the other.

    Args:
        contents: What to send.
        harmonics: Tables and (N, 3 K) uint8 of a bare scene, one set for each Gaussian; None for a package.
    """

    def __init__(self, contents: Contents, harmonics: tuple[dict[str, Any], NDArray[np.uint8]] | None = None) -> None:
        self._contents, self._harmonics = contents, harmonics
        self._slots = np.full(len(contents), -1, np.int64)
        self._rows = np.full(len(contents.table), -1, np.int64)
        self._counts = [0, 0, 0]  # Gaussians, rows, terms so far
        self._data = bytearray()
        self._batches: list[dict[str, Any]] = []

    def add(self, ids: I64, *, terms: bool = True, gone: Sequence[int] = ()) -> None:
        """Append a batch with these Gaussians, by rising ids, all their terms, and ids that they replace."""
        made, (first, first_row, first_term) = self._contents, self._counts
        self._slots[ids] = first + np.arange(len(ids))
        chunks = np.unique(made.chunks[ids])
        new = chunks[self._rows[chunks] < 0]
        self._rows[new] = first_row + np.arange(len(new))
        table = made.table[new]
        rows = np.concatenate([table.origins, table.lows[:, None], table.steps, table.strides[:, None]], axis=1)
        counts = made.term_counts[ids].astype(np.int64) * terms
        own = np.repeat(made.term_offsets[ids] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
        bits = np.zeros((len(own), 8), np.uint8)
        bits[:, : made.term_records.shape[1]] = made.term_records[own]
        self._write(
            first=first, firstRow=first_row, firstTerm=first_term,
            ids=ids.astype("<u4"), records=np.ascontiguousarray(made.records[ids]).view("<u4"),
            rows=self._rows[made.chunks[ids]].astype("<u4"), means=made.gaussians(ids).means, chunks=rows.astype("<f4"),
            boxes=boxes_of(table),
            chunkLevels=made.chunk_levels[new], terms=bits.view("<u4"),
            owners=np.repeat(self._slots[ids], counts).astype("<u4"),
            gone=self._slots[np.asarray(gone, np.int64)].astype("<u4"),
            labels=None if self._harmonics is None else (len(made) - 1 - ids).astype("<u4"),
        )  # fmt: skip
        self._counts = [first + len(ids), first_row + len(new), first_term + len(own)]

    def _write(self, **parts: Any) -> None:
        said: dict[str, Any] = {}
        for name, part in parts.items():
            if isinstance(part, np.ndarray):
                kind = {"u": "Uint", "f": "Float"}[part.dtype.kind] + f"{8 * part.dtype.itemsize}Array"
                self._data += b"\0" * (-len(self._data) % 4)
                said[name] = [kind, len(self._data), part.size]
                self._data += part.tobytes()
            else:
                said[name] = part
        self._batches.append(said)

    def save(self, folder: Path) -> None:
        """Write the two files."""
        made = self._contents
        bits = int(TermLayout.from_grids(made.grids).widths.sum())
        header = {
            "gaussians": len(made), "terms": len(made.term_records), "chunks": len(made.table), "termBits": bits,
            "levels": [{"name": name, "count": 0} for name in made.names], "colors": asdict(made.grids),
            "harmonics": None if self._harmonics is None else self._harmonics[0], "up": [0, 0, 1],
            "metersPerUnit": 1, "identity": "0" * 64,
        }  # fmt: skip
        sets = None if self._harmonics is None else base64.b64encode(self._harmonics[1][::-1].tobytes()).decode()
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scene.bin").write_bytes(self._data)
        (folder / "scene.json").write_text(json.dumps({"header": header, "batches": self._batches, "sets": sets}))


def boxes_of(table: ChunkTable) -> NDArray[np.float32]:
    """Return (C, 6), the low and the high corner of each chunk."""
    low = table.origins.astype(np.float64)
    high = low + np.abs(table.steps.astype(np.float64)) * ((1 << table.bits.astype(np.int64)) - 1)
    ends = np.concatenate([low, high], axis=1)
    return np.where(table.logarithmic[:, None], from_symlog(ends), ends).astype("<f4")


def camera_dicts(cameras: Cameras) -> list[dict[str, Any]]:
    """Return cameras as the viewer takes them."""
    made = []
    for viewmat, k in zip(cameras.viewmats, cameras.Ks, strict=True):
        turn = viewmat[:3, :3].T
        made.append({
            "position": (-turn @ viewmat[:3, 3]).tolist(), "rotation": quats_from_rotations(turn[None])[0].tolist(),
            "width": cameras.width, "height": cameras.height,
            "fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2]),
        })  # fmt: skip
    return made


def main() -> None:
    """Write the batches of one level of a package."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("package", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--level", help="name of the level; the highest by default")
    parser.add_argument("--batch", type=int, default=50_000, help="Gaussians of a batch")
    given = parser.parse_args()
    with Package.open(given.package) as package:
        made = package.contents
    level = len(made.names) - 1 if given.level is None else made.names.index(given.level)
    ids = np.flatnonzero((made.first <= level) & (made.last >= level))
    batches = Batches(made)
    for start in range(0, len(ids), given.batch):
        batches.add(ids[start : start + given.batch])
    batches.save(given.out)


if __name__ == "__main__":
    main()
