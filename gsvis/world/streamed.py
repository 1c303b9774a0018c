"""A world as one scene to stream: the Gaussians of all nodes behind each other, and the cells of all tiles.

On the wire an id is the first id of its node plus its place in the package of the node, so nothing of the protocol and
of clients changes. A district is replaced, Gaussian by Gaussian, by the districts that it was made of, and those by the
lowest levels of their tiles, as a level is by the next. Visible sets are read tile by tile when a viewer comes near.
A node that is missing or damaged is left out, with one line in the log. Scene frame and units.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.index import SceneIndex, extents, nearest_replacements
from gsvis.color.records import Grids, quantize
from gsvis.errors import FormatError, GsvisError, SceneError
from gsvis.files.cache import Cache
from gsvis.package import Package
from gsvis.package.codec import ChunkTable
from gsvis.package.contents import Contents
from gsvis.package.manifest import Manifest
from gsvis.package.terms import encode_terms
from gsvis.scene.levels import Levels
from gsvis.stream import Quality, StreamedScene
from gsvis.stream.kept import KeptTables, open_kept
from gsvis.stream.scene import EveryCell, class_weights, term_cones
from gsvis.world.cells import WorldCells, WorldIndex, WorldSets
from gsvis.world.manifest import District
from gsvis.world.world import World

__all__ = ["WorldPackage", "open_world"]

_LOG = logging.getLogger(__name__)
I64 = NDArray[np.int64]


def open_world(
    path: str | PathLike[str],
    *,
    tables: str | PathLike[str] | None = None,
    max_cache_bytes: int = 512 << 20,
    quality: Quality | None = None,
) -> tuple[StreamedScene, KeptTables | None]:
    """Open a world for streaming.

    Args:
        path: Folder of the world.
        tables: Folder for kept tables; None holds the world in memory.
        max_cache_bytes: Most bytes of decoded sets and candidates of cells to keep.
        quality: How to round records before they are sent; None means not at all.

    Returns:
        The scene, whose package the caller closes, and its kept tables; None if it is in memory.

    Raises:
        FormatError: If the folder is no world, or no tile of it can be read.
        SceneError: If no tile of it has cells.
    """
    world, without = World.open(path), set[int]()
    while True:
        package = WorldPackage(world, without, tables)
        try:
            if tables is None:
                return StreamedScene.open(package, max_cache_bytes=max_cache_bytes, quality=quality), None
            return open_kept(package, tables, max_cache_bytes=max_cache_bytes, quality=quality)
        except _DamagedNodeError as error:
            _leave_out(world, error.node, str(error))
            without.add(error.node)


class _DamagedNodeError(GsvisError):
    """A part of a node is damaged."""

    def __init__(self, node: int, why: str) -> None:
        super().__init__(why)
        self.node = node


def _leave_out(world: World, node: int, why: str) -> None:
    kind = "tile" if node < len(world.manifest.tiles) else "district"
    _LOG.error("%s: %s %d is left out: %s", world.path.name, kind, node, why)


class WorldPackage(Package):
    """A world as a package: one manifest and one space of ids over all nodes. It has no parts of its own.

    Args:
        world: The world.
        without: Nodes to leave out.
        tables: Folder where joined visible sets stay; None means temporary files.

    Attributes:
        world: The world.
        nodes: Numbers of the nodes that can be read, ascending.
        bases: First id of each node of the world, and the number of all; nodes that are left out have no ids.
    """

    def __init__(self, world: World, without: set[int], tables: str | PathLike[str] | None = None) -> None:
        self.path, self.world, self._tables = world.path, world, None if tables is None else Path(tables)
        found: dict[int, Manifest] = {}
        for node in range(len(world)):
            if node in without:
                continue
            try:
                with world.package(node) as package:
                    found[node] = package.manifest
            except (GsvisError, OSError) as error:
                _leave_out(world, node, str(error))
        first = next((m for node, m in found.items() if node < len(world.manifest.tiles)), None)
        if first is None:
            raise FormatError(world.path, "", "a tile that can be read", "none", "prepare the world again")
        self.nodes = [node for node, m in found.items() if _fits(world, node, m, first)]
        self._manifests = {node: found[node] for node in self.nodes}
        self.bases = np.zeros(len(world) + 1, np.int64)
        for node, m in self._manifests.items():
            self.bases[node + 1] = m.gaussians
        self.bases = np.cumsum(self.bases)
        self.manifest = self._joined(first)

    @classmethod
    def open(cls, path: str | PathLike[str]) -> WorldPackage:
        """Open a world; see `Package.open`."""
        return cls(World.open(path), set())

    def close(self) -> None:
        """Do nothing: stores close when nobody uses them."""

    def check_parts(self) -> None:
        """Leave out nodes with a part that is missing or has another size, as when a part is damaged."""
        for node in self.nodes:
            try:
                with self.world.package(node) as package:
                    package.check_parts()
            except (GsvisError, OSError) as error:
                raise _DamagedNodeError(node, str(error)) from error

    @property
    def epsilon(self) -> float | None:
        """Contribution above which a term is active in a cell."""
        return self.manifest.info.epsilon

    @cached_property
    def contents(self) -> Contents:
        """All records, with colors in the tables of the world."""
        levels, pieces = len(self.manifest.names), []
        for node in self.nodes:
            try:
                with self.world.package(node) as package:
                    pieces.append(_in_world(package.contents, self.manifest.grids, levels, self._is_tile(node)))
            except (GsvisError, OSError) as error:
                raise _DamagedNodeError(node, str(error)) from error
        counts = np.cumsum([0, *(len(piece) for piece in pieces)])
        return Contents(
            self.manifest.names, ChunkTable.concatenate([piece.table for piece in pieces]),
            np.concatenate([piece.chunk_levels for piece in pieces]),
            np.concatenate([piece.records for piece in pieces]),
            np.concatenate([piece.term_counts for piece in pieces]),
            np.concatenate([piece.term_records for piece in pieces]), self.manifest.grids,
            np.unique(np.concatenate([piece.starts + at for piece, at in zip(pieces, counts[:-1], strict=True)])),
        )  # fmt: skip

    def scene_index(self, contents: Contents, nbytes: tuple[float, float], cache: Cache[Any]) -> SceneIndex:
        """Return what planners need to know of the world."""
        cells = WorldCells.read(self.world, [node for node in self.nodes if self._is_tile(node)])
        levels = contents.levels()
        (radii, areas), (offsets, ids) = extents(levels.union), self._links(levels)
        epsilon, n = self.epsilon, len(contents)
        cones = None if epsilon is None or not len(contents.term_records) else term_cones(contents, epsilon)
        terms = np.full(len(contents.term_records), nbytes[1], np.float32)
        counts = tuple(int(((levels.first <= k) & (k <= levels.last)).sum()) for k in range(len(levels.names)))
        every = EveryCell(n, len(terms))
        return WorldIndex.trusted(
            counts, means=levels.union.means, radii=radii, areas=areas, importance=np.ones(n, np.float32),
            gaussian_bytes=np.full(n, nbytes[0], np.float32), first=levels.first, last=levels.last,
            level_names=levels.names, term_offsets=_frozen(contents.term_offsets), term_bytes=_frozen(terms),
            replacement_offsets=_frozen(offsets), replacement_ids=_frozen(ids),
            class_weights=_frozen(self._weights()), grid=cells, sets=self.sets(cells, cache),
            active=None if epsilon is None else every, cones=cones,
        )  # fmt: skip

    def index_from(self, arrays: Any, cache: Cache[Any], **fields: Any) -> SceneIndex:
        """Return the index of a world whose arrays were written before."""
        cells = WorldCells.from_arrays(arrays, np.array(self.manifest.info.up))
        return WorldIndex.trusted(**{**fields, "grid": cells, "sets": self.sets(cells, cache)})

    def sets(self, cells: WorldCells, cache: Cache[Any]) -> WorldSets:
        """Return the visible sets of all cells, read tile by tile."""
        return WorldSets(self.world, cells, self.bases, self._tables, cache)

    def _is_tile(self, node: int) -> bool:
        return node < len(self.world.manifest.tiles)

    def _weights(self) -> NDArray[np.float32]:
        """Return the weight of each class, the same in all tiles."""
        for node in self.nodes:
            if self._is_tile(node) and self._manifests[node].visibility is not None:
                with self.world.package(node) as package:
                    return class_weights(package.visibility)
        raise SceneError(f"{self.path}: no tile has cells; prepare the world again")

    def _joined(self, first: Manifest) -> Manifest:
        """Return one manifest of all nodes."""
        every = list(self._manifests.values())
        tiles = [m for node, m in self._manifests.items() if self._is_tile(node)]
        names, far = first.names, sum(m.gaussians for node, m in self._manifests.items() if not self._is_tile(node))
        counts = [far] * len(names)
        for m in tiles:
            for k, count in enumerate(m.counts):
                counts[len(names) - len(m.counts) + k] += count
        info = replace(first.info, provenance=self.world.manifest.provenance, cost=None, fidelity=None)
        epsilons = [m.info.epsilon for m in tiles if m.info.epsilon is not None]
        info = replace(info, epsilon=min(epsilons, default=None))
        return replace(
            first, info=info, scene=_name_of(self.world), counts=tuple(counts), grids=_common([m.grids for m in every]),
            tables=tuple(row for m in every for row in m.tables), blocks=tuple(row for m in every for row in m.blocks),
            visibility=None, active_terms=None,
        )  # fmt: skip

    def _links(self, levels: Levels) -> tuple[I64, NDArray[np.int32]]:
        """Return what replaces each Gaussian: between levels, and between districts and what they were made of."""
        offsets, ids = nearest_replacements(levels)
        n, means, manifest = len(levels.union), levels.union.means, self.world.manifest
        pairs = [np.stack([np.repeat(np.arange(n), np.diff(offsets)), ids.astype(np.int64)], axis=1)]
        for node, district in self._districts():
            for part in district.children:
                mine, theirs = (np.arange(self.bases[k], self.bases[k + 1]) for k in (node, part))
                if part < len(manifest.tiles):
                    theirs = theirs[levels.first[theirs] == levels.first[theirs].min(initial=15)]
                if len(mine) and len(theirs):
                    pairs.append(_nearest(means, mine, theirs))
        found = np.unique(np.concatenate(pairs), axis=0)
        starts = np.concatenate([[0], np.cumsum(np.bincount(found[:, 0], minlength=n))]).astype(np.int64)
        return starts, found[:, 1].astype(np.int32)

    def _districts(self) -> list[tuple[int, District]]:
        nodes = ((node, self.world.manifest.node(node)) for node in self.nodes)
        return [(node, found) for node, found in nodes if isinstance(found, District)]


def _nearest(means: NDArray[np.float32], mine: I64, theirs: I64) -> I64:
    """Return pairs: the nearest of `mine` to each of `theirs`."""
    from scipy.spatial import cKDTree  # slow to import, and seldom needed

    nearest = cKDTree(means[mine]).query(means[theirs])[1]
    return np.stack([mine[nearest], theirs], axis=1)


def _fits(world: World, node: int, m: Manifest, first: Manifest) -> bool:
    """Return whether a node can be streamed beside the first tile; log why not."""
    same = m.info.up == first.info.up and m.grids.variant == first.grids.variant
    if same and m.grids.precision == first.grids.precision and len(m.names) <= len(first.names):
        return True
    _leave_out(world, node, "its axes, levels or colors are not those of the first tile; prepare the world again")
    return False


def _common(grids: list[Grids]) -> Grids:
    """Return tables that hold the colors of all."""

    def ends(of: Callable[[Grids], tuple[float, float]]) -> tuple[float, float]:
        return min(of(g)[0] for g in grids), max(of(g)[1] for g in grids)

    base = ends(lambda g: g.base[0]), ends(lambda g: g.base[1]), ends(lambda g: g.base[2])
    scales, decays = ends(lambda g: g.scales), ends(lambda g: g.decays)
    most = max(g.intensity for g in grids)
    return Grids(grids[0].variant, grids[0].precision, base, scales, decays, most)


def _in_world(contents: Contents, grids: Grids, levels: int, is_tile: bool) -> Contents:
    """Return the records of a node with colors in the tables of the world, and its levels as those of the world.

    The levels of a tile are the highest of the world; a district stands in all.
    """
    chunk_levels = contents.chunk_levels + np.uint8(levels - len(contents.names))
    if not is_tile:
        chunk_levels = np.tile(np.array([0, levels - 1], np.uint8), (len(chunk_levels), 1))
    records, terms = contents.records, contents.term_records
    if contents.grids != grids:
        colors = quantize(contents.colors().dequantize(), refit=False, grids=grids)
        records, terms = records.copy(), encode_terms(colors)
        records[:, 1:4] = colors.base
        if contents.layout.color_scale:
            records[:, 4] = colors.scales
    return replace(contents, chunk_levels=chunk_levels, records=records, term_records=terms, grids=grids)


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    view: NDArray[Any] = array.view()
    view.flags.writeable = False
    return view


def _name_of(world: World) -> str:
    return hashlib.sha256(world.manifest.to_json()).hexdigest()
