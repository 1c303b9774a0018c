"""Write a store: cells are added one by one, wait on disk, and are encoded when all are known.

Memory holds one cell, its classes, the sets of its neighbors, and 16 bytes for each Gaussian.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.files.atomic import atomic_path
from gsvis.files.cache import Cache
from gsvis.files.limits import MAX_EXPANSION
from gsvis.files.sections import FileKind, SectionFile, SectionWriter
from gsvis.jobs.in_order import in_order
from gsvis.progress import Progress, silent
from gsvis.pvs import _order
from gsvis.pvs import codec as _codec
from gsvis.pvs._kernels import store as kernels
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.run_classes import RunClasses
from gsvis.pvs.stored_certificates import CERTIFIED_ROW

__all__ = [
    "CELL_ROW",
    "FILE_KIND",
    "FORMAT",
    "FORMAT_RUNS",
    "FORMAT_SHARED",
    "CellSet",
    "StoreInfo",
    "StoreWriter",
    "beyond_free",
    "share_directions",
    "write_store",
]

FORMAT = "gsvis visible sets"
FORMAT_SHARED = "gsvis visible sets 2"
"""The format of stores in which neighbors share direction sets; versions before 0.4 cannot read it."""

FORMAT_RUNS = "gsvis visible sets 3"
"""The format of stores in which neighbors share what their classes differ by from cell to cell, too."""

FILE_KIND = FileKind(b"\x93GSPVS\r\n", 1, "a store of visible sets", "give a file that `gsvis pvs` has written")
MAX_CLASSES = 16
CELL_ROW = np.dtype(
    [
        ("set_offset", "<u8"),
        ("set_length", "<u4"),
        ("set_crc", "<u4"),
        ("class_offset", "<u8"),
        ("class_length", "<u4"),
        ("class_crc", "<u4"),
        ("visible", "<u4"),
        ("parent", "<i4"),
        ("viewpoints", "<u4"),
        ("unused", "<f4"),
    ]
)
"""The row of one cell in the file; its set and its classes are stored apart. `unused` held a value in older stores."""

FREE_BYTES = 1 << 30
"""Bytes of memory that a store of any file size may need: 67 million Gaussians at 16 bytes each."""

_GAUSSIAN_BYTES = 16  # in memory: order, labels and direction sets; all other arrays are smaller
_HELD = 64  # sets of recent cells, cached while neighbors are compared


def beyond_free(gaussians: int) -> int:
    """Return the bytes of memory that N Gaussians need beyond `FREE_BYTES`. The size of the file must justify them."""
    return max(_GAUSSIAN_BYTES * gaussians - FREE_BYTES, 0)


@dataclass(frozen=True, eq=False)
class StoreInfo:
    """The facts of a store besides its cells.

    Attributes:
        gaussians: N.
        scene: `scene_hash` of the scene.
        tau: Weight from which a Gaussian is visible.
        class_edges: (K,) lowest weight of each class, ascending from tau; a class ends where the next begins.
        config: How the sets were found; any JSON value.
    """

    gaussians: int
    scene: str
    tau: float
    class_edges: NDArray[np.float64]
    config: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if _check.positive_int("gaussians", self.gaussians, at_least=0) >= 1 << 31:
            raise ValueError(f"gaussians: expected fewer than 2^31, got {self.gaussians}")
        edges = _check.floats("class_edges", self.class_edges, ("K",), np.float64)
        rising = len(edges) > 0 and (np.diff(edges) > 0).all() and edges[0] > 0.0 and edges[-1] < 1.0
        if not rising or len(edges) > MAX_CLASSES:
            raise ValueError(f"class_edges: expected 1 to {MAX_CLASSES} rising weights in (0, 1), got {edges.tolist()}")
        if not np.isclose(self.tau, edges[0], rtol=1e-6):
            raise ValueError(f"tau: expected the lowest class edge {edges[0]:.6g}, got {self.tau!r}")
        try:
            config = json.loads(json.dumps(dict(self.config), allow_nan=False))
        except (TypeError, ValueError) as error:
            raise ValueError(f"config: expected what JSON can hold, got {error}") from error
        edges = edges.copy()
        edges.flags.writeable = False
        object.__setattr__(self, "class_edges", edges)
        object.__setattr__(self, "tau", float(self.tau))
        object.__setattr__(self, "config", config)


@dataclass(frozen=True, eq=False)
class CellSet:
    """The visible set of one cell.

    Attributes:
        ids: (V,) visible Gaussians, ascending, each once.
        classes: (V,) uint8, class of the largest weight of each, below K.
        viewpoints: Number of viewpoints that the set was found from.
        inner: Number of these viewpoints that were added because of a certificate.
        rays: Rays that certified it.
        missed: Estimated share of light that it misses, in [0, 1]; NaN without a certificate.
        bound: Upper 95% confidence bound of this share; NaN without a certificate.
        tile: Largest share of light that it misses in a tile of an image; NaN without a certificate.
    """

    ids: ArrayLike
    classes: ArrayLike
    viewpoints: int = 0
    inner: int = 0
    rays: int = 0
    missed: float = np.nan
    bound: float = np.nan
    tile: float = np.nan


class StoreWriter:
    """Writes a store cell by cell. Use it in a `with` block, which removes its temporary file.

    Args:
        path: The file to write; `finish` writes it atomically.
        grid: C cells.
        info: What else the store holds.

    Raises:
        OSError: If the folder cannot be written to.
    """

    def __init__(self, path: str | PathLike[str], grid: CellGrid, info: StoreInfo) -> None:
        self.path = _check.path("path", path)
        self.grid = grid
        self.info = info
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._rows = np.zeros(len(grid), CELL_ROW)
        self._certified = np.zeros(len(grid), CERTIFIED_ROW)
        self._spill = tempfile.TemporaryFile(dir=self.path.parent)  # noqa: SIM115  closed in __exit__
        self._places: list[tuple[int, int, int]] = []  # first byte, length of the set, length of the levels
        self._held: Cache[NDArray[np.uint64]] = Cache(max_items=_HELD)

    def __enter__(self) -> StoreWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._spill.close()

    def __len__(self) -> int:
        """Return the number of cells added so far."""
        return len(self._places)

    def add_cell(self, cell: CellSet) -> None:
        """Add the next cell, in the order of the grid.

        Raises:
            ValueError: If all cells were added already, or the set is not as `CellSet` describes.
        """
        number = len(self)
        n = self.info.gaussians
        if number >= len(self.grid):
            raise ValueError(f"cell: expected {len(self.grid)} cells, got one more")
        ids = _check.integers("ids", cell.ids, ("V",))
        classes = _check.integers("classes", cell.classes, ("V",), np.uint8)
        _check.same_length(ids=ids, classes=classes)
        if len(ids) and not (ids[0] >= 0 and ids[-1] < n and (np.diff(ids) > 0).all()):
            raise ValueError(f"ids: expected rising ids in [0, {n}), each once; sort them with np.unique")
        if len(classes) and classes.max() >= len(self.info.class_edges):
            raise ValueError(f"classes: expected numbers below {len(self.info.class_edges)}, got {classes.max()}")
        row = self._rows[number]
        certified = self._certified[number]
        row["visible"] = len(ids)
        row["viewpoints"] = _check.positive_int("viewpoints", cell.viewpoints, at_least=0)
        for name in ("inner", "rays"):
            certified[name] = _check.positive_int(name, getattr(cell, name), at_least=0)
        for name in ("missed", "bound", "tile"):
            certified[name] = _share(name, getattr(cell, name))
        packed = _codec.compress(_codec.pack(ids, n).tobytes(), level=1), _codec.compress(classes.tobytes(), level=1)
        start = self._spill.seek(0, 2)
        self._spill.write(packed[0] + packed[1])
        self._places.append((start, len(packed[0]), len(packed[1])))

    def finish(
        self,
        direction_sets: ArrayLike,
        *,
        groups: ArrayLike | None = None,
        labels: NDArray[np.uint16] | None = None,
        progress: Progress = silent,
    ) -> Path:
        """Encode all cells and write the file.

        Args:
            direction_sets: (N, 10) uint8.
            groups: (C,) the group of each cell, from 0: cells of a group give a Gaussian the same class. None for no
                groups. They make the file smaller, and change nothing else.
            labels: (N,) uint16 of the stored order, which sorts Gaussians by label, then by id. None chooses them.
            progress: Called with stage "store".

        Returns:
            The path of the file.

        Raises:
            ValueError: If cells are missing or the direction sets have another shape.
            OSError: If the disk is full; an older file at the path stays.
        """
        sets = np.asarray(direction_sets)
        if sets.shape != (self.info.gaussians, 10) or sets.dtype != np.uint8:
            wanted = f"({self.info.gaussians}, 10) uint8"
            raise ValueError(f"direction_sets: expected {wanted}, got {sets.shape} {sets.dtype}")
        if len(self) != len(self.grid):
            raise ValueError(f"cells: expected {len(self.grid)}, got {len(self)}; add_cell the others first")
        progress("store", 0, len(self))
        if labels is None:
            labels = _order.choose_labels(self.info.gaussians, len(self), self._set)
        _check.same_length(labels=labels, direction_sets=sets)
        if groups is None:
            self._rows["parent"] = _order.parents_of(self._count_shared(), len(self))
        else:
            self._rows["parent"] = self._parents_in_groups(_check.integers("groups", groups, (len(self),)))
        with atomic_path(self.path) as partial, partial.open("wb") as file:
            container = SectionWriter(file, FILE_KIND)
            self._write_sets(container, labels, progress)
            self._write_rest(container, labels, sets)
            file.flush()
        return self.path

    def _write_sets(self, container: SectionWriter, labels: NDArray[np.uint16], progress: Progress) -> None:
        """Write the sets of all cells, then their classes, then the set that any cell sees."""
        n = self.info.gaussians
        order = _order.order_of(labels)
        places = np.empty(n, np.int32)
        places[order] = np.arange(n, dtype=np.int32)
        everything = np.zeros(_codec.word_count(n), np.uint64)

        def scattered() -> Iterator[NDArray[np.uint64]]:
            """Yield the set of each cell in the order of the store."""
            for cell in range(len(self)):
                words = self._set(cell)
                np.bitwise_or(everything, words, out=everything)
                stored = np.zeros_like(words)
                kernels.scatter(words, places, stored)
                yield stored

        for cell, packed in enumerate(in_order(_codec.encode_set, scattered())):
            row = self._rows[cell]
            row["set_offset"], row["set_length"], row["set_crc"] = container.append(packed)
            progress("store", (cell + 1) // 2, len(self))
        container.close_section("sets")
        for cell, packed in enumerate(in_order(self._encode_classes, self._iter_levels(order))):
            row = self._rows[cell]
            row["class_offset"], row["class_length"], row["class_crc"] = container.append(packed)
            progress("store", (len(self) + cell + 1) // 2, len(self))
        container.close_section("classes")
        stored = np.zeros_like(everything)
        kernels.scatter(everything, places, stored)
        container.append(_codec.encode_set(stored))
        container.close_section("ever")

    def _iter_levels(self, order: NDArray[np.int32]) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.uint8] | None]]:
        """Yield the levels of each cell and of its parent, (N,) each, in the order of the store; None for no parent."""
        for cell in range(len(self)):
            parent = int(self._rows["parent"][cell])
            above = self._levels(parent)[order] if parent >= 0 else None
            yield self._levels(cell)[order], above

    def _encode_classes(self, levels: tuple[NDArray[np.uint8], NDArray[np.uint8] | None]) -> bytes:
        """Return the bytes of the classes of a cell from its levels and those of its parent."""
        own, above = levels
        stored = np.zeros(_codec.word_count(self.info.gaussians), np.uint64)
        kernels.mark(np.flatnonzero(own), stored)
        return _codec.encode_classes(stored, own, above, len(self.info.class_edges))

    def _write_rest(self, container: SectionWriter, labels: NDArray[np.uint16], sets: NDArray[np.uint8]) -> None:
        """Write all sections after the sets, and the header."""
        container.append(_codec.encode_labels(labels, level=19))
        container.close_section("labels")
        container.append(_codec.compress(np.ascontiguousarray(sets.T).tobytes()))
        container.close_section("directions")
        container.append(_codec.compress(self.grid.coords.astype("<i4").tobytes()))
        container.close_section("coords")
        container.append(self._rows.tobytes())
        container.close_section("cells")
        container.append(self._certified.tobytes())
        container.close_section("certificates")
        _make_room(container, self.info.gaussians)
        container.finish(
            {
                "format": FORMAT,
                "gaussians": self.info.gaussians,
                "scene": self.info.scene,
                "tau": self.info.tau,
                "class_edges": self.info.class_edges.tolist(),
                "config": self.info.config,
                "grid": self.grid.as_dict(),
            }
        )

    def _count_shared(self) -> list[tuple[int, int, int]]:
        """Return (shared, a, b) for each pair of neighbors: the number of Gaussians that both see."""
        edges = []
        for cell in range(len(self)):
            for other in self.grid.neighbors(cell).tolist():
                if other < cell:
                    edges.append((kernels.count_shared(self._set(cell), self._set(other)), other, cell))
        return edges

    def _parents_in_groups(self, groups: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the parents of cells, where those of a group give a Gaussian the same class."""
        shared = self._count_shared()
        within = [edge for edge in shared if groups[edge[1]] == groups[edge[2]]]
        touching = {(int(groups[a]), int(groups[b])) for _, a, b in shared if groups[a] != groups[b]}
        visible = self._rows["visible"].astype(np.int64)
        order = np.lexsort((np.arange(len(self)), -visible, groups))  # of each group the cell that sees most first
        first = np.concatenate([[True], np.diff(groups[order]) != 0])
        heads = order[first].astype(np.int32)
        among = []
        for a, b in sorted({(min(pair), max(pair)) for pair in touching}):
            alike = self._count_alike(int(heads[a]), int(heads[b]))
            among.append((alike, a, b))
        return _order.parents_in_groups(heads, within, among, len(self))

    def _count_alike(self, cell: int, other: int) -> int:
        """Return to how many Gaussians two cells give the same class."""
        levels = self._levels(cell)
        return int(np.count_nonzero((levels == self._levels(other)) & (levels > 0)))

    def _set(self, cell: int) -> NDArray[np.uint64]:
        """Return the set of a cell as packed words, scene order."""
        return self._held.find_or_make(cell, lambda: self._read_set(cell))

    def _read_set(self, cell: int) -> NDArray[np.uint64]:
        """Return the set of a cell from the temporary file."""
        start, length, _ = self._places[cell]
        self._spill.seek(start)
        data = _codec.decompress(self._spill.read(length), 8 * _codec.word_count(self.info.gaussians))
        words: NDArray[np.uint64] = np.frombuffer(data, np.uint64).copy()  # writeable, for the kernels
        return words

    def _levels(self, cell: int) -> NDArray[np.uint8]:
        """Return (N,) uint8, scene order: class plus 1 of Gaussians that a cell sees, 0 elsewhere."""
        start, skipped, length = self._places[cell]
        self._spill.seek(start + skipped)
        data = _codec.decompress(self._spill.read(length), int(self._rows["visible"][cell]))
        levels = np.zeros(self.info.gaussians, np.uint8)
        levels[_codec.ids_of(self._set(cell))] = np.frombuffer(data, np.uint8) + 1
        return levels


