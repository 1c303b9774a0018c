"""Query the store of visible sets, one memory-mapped file with the visible set of each cell of a scene.

Ids are those of the scene; the stored order is internal. Positions and distances are in the scene's frame and units.
Opening reads a few kilobytes. All other data is read and checked on first use. Threads may share a store. `_writer.py`
writes stores, `codec.py` codes the sets.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Sequence
from functools import cached_property
from os import PathLike, fspath
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyroaring import BitMap

from gsvis import _check
from gsvis.errors import ArgumentError, FormatError
from gsvis.files.cache import Cache
from gsvis.files.joined import JoinedFiles
from gsvis.files.limits import DAMAGED, open_regular
from gsvis.files.sections import SectionFile
from gsvis.progress import Progress, silent
from gsvis.pvs import _head as head
from gsvis.pvs import _order, run_classes
from gsvis.pvs import codec as _codec
from gsvis.pvs._kernels import store as kernels
from gsvis.pvs._writer import FILE_KIND, CellSet, StoreInfo, StoreWriter, write_store
from gsvis.pvs.why import Why, why
from gsvis.raycast.tracer import Tracer
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, levels_record, union_of

__all__ = ["CellSet", "StoreInfo", "StoreWriter", "VisibilityStore", "check_store_target", "write_store"]

Words = NDArray[np.uint64]
U8 = NDArray[np.uint8]


class VisibilityStore:
    """An open store; `VisibilityStore.open` opens one.

    Attributes:
        path: The file.
        grid: The C cells.
        info: Number of Gaussians, scene, tau, classes, and how the store was built.
        certificates: How each set was found and certified, and what it misses.
        directions_run: Neighbors that share a direction set; 1 as built, 16 in a package.
        classes_run: Neighbors whose classes differ in the same way from cell to cell; 0 where each Gaussian has a class
            of its own in each cell, as built.
        cache: Cache of decoded cells; assign another `Cache` to share it.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        max_cache: int = 256 << 20,
        joined: JoinedFiles | None = None,
        cache: Cache[Any] | None = None,
        order: NDArray[np.int32] | None = None,
    ) -> None:
        """Open a file without checking its scene; see `open`.

        `joined` is the content of the file where it lies in several. A `cache` that others share holds the order, too,
        unless it is known: `order` is what `order` of another store of this file has returned.
        """
        self.path = _check.path("path", path)
        self._order = order
        self._keeps_order = cache is None
        self.cache = Cache[Any](_check.positive_int("max_cache", max_cache, at_least=0)) if cache is None else cache
        self._known_scene: weakref.ref[Gaussians | Levels] | None = None
        self._file = SectionFile(path, FILE_KIND, joined)
        try:
            self.info, self.grid = head.read_header(self._file)
            self.directions_run, self.classes_run = head.read_runs(self._file)
            self._rows = head.read_rows(self._file, len(self.grid), self.gaussians)
            if order is not None and len(order) != self.gaussians:
                raise ValueError(f"order: expected {self.gaussians:,} Gaussians, got {len(order):,}")
            self.certificates = head.read_certificates(self._file, len(self.grid))
        except BaseException:
            self._file.close()
            raise

    @classmethod
    def open(
        cls, path: str | PathLike[str], *, scene: Gaussians | Levels | None = None, max_cache: int = 256 << 20
    ) -> VisibilityStore:
        """Open a store; every file that `write_store` wrote opens.

        A header may claim 1 GiB of memory for any file size: 16 bytes for each of 67 million Gaussians. Beyond that, it
        may claim 64 MiB plus 256 bytes for each byte of the file.

        Args:
            path: The file.
            scene: The scene or levels that the store must belong to, compared by content. None skips the comparison and
                is faster.
            max_cache: Bytes of decoded cells to cache.

        Raises:
            FormatError: If the file is no store, damaged, cut, of a newer version, or of another scene.
            OSError: If the file cannot be opened.
        """
        store = cls(path, max_cache=max_cache)
        try:
            if scene is not None:
                store.check_scene(scene)
        except BaseException:
            store.close()
            raise
        return store

    def close(self) -> None:
        """Close the file; no query works afterward."""
        self._file.close()

    def __enter__(self) -> VisibilityStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        """Return C, the number of cells."""
        return len(self.grid)

    def __repr__(self) -> str:
        return f"VisibilityStore({self.gaussians:,} Gaussians, {len(self):,} cells, {self.path.name})"

    @property
    def gaussians(self) -> int:
        """N, the Gaussians of the scene."""
        return self.info.gaussians

    @property
    def tau(self) -> float:
        """Weight from which a Gaussian is visible."""
        return self.info.tau

    @property
    def visible_counts(self) -> NDArray[np.int64]:
        """(C,) visible Gaussians of each cell."""
        return self._rows["visible"].astype(np.int64)

    @property
    def viewpoints(self) -> NDArray[np.int64]:
        """(C,) number of viewpoints that each set was found from."""
        return self._rows["viewpoints"].astype(np.int64)

    @property
    def order(self) -> NDArray[np.int32]:
        """(N,) the Gaussian at each place of the sets in the file; do not change it."""
        if self._order is None and self._keeps_order:
            self._order = self._decode_order()
        return self.cache.find_or_make("order", self._decode_order) if self._order is None else self._order

    def class_interval(self, level: int) -> tuple[float, float]:
        """Return the lowest weight of a class and the weight at which it ends.

        Raises:
            ValueError: If there is no such class.
        """
        edges = [*self.info.class_edges.tolist(), 1.0]
        level = self._check_class("level", level)
        return edges[level], edges[level + 1]

    def cell_at(self, position: ArrayLike) -> int:
        """Return the cell that holds a position (3,), world frame; -1 outside all cells."""
        point = _check.floats("position", position, (3,), np.float64)
        return int(self.grid.cell_at(point[None])[0])

    def neighbors(self, cell: int) -> NDArray[np.int64]:
        """Return the cells that touch a cell at a face, an edge or a corner."""
        return self.grid.neighbors(self.check_cell(cell))

    def visible(self, cell: int, *, least_class: int = 0) -> BitMap:
        """Return the Gaussians that a cell sees.

        Args:
            cell: Number of the cell.
            least_class: Lowest weight class of the Gaussians returned; 0 returns all.

        Returns:
            A bitmap of ids that the caller may change.

        Raises:
            ValueError: If the cell is outside the grid, or there is no such class.
            FormatError: If the file is damaged there.
        """
        return _codec.bitmap_of(self._in_scene_order(self._at_least(cell, least_class)))

    def visible_ids(self, cell: int, *, least_class: int = 0) -> NDArray[np.int64]:
        """Return `visible` as (V,) ascending ids."""
        return _codec.ids_of(self._in_scene_order(self._at_least(cell, least_class)))

    def visible_words(self, cell: int) -> Words:
        """Return `visible` as packed words: Gaussian i is bit i % 64 of word i // 64, whole roaring containers."""
        return self._in_scene_order(self._words(self.check_cell(cell)))

    def visible_masks(self, cell: int, *, first: int = 0) -> tuple[NDArray[np.int32], Words]:
        """Return `visible` as the packed words that are not empty, ascending: their numbers, and masks.

        Ids begin at `first`, as those of a tile in a world. The decoded set is not cached.
        """
        held: Words | None = self.cache.find(("set", self.check_cell(cell)))
        return self._masks(self._decode(cell) if held is None else held, first)

    def ring_masks(
        self, rings: Sequence[Sequence[int]], *, first: int = 0
    ) -> list[list[tuple[NDArray[np.int32], Words]]]:
        """Return one set for each ring of cells: the Gaussians that it sees and earlier rings do not.

        Sets are as from `visible_masks`. They are joined as they are stored, and only what is new is put in order.
        """
        before = np.zeros(_codec.word_count(self.gaussians), np.uint64)
        found = []
        for ring in rings:
            fresh = np.zeros_like(before)
            for cell in ring:
                fresh |= self._words(self.check_cell(cell))
            fresh &= ~before
            before |= fresh
            found.append([self._masks(fresh, first)])
        return found

    def load(self) -> VisibilityStore:
        """Decode the data that all queries need, so that the first query does not wait; return the store."""
        _ = self.order
        return self

    def classes(self, cell: int) -> tuple[NDArray[np.int64], U8]:
        """Return the (V,) ids that a cell sees, ascending, and the (V,) weight class of each."""
        levels = self._levels(self.check_cell(cell))
        words = self._words(cell)
        order = self.order
        of_scene = np.empty(self.gaussians, np.uint8)  # pages that hold none of the set stay untouched
        kernels.scatter_levels(words, order, levels, of_scene)
        ids = np.empty(int(self._rows["visible"][cell]), np.int64)
        classes = np.empty(len(ids), np.uint8)
        kernels.take_levels(self._in_scene_order(words), of_scene, ids, classes)
        return ids, classes

    def union(self, cells: Iterable[int]) -> BitMap:
        """Return the Gaussians that any of the given cells sees."""
        total = np.zeros(_codec.word_count(self.gaussians), np.uint64)
        for cell in cells:
            total |= self._words(self.check_cell(cell))
        return _codec.bitmap_of(self._in_scene_order(total))

    def difference(self, cell: int, other: int) -> BitMap:
        """Return the Gaussians that `cell` sees and `other` does not."""
        words = self._words(self.check_cell(cell)) & ~self._words(self.check_cell(other))
        return _codec.bitmap_of(self._in_scene_order(words))

    def ever_visible(self) -> BitMap:
        """Return the Gaussians that at least one cell sees."""
        return _codec.bitmap_of(self._in_scene_order(self._ever))

    def distance_to_visibility(self, cell: int, *, within: float = np.inf) -> NDArray[np.float32]:
        """Return the distance from this cell to the nearest cell that sees each Gaussian.

        Args:
            cell: Number of the cell.
            within: Largest distance searched, scene units.

        Returns:
            (N,) float32, scene units, between the centers of the two cells: 0 if `cell` itself sees the Gaussian, at
            least the side of a cell otherwise, inf if no cell within the distance sees it.

        Raises:
            ValueError: If the cell is outside the grid, or `within` is negative.

        References:
            SRBF-Gaussian, section 6.3.
        """
        if not within >= 0.0:
            raise ValueError(f"within: expected a distance of at least 0, got {within!r}")
        nearest, distances = self._by_distance(self.check_cell(cell))
        out = np.full(self.gaussians, np.inf, np.float32)
        waiting = self._ever.copy()
        alive = np.flatnonzero(waiting)
        for other, distance in zip(nearest.tolist(), distances.tolist(), strict=True):
            if len(alive) == 0 or distance > within:
                break
            kept = kernels.reach(self._words(other), waiting, alive, self.order, np.float32(distance), out)
            alive = alive[:kept]
        return out

    def nearest_seer(self, gaussian: int, cell: int) -> tuple[int, float]:
        """Return the nearest cell that sees a Gaussian, and the distance of the centers; (-1, inf) if none does."""
        place = int(self._places[self.check_gaussian(gaussian)])
        if not _has(self._ever, place):
            return -1, np.inf
        for other, distance in zip(
            *(values.tolist() for values in self._by_distance(self.check_cell(cell))), strict=True
        ):
            if _has(self._words(other), place):
                return int(other), float(distance)
        raise self._fault("section 'ever'", "a Gaussian that some cell sees", f"Gaussian {gaussian}, which none sees")

    def seers(self, gaussian: int) -> NDArray[np.int64]:
        """Return the (S,) cells that see a Gaussian, ascending."""
        place = int(self._places[self.check_gaussian(gaussian)])
        return np.array([cell for cell in range(len(self)) if _has(self._words(cell), place)], np.int64)

    def class_of(self, gaussian: int, cell: int) -> int:
        """Return the weight class of a Gaussian from a cell; -1 if the cell does not see it."""
        return int(self._levels(self.check_cell(cell))[self._places[self.check_gaussian(gaussian)]]) - 1

    def why(self, gaussian: int, cell: int, tracer: Tracer | None = None) -> Why:
        """Return why a cell sees a Gaussian or not; see `gsvis.pvs.why.why`."""
        return why(self, tracer, gaussian, cell)

    @cached_property
    def direction_sets(self) -> U8:
        """(N, 10) uint8 direction sets from the build of the store; read-only.

        In a package `directions_run` neighbors share one: a face is set if any of them is seen from there.
        """
        runs = -(-self.gaussians // self.directions_run)
        flat = self._unpack("directions", 10 * runs)
        shared = np.frombuffer(flat, np.uint8).reshape(10, runs).T
        sets = np.repeat(shared, self.directions_run, axis=0)[: self.gaussians]
        sets.flags.writeable = False
        return sets

    def sizes(self) -> dict[str, float]:
        """Return the bytes of each section and of the file, and the bits for each pair (cell, visible Gaussian).

        `bits_per_pair` counts the file without its weight classes and direction sets. `class_bits_per_pair` counts the
        weight classes.
        """
        found: dict[str, float] = {name: section.length for name, section in self._file.sections.items()}
        pairs = max(1, int(self.visible_counts.sum()))
        classes = found["classes"] + found.get("common", 0)
        sets = self._file.size - classes - found["directions"]
        bits = {"bits_per_pair": 8.0 * sets / pairs, "class_bits_per_pair": 8.0 * classes / pairs}
        return {**found, "file": self._file.size, **bits}

    def verify(self, *, progress: Progress = silent) -> None:
        """Read and decode the whole file.

        Args:
            progress: Called with stage "verify".

        Raises:
            FormatError: If anything is damaged; the error names the first damaged place.
        """
        progress("verify", 0, len(self))
        for name in self._file.sections:
            self._file.read(name)
        _ = self.order, self.direction_sets
        ever = np.zeros_like(self._ever)
        for cell in range(len(self)):
            ever |= self._words(cell)
            self._levels(cell)
            progress("verify", cell + 1, len(self))
        if not np.array_equal(ever, self._ever):
            differ = int(np.unpackbits((ever ^ self._ever).view(np.uint8)).sum())
            raise self._fault("section 'ever'", "the union of all cells", f"a set that differs in {differ:,} Gaussians")

    def check_cell(self, cell: int) -> int:
        """Return the number of a cell; raise unless the grid has it.

        Raises:
            ValueError: If there is no cell of that number.
        """
        return self.grid.checked(cell)

    def check_gaussian(self, gaussian: int) -> int:
        """Return the id of a Gaussian; raise unless the scene has it.

        Raises:
            ValueError: If the scene has no such id.
        """
        number = isinstance(gaussian, int | np.integer) and not isinstance(gaussian, bool)
        if not number or not 0 <= gaussian < self.gaussians:
            raise ValueError(f"gaussian: expected an id in [0, {self.gaussians}), got {gaussian!r}")
        return int(gaussian)

    def check_scene(self, scene: Gaussians | Levels) -> None:
        """Raise unless the store was built from a scene of this content, or from levels with the same members.

        The union of levels also matches a store of these levels: the ids are the same.

        Raises:
            FormatError: If the store was built from another scene or other levels.
        """
        if self._known_scene is not None and self._known_scene() is scene:
            return
        union = union_of(scene)
        own = self.info.config.get("levels")
        of_union = "" if own is None else ", the union of levels"
        wanted = f"a store of {len(union):,} Gaussians"
        got = f"one of {self.gaussians:,}{of_union}"
        same = len(union) == self.gaussians
        if same:
            content = scene_hash(union)
            wanted = f"a store of scene {content[:12]}..."
            got = f"one of scene {self.info.scene[:12]}..."
            same = content == self.info.scene
        if same and isinstance(scene, Levels):
            wanted = f"a store of the levels {', '.join(scene.names)}"
            got = "one of other levels, or of none"
            same = own == levels_record(scene)
        if not same:
            remedy = "open it with the scene it was built from, or build it again"
            raise FormatError(self.path, "scene", wanted, got, remedy)
        self._known_scene = weakref.ref(scene)

    def _decode_order(self) -> NDArray[np.int32]:
        """Return the Gaussian at each stored position."""
        data = self._file.read("labels")
        try:
            return _order.order_of(_codec.decode_labels(data, self.gaussians))
        except _codec.CodecError as error:
            raise self._undecodable("section 'labels'", error) from error

    @cached_property
    def _places(self) -> NDArray[np.int32]:
        """(N,) the stored position of each Gaussian."""
        places = np.empty(self.gaussians, np.int32)
        places[self.order] = np.arange(self.gaussians, dtype=np.int32)
        return places

    @cached_property
    def _ever(self) -> Words:
        """The set that at least one cell sees, stored order."""
        data = self._file.read("ever")
        try:
            return _codec.decode_set(data, self.gaussians)
        except _codec.CodecError as error:
            raise self._undecodable("section 'ever'", error) from error

    def _by_distance(self, cell: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return all cells and their distances, nearest first, ties by number."""
        steps = self.grid.coords.astype(np.int64) - self.grid.coords[cell]
        squares = np.einsum("ij,ij->i", steps, steps)
        order = np.argsort(squares, kind="stable")
        return order, self.grid.cell_size * np.sqrt(squares[order])

    def _in_scene_order(self, words: Words) -> Words:
        """Return a set in scene order."""
        out = np.zeros_like(words)
        kernels.scatter(words, self.order, out)
        return out

    def _masks(self, words: Words, first: int) -> tuple[NDArray[np.int32], Words]:
        """Return the non-empty words of a set, scene order."""
        out = np.zeros(len(words) + 1, np.uint64)
        kernels.scatter_from(words, self.order, first & 63, out)
        return _codec.used_words(out, first >> 6)

    def _at_least(self, cell: int, least_class: int) -> Words:
        """Return the set of a cell with at least this weight class, stored order."""
        if self._check_class("least_class", least_class) == 0:
            return self._words(self.check_cell(cell))
        chosen = np.flatnonzero(self._levels(self.check_cell(cell)) > least_class)
        return _codec.pack(chosen, self.gaussians)

    def _words(self, cell: int) -> Words:
        """Return the set of a cell, stored order; do not change it."""
        held: Words | None = self.cache.find(("set", cell))
        if held is None:
            held = self._decode(cell)
            self.cache.keep(("set", cell), held)
        return held

    def _decode(self, cell: int) -> Words:
        """Return the decoded set of a cell, in stored order."""
        row = self._rows[cell]
        place = int(row["set_offset"]), int(row["set_length"]), int(row["set_crc"])
        data = self._file.read_part("sets", *place, f"set of cell {cell}")
        try:
            return _codec.decode_set(data, self.gaussians, int(row["visible"]))
        except _codec.CodecError as error:
            raise self._undecodable(f"set of cell {cell}", error) from error

    def _levels(self, cell: int) -> U8:
        """Return (N,) uint8, stored order: class plus 1 where a cell sees a Gaussian, else 0; do not change it."""
        held: U8 | None = self.cache.find(("classes", cell))
        if held is None:
            held = self._decode_levels(cell)
            self.cache.keep(("classes", cell), held)
        return held

    def _decode_levels(self, cell: int) -> U8:
        """Return the `_levels` of a cell from the file."""
        row = self._rows[cell]
        above = self._levels(int(row["parent"])) if row["parent"] >= 0 else None
        place = int(row["class_offset"]), int(row["class_length"]), int(row["class_crc"])
        data = self._file.read_part("classes", *place, f"classes of cell {cell}")
        words = self._words(cell)
        count = len(self.info.class_edges)
        try:
            if self.classes_run == 0:
                return _codec.decode_classes(data, words, self.gaussians, above, count)
            shifts = run_classes.decode_shifts(data, self.gaussians, self.classes_run, count)
        except _codec.CodecError as error:
            raise self._undecodable(f"classes of cell {cell}", error) from error
        return run_classes.run_levels(words, self.order, (self._common, shifts), self.classes_run, count)

    @cached_property
    def _common(self) -> U8:
        """(N,) uint8, scene order: the class of each Gaussian, to which a cell adds the shift of its run."""
        data = self._file.read("common")
        try:
            return run_classes.decode_common(data, self.gaussians, len(self.info.class_edges))
        except _codec.CodecError as error:
            raise self._undecodable("section 'common'", error) from error

    def _check_class(self, name: str, level: int) -> int:
        """Return a checked weight class."""
        count = len(self.info.class_edges)
        if isinstance(level, bool) or not isinstance(level, int | np.integer) or not 0 <= level < count:
            raise ValueError(f"{name}: expected a class in [0, {count}), got {level!r}")
        return int(level)

    def _unpack(self, name: str, length: int) -> bytes:
        """Return the content of a compressed section."""
        try:
            return _codec.decompress(self._file.read(name), length)
        except _codec.CodecError as error:
            raise self._undecodable(f"section {name!r}", error) from error

    def _fault(self, where: str, expected: str, got: str) -> FormatError:
        return FormatError(self.path, where, expected, got, DAMAGED)

    def _undecodable(self, where: str, error: _codec.CodecError) -> FormatError:
        return FormatError(self.path, where, "bytes that can be decoded", f"damaged ones ({error})", DAMAGED)


def _has(words: Words, place: int) -> bool:
    return bool(int(words[place >> 6]) >> (place & 63) & 1)


def check_store_target(path: str | PathLike[str], scene: str | None = None) -> None:
    """Raise if writing a store would replace a file of another kind, or the complete store of another scene.

    Args:
        path: The file, which may not exist.
        scene: `scene_hash` of the scene of the new store; None checks the kind of the file alone.

    Raises:
        ArgumentError: If it would; its name is "path".
    """
    target = Path(path)
    if not target.is_file() or target.stat().st_size == 0:
        return
    try:
        with VisibilityStore.open(target) as store:
            found = store.info.scene
    except FormatError:
        with open_regular(target) as file:
            if file.read(6) == FILE_KIND.magic[:6]:
                return  # a damaged store may be replaced
        problem = f"expected a new file or a store to replace, got {fspath(path)}, which is something else"
        raise ArgumentError("path", problem, "name another") from None
    if scene not in (None, found):
        problem = (
            f"expected a new file, or a store of this scene to replace, got {fspath(path)}, which is of the scene with"
            f" the hash {found[:12]}..."
        )
        raise ArgumentError("path", problem, "name a new file")
