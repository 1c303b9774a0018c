"""A world as one scene to stream: the Gaussians of all nodes, one node after the other, and the cells of all tiles.

On the wire an id is the first id of its node plus its place in the package of the node, so protocol and clients are the
same as for a package. As a level is replaced by the next one, so the Gaussians of a district are replaced by those of
its children, and in the end by the lowest levels of tiles. Visible sets are read tile by tile when a viewer comes near.
Districts that no cell sees have no ids. Nodes that are missing or damaged have none either, and are logged. Scene frame
and units.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.index import nearest_replacements
from gsvis.color.records import Grids, quantize
from gsvis.errors import FormatError, GsvisError, SceneError
from gsvis.files.cache import Cache
from gsvis.files.temporary import temporary_folder
from gsvis.package.codec import ChunkTable
from gsvis.package.contents import Contents
from gsvis.package.manifest import Manifest
from gsvis.package.package import PARTS
from gsvis.package.sets import open_sets
from gsvis.package.terms import encode_terms
from gsvis.stream import Quality, StreamedScene
from gsvis.stream.kept import KeptTables, open_kept
from gsvis.stream.source import EveryCell, class_weights
from gsvis.world.cells import WorldCells, WorldSets
from gsvis.world.manifest import District
from gsvis.world.world import World

__all__ = ["WorldSource", "open_world"]

_LOG = logging.getLogger(__name__)
I64 = NDArray[np.int64]
_TILE_WEIGHT = 16  # weight of a tile's symbols in the code, relative to a district's: more of them are sent


def open_world(
    path: str | PathLike[str],
    *,
    tables: str | PathLike[str] | None = None,
    max_cache_bytes: int = 512 << 20,
    quality: Quality | None = None,
    strict: bool = False,
) -> tuple[StreamedScene, KeptTables | None]:
    """Open a world for streaming.

    Args:
        path: Folder of the world.
        tables: Folder for kept tables, which are computed node by node; None means a temporary one.
        max_cache_bytes: Most bytes of decoded sets and candidates of cells to keep.
        quality: How to round records before they are sent; None means not at all.
        strict: Whether to raise if a node cannot be read; otherwise such nodes are left out.

    Returns:
        The scene, whose source the caller closes, and its kept tables, or None if they are not kept.

    Raises:
        GsvisError: If the folder is not a world, no tile can be read, or with `strict` a node cannot be read.
        SceneError: If no tile has cells.
        OSError: If a node cannot be read, with `strict`.
    """
    world = World.open(path)
    without = set[int]()
    while True:
        source = WorldSource(world, without, strict=strict)
        try:
            if tables is None:
                with temporary_folder() as folder:  # a mapped file stays readable after it is deleted
                    return open_kept(source, folder, max_cache_bytes=max_cache_bytes, quality=quality)[0], None
            return open_kept(source, tables, max_cache_bytes=max_cache_bytes, quality=quality)
        except _DamagedNodeError as error:
            if strict:
                raise
            _log_left_out(world, error.node, str(error))
            without.add(error.node)


class _DamagedNodeError(GsvisError):
    """A part of a node is damaged."""

    def __init__(self, node: int, why: str) -> None:
        super().__init__(why)
        self.node = node


def _log_left_out(world: World, node: int, why: str) -> None:
    """Log that a node is left out."""
    kind = "tile" if node < len(world.manifest.tiles) else "district"
    _LOG.error("%s: %s %d is left out: %s", world.path.name, kind, node, why)


class WorldSource:
    """A world as a source of a streamed scene: one manifest and one space of ids over all nodes.

    Args:
        world: The world.
        without: Nodes to leave out.
        strict: Whether to raise if a node cannot be read or does not fit; otherwise it is left out.

    Attributes:
        path: The folder.
        manifest: One manifest of all nodes.
        world: The world.
        nodes: Numbers of the nodes that can be read and are needed, ascending.
        bases: First id of each node of the world, and the number of all ids; nodes not in `nodes` have no ids.
    """

    is_single = False
    has_cells = True

    def __init__(self, world: World, without: Collection[int] = (), *, strict: bool = False) -> None:
        self.path = world.path
        self.world = world
        self._strict = strict
        found: dict[int, Manifest] = {}
        for node in _needed_nodes(world):
            if node in without:
                continue
            try:
                with world.package(node) as package:
                    found[node] = package.manifest
            except (GsvisError, OSError) as error:
                if strict:
                    raise
                _log_left_out(world, node, str(error))
        first = max(
            (m for node, m in found.items() if node < len(world.manifest.tiles)),
            key=lambda m: len(m.names),
            default=None,
        )
        if first is None:
            raise FormatError(world.path, "", "a tile that can be read", "none", "prepare the world again")
        self.nodes = [node for node, m in found.items() if _is_compatible(world, node, m, first, strict)]
        self._manifests = {node: found[node] for node in self.nodes}
        self.bases = np.zeros(len(world) + 1, np.int64)
        for node, m in self._manifests.items():
            self.bases[node + 1] = m.gaussians
        self.bases = np.cumsum(self.bases)
        self.manifest = self._join_manifests(first)

    @property
    def tiles(self) -> list[int]:
        """Numbers of the tiles that can be read, ascending."""
        return [node for node in self.nodes if self._is_tile(node)]

    @classmethod
    def open(cls, path: str | PathLike[str], *, strict: bool = False) -> WorldSource:
        """Open a world by its folder."""
        return cls(World.open(path), strict=strict)

    def __enter__(self) -> WorldSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return repr(self.world)

    def close(self) -> None:
        """Do nothing: stores close when they are no longer used."""

    def check_parts(self) -> None:
        """Raise if a part of a node is missing or has a wrong size; `open_world` then leaves out the node."""
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

    def ranges(self) -> list[tuple[int, int]]:
        """Return the first id of each node that can be read, and the end of its ids."""
        return [(int(self.bases[node]), int(self.bases[node + 1])) for node in self.nodes]

    def pieces(self) -> Iterator[Contents]:
        """Yield the records of each node, with the color tables and the levels of the world."""
        for node in self.nodes:
            try:
                with self.world.package(node) as package:
                    found = _convert_records(package.contents, self.manifest, self._is_tile(node))
            except (GsvisError, OSError) as error:
                raise _DamagedNodeError(node, str(error)) from error
            yield found

    def piece_weight(self, piece: int) -> int:
        """Return the factor for counts of a node's symbols: tiles are sent more than districts."""
        return _TILE_WEIGHT if self._is_tile(self.nodes[piece]) else 1

    def piece_links(self, piece: int, contents: Contents, means: Callable[[int, int], NDArray[np.float32]]) -> I64:
        """Return the replacements of a node's Gaussians: the next level in a tile; the children of a district.

        Args:
            piece: Number of the node among those that can be read.
            contents: Records of the node.
            means: Returns the centers of the ids in [low, high), for earlier nodes.
        """
        node = self.nodes[piece]
        low = int(self.bases[node])
        if self._is_tile(node):
            offsets, ids = nearest_replacements(contents.levels())
            owners = np.repeat(np.arange(len(contents)), np.diff(offsets))
            return low + np.stack([owners, ids.astype(np.int64)], axis=1)
        pairs = [np.zeros((0, 2), np.int64)]
        own = contents.gaussians().means
        for child in self._children[node]:
            first, end = self.bases[child : child + 2].tolist()
            theirs = first + self._lowest_ids(child, end - first)
            pairs.append(_pair_nearest(own, means(first, end)[theirs - first], low, theirs))
        return np.unique(np.concatenate(pairs), axis=0)

    def piece_order(self, piece: int) -> NDArray[np.int32]:
        """Return the Gaussian at each place (N,) of a node's visible sets; -1 without sets, or if they are damaged."""
        node = self.nodes[piece]
        unknown = np.full(int(self.bases[node + 1] - self.bases[node]), -1, np.int32)
        if not self._is_tile(node) or self._manifests[node].visibility is None:
            return unknown
        try:
            store = open_sets(self.world.package_path(node) / PARTS, self._manifests[node], Cache())
            try:
                return store.order
            finally:
                store.close()
        except (GsvisError, OSError):  # logged when the sets are read
            return unknown

    def piece_sources(self, piece: int) -> Sequence[int]:
        """Return the nodes that may have Gaussians that those of this node replace: itself and its district."""
        node, numbers = self.nodes[piece], {node: k for k, node in enumerate(self.nodes)}
        return [piece, *(numbers[k] for k, children in self._children.items() if node in children)]

    def set_files(self, *, verify: bool = False) -> list[Path]:
        """Return nothing: visible sets are checked when they are read."""
        return []

    def forget_records(self) -> None:
        """Do nothing: records are read node by node."""

    def part_of(self, gaussian: int) -> tuple[Contents, int]:
        """Return the records of the part that has a Gaussian, and the id of its first one; see `Package.part_of`."""
        if not 0 <= gaussian < self.bases[-1]:
            raise ValueError(f"gaussian: expected an id below {self.bases[-1]:,}, got {gaussian}")
        node = int(np.searchsorted(self.bases, gaussian, "right")) - 1
        with self.world.package(node) as package:
            contents, start = package.part_of(gaussian - int(self.bases[node]))
        return contents, start + int(self.bases[node])

    def read_contents(self) -> Contents:
        """Return all records, with the color tables of the world."""
        pieces = list(self.pieces())
        counts = np.cumsum([0, *(len(piece) for piece in pieces)])
        return Contents(
            self.manifest.names,
            ChunkTable.concatenate([piece.table for piece in pieces]),
            np.concatenate([piece.chunk_levels for piece in pieces]),
            np.concatenate([piece.records for piece in pieces]),
            np.concatenate([piece.term_counts for piece in pieces]),
            np.concatenate([piece.term_records for piece in pieces]),
            self.manifest.grids,
            np.unique(np.concatenate([piece.starts + at for piece, at in zip(pieces, counts[:-1], strict=True)])),
            pieces[0].facts,
        )

    def read_cells(self) -> tuple[WorldCells, NDArray[np.float32]]:
        """Return the cells of all tiles, and the weight of each class."""
        return WorldCells.read(self.world, self.tiles, strict=self._strict), self._weights()

    def cells_from(self, arrays: Mapping[str, NDArray[Any]]) -> WorldCells:
        """Return the cells from the arrays of `WorldCells.to_arrays`."""
        return WorldCells.from_arrays(arrays, np.array(self.manifest.info.up))

    def sets(self, cells: Any, cache: Cache[Any], arrays: Mapping[str, NDArray[Any]]) -> WorldSets:
        """Return the visible sets of all cells, read tile by tile; see `SceneSource.sets`."""
        levels = len(self.manifest.names)
        own = self.bases, levels, self._manifests, cache
        return WorldSets(self.world, cells, *own, orders=arrays.get("set_order"), last=arrays["last"])

    def active(self) -> EveryCell | None:
        """Return all terms as active in every cell; None if no terms are sent."""
        return None if self.epsilon is None else EveryCell(int(self.bases[-1]), self.manifest.terms)

    def _is_tile(self, node: int) -> bool:
        """Return whether a node is a tile."""
        return node < len(self.world.manifest.tiles)

    def _weights(self) -> NDArray[np.float32]:
        """Return the weight of each class, the same in all tiles."""
        for node in self.nodes:
            if self._is_tile(node) and self._manifests[node].visibility is not None:
                with self.world.package(node) as package:
                    return class_weights(package.visibility)
        raise SceneError(f"{self.path}: no tile has cells; prepare the world again")

    def _join_manifests(self, first: Manifest) -> Manifest:
        """Return one manifest for all nodes; `first` is the tile manifest with most levels."""
        every = list(self._manifests.values())
        tiles = [m for node, m in self._manifests.items() if self._is_tile(node)]
        names = first.names
        far = sum(m.gaussians for node, m in self._manifests.items() if not self._is_tile(node))
        counts = [far + sum(m.counts[max(0, k + len(m.counts) - len(names))] for m in tiles) for k in range(len(names))]
        info = replace(first.info, provenance=self.world.manifest.provenance, cost=None, fidelity=None)
        epsilons = [m.info.epsilon for m in tiles if m.info.epsilon is not None]
        info = replace(info, epsilon=min(epsilons, default=None))
        return replace(
            first,
            info=info,
            scene=_hash_manifest(self.world),
            counts=tuple(counts),
            grids=_join_grids([m.grids for m in every]),
            tables=tuple(row for m in every for row in m.tables),
            blocks=tuple(row for m in every for row in m.blocks),
            visibility=None,
            active_terms=None,
        )

    def _lowest_ids(self, node: int, count: int) -> I64:
        """Return the ids in a node that replace its district: the lowest level of a tile, or all of a district."""
        if not self._is_tile(node):
            return np.arange(count)
        with self.world.package(node) as package:
            first = package.contents.first
        return np.flatnonzero(first == first.min())

    @cached_property
    def _children(self) -> dict[int, list[int]]:
        """For each district with ids, the nodes with ids that replace it: its children, or their children."""
        has_ids = set(self.nodes)

        def below(node: int) -> Iterator[int]:
            """Yield the nearest nodes with ids below a district."""
            entry = self.world.manifest.node(node)
            for child in entry.children if isinstance(entry, District) else ():
                yield from (child,) if child in has_ids else below(child)

        return {node: list(below(node)) for node in self.nodes if not self._is_tile(node)}