def share_directions(
    source: str | PathLike[str], target: str | PathLike[str], run: int, *, classes: RunClasses | None = None
) -> Path:
    """Copy a store, with one direction set for each run of Gaussians: the union of theirs.

    Args:
        source: A store with a direction set for each Gaussian.
        target: The file to write, another one.
        run: Gaussians in a run, at least 1; the last run may be shorter.
        classes: Classes to write in place of those of the store; None keeps them.

    Returns:
        The path of the file.

    Raises:
        FormatError: If the source is no store, or damaged.
        OSError: If the file cannot be written; an older file at the path stays.
    """
    _check.positive_int("run", run)
    path = _check.path("target", target)
    read = SectionFile(source, FILE_KIND)
    try:
        kept = {key: value for key, value in read.header.value.items() if key != "sections"}
        n = read.header.integer("gaussians", 0, (1 << 31) - 1)
        facts = {"format": FORMAT_SHARED, "directions_run": run}
        rows = np.frombuffer(read.read("cells"), CELL_ROW).copy()
        with atomic_path(path) as partial, partial.open("wb") as file:
            container = SectionWriter(file, FILE_KIND)
            if classes is not None:
                facts |= {"format": FORMAT_RUNS, "classes_run": classes.run}
                _append_run_classes(container, classes, rows)
            written = {"room", "cells"} if classes is None else {"room", "cells", "classes"}
            for name in (name for name in read.sections if name not in written):
                data = read.read(name)
                container.append(_in_runs(data, n, run) if name == "directions" else data)
                container.close_section(name)
            container.append(rows.tobytes())
            container.close_section("cells")
            _make_room(container, n)
            container.finish({**kept, **facts})
    finally:
        read.close()
    return path