def _needed_nodes(world: World) -> list[int]:
    """Return the tiles, and the districts that are used around a tile: no cell sees other districts."""
    tables = [tile.beyond for tile in world.manifest.tiles if tile.beyond is not None]
    seen = {piece.node for table in tables for piece in table.pieces}
    return [node for node in range(len(world)) if node < len(world.manifest.tiles) or node in seen]


def _pair_nearest(mine: NDArray[np.float32], theirs: NDArray[np.float32], low: int, ids: I64) -> I64:
    """Return pairs (K, 2): the id of the nearest of `mine` for each of `theirs` (K, 3), and its id.

    Args:
        mine: (M, 3) centers, whose ids begin at `low`.
        theirs: (K, 3) centers.
        low: First id of `mine`.
        ids: (K,) ids of `theirs`.
    """
    from scipy.spatial import cKDTree  # slow to import, and seldom needed

    return np.stack([low + cKDTree(mine).query(theirs)[1].astype(np.int64), ids], axis=1)


def _is_compatible(world: World, node: int, m: Manifest, first: Manifest, strict: bool) -> bool:
    """Return whether axes, levels and colors of a node fit `first`, a tile; if not, log it or raise."""
    same = m.info.up == first.info.up and m.grids.variant == first.grids.variant
    if same and m.grids.precision == first.grids.precision and len(m.names) <= len(first.names):
        return True
    if strict:
        expected = f"up {first.info.up}, at most {len(first.names)} levels and the colors of the tiles"
        got = f"up {m.info.up}, {len(m.names)} levels, colors {m.grids.variant}"
        raise FormatError(world.path, f"node {node}", expected, got, "prepare the world again")
    _log_left_out(world, node, "its axes, levels or colors are not those of the tiles; prepare the world again")
    return False


def _join_grids(grids: list[Grids]) -> Grids:
    """Return color tables with the range of all these tables together."""

    def ends(of: Callable[[Grids], tuple[float, float]]) -> tuple[float, float]:
        """Return the least and largest value of a range over all tables."""
        return min(of(g)[0] for g in grids), max(of(g)[1] for g in grids)

    base = ends(lambda g: g.base[0]), ends(lambda g: g.base[1]), ends(lambda g: g.base[2])
    scales = ends(lambda g: g.scales)
    decays = ends(lambda g: g.decays)
    most = max(g.intensity for g in grids)
    return Grids(grids[0].variant, grids[0].precision, base, scales, decays, most)


def _convert_records(contents: Contents, world: Manifest, is_tile: bool) -> Contents:
    """Return the records of a node with the color tables and the levels of the world.

    The levels of a tile become the highest levels of the world, and its lowest level is in all lower ones too. A
    district is in all levels.
    """
    grids = world.grids
    more = np.uint8(len(world.names) - len(contents.names))
    chunk_levels = contents.chunk_levels + more
    chunk_levels[contents.chunk_levels[:, 0] == 0, 0] = 0
    if not is_tile:
        chunk_levels[:] = 0, len(world.names) - 1
    records = contents.records
    terms = contents.term_records
    if contents.grids != grids:
        colors = quantize(contents.colors().dequantize(), refit=False, grids=grids)
        records = records.copy()
        terms = encode_terms(colors)
        records[:, 1:4] = colors.base
        if contents.layout.color_scale:
            records[:, 4] = colors.scales
    return replace(
        contents, records=records, term_records=terms, grids=grids, names=world.names, chunk_levels=chunk_levels
    )


def _hash_manifest(world: World) -> str:
    """Return the hash of the manifest of a world, which identifies its content."""
    return hashlib.sha256(world.manifest.to_json()).hexdigest()