def _append_run_classes(container: SectionWriter, classes: RunClasses, rows: NDArray[np.void]) -> None:
    """Append the sections of classes, and set in the rows of cells (C,) where they are. No cell has a parent then."""
    rows["parent"] = -1
    for cell in range(len(rows)):
        place = container.append(classes.encode_shifts(cell))
        for name, value in zip(("class_offset", "class_length", "class_crc"), place, strict=True):
            rows[name][cell] = value
    container.close_section("classes")
    container.append(classes.encode_common())
    container.close_section("common")


def _in_runs(data: bytes, n: int, run: int) -> bytes:
    """Return the section of direction sets with one set for each run of N Gaussians."""
    planes = np.frombuffer(_codec.decompress(data, 10 * n), np.uint8).reshape(10, n)
    if n == 0:
        return data
    shared = np.bitwise_or.reduceat(planes, np.arange(0, n, run), axis=1)
    return _codec.compress(np.ascontiguousarray(shared).tobytes(), level=19)


def _make_room(container: SectionWriter, gaussians: int) -> None:
    """Append bytes until the file is as large as a reader wants for the memory that N Gaussians need."""
    least = -(-beyond_free(gaussians) // MAX_EXPANSION)
    if container.size < least:
        container.append(bytes(least - container.size))
        container.close_section("room")


def _share(name: str, value: float) -> float:
    """Return a checked share in [0, 1], or NaN."""
    if not (np.isnan(value) or 0.0 <= value <= 1.0):
        raise ValueError(f"{name}: expected a share in [0, 1], or NaN for none, got {value!r}")
    return float(value)


def write_store(
    path: str | PathLike[str],
    grid: CellGrid,
    info: StoreInfo,
    cells: Iterable[CellSet],
    direction_sets: ArrayLike,
    *,
    progress: Progress = silent,
) -> Path:
    """Write a store of all cells at once.

    Args:
        path: The file to write, suffix `.pvs`.
        grid: C cells.
        info: What else the store holds.
        cells: The set of each cell, in the order of the grid; consumed one at a time.
        direction_sets: (N, 10) uint8; read after the last cell, so `cells` may fill it while it yields.
        progress: Called with stage "store".

    Raises:
        ValueError: If there are too few or too many cells, or a set is not as `CellSet` describes.
        OSError: If the file cannot be written; an older file at the path stays.
    """
    with StoreWriter(path, grid, info) as writer:
        for cell in cells:
            writer.add_cell(cell)
        return writer.finish(direction_sets, progress=progress)
