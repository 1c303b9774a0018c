"""The manifest of a world: its grid, its tiles and districts, and the tables of what each tile's cells see outside it.

The manifest is JSON and contains its own hash. It names packages and tables by the SHA-256 of their content and is
written last, so a folder with a manifest is complete. Scene frame and units. This module opens no package.
docs/design/057-worlds.md has the format.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import DAMAGED, inside, read_whole

__all__ = ["VERSION", "WORLD", "BeyondTable", "District", "Grid", "Piece", "Tile", "WorldManifest"]

I64 = NDArray[np.int64]
Point = tuple[float, float, float]

FORMAT = "gsvis-world"
VERSION = 2
WORLD = "world.json"
"""Name of the manifest."""

_MOST_BYTES = 1 << 30
_MOST = (1 << 31) - 1
_MOST_NODES = 1 << 20
_MOST_SQUARES = 1 << 22
_DIGEST = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True)
class Grid:
    """The grid of squares; each tile is a rectangle of squares.

    Attributes:
        origin: (3,) lowest corner of square (0, 0), scene frame.
        side: Side of a square.
        axes: The two axes of the squares, 0 to 2, ascending; tiles are not cut along the third.
        shape: Squares along each of the two axes.
    """

    origin: Point
    side: float
    axes: tuple[int, int]
    shape: tuple[int, int]

    def squares_of(self, points: ArrayLike) -> I64:
        """Return the square (M, 2) of each point (M, 3); (-1, -1) for a point outside all squares.

        A point on the border of two squares belongs to the higher one.
        """
        where = _check.floats("points", points, ("M", 3), np.float64)[:, self.axes]
        steps = (where - np.array(self.origin)[list(self.axes)]) / self.side
        squares: I64 = np.floor(np.clip(steps, -1.0, np.array(self.shape))).astype(np.int64)
        out = ((squares < 0) | (squares >= np.array(self.shape))).any(axis=1)
        squares[out] = -1
        return squares


@dataclass(frozen=True)
class Piece:
    """A part of a node that is used around a tile; its ids are numbered in the table of the tile.

    Attributes:
        node: Number of the node. It can have several pieces, with different ids and levels.
        level: Highest level of the node that is used.
        runs: (first id, count) of ids of these levels in the package of the node, ascending.
    """

    node: int
    level: int
    runs: tuple[tuple[int, int], ...]

    @property
    def count(self) -> int:
        """Number of ids."""
        return sum(count for _, count in self.runs)

    def ids(self) -> I64:
        """Return the ids (K,) in the package of the node, ascending."""
        return np.concatenate([np.arange(first, first + count) for first, count in self.runs] or [np.zeros(0, int)])


@dataclass(frozen=True)
class BeyondTable:
    """The table of what the cells of a tile see outside it: a store of visible sets, and the pieces that it numbers.

    Attributes:
        digest: SHA-256 of the store, 64 hexadecimal digits.
        nbytes: Bytes of the store.
        pieces: The pieces, in the order of the ids of the store.
    """

    digest: str
    nbytes: int
    pieces: tuple[Piece, ...]

    @property
    def name(self) -> str:
        """File name of the store."""
        return f"{self.digest}.pvs"

    @property
    def count(self) -> int:
        """Number of ids of the store."""
        return sum(piece.count for piece in self.pieces)


@dataclass(frozen=True)
class Tile:
    """A tile.

    Attributes:
        coords: Its first square; None for the tile of what lies outside all squares.
        low: (3,) lowest corner of the box around the centers of its Gaussians.
        high: (3,) highest corner.
        package: SHA-256 of the manifest of its package, 64 hexadecimal digits.
        nbytes: Bytes of the package.
        levels: Names and sizes of the levels, lowest first.
        gaussians: Gaussians of all levels together.
        cells: Cells of its visible sets; 0 without space for eyes.
        beyond: What its cells see beyond it; None if there is nothing.
        shape: Its squares along each of the two axes.
    """

    coords: tuple[int, int] | None
    low: Point
    high: Point
    package: str
    nbytes: int
    levels: tuple[tuple[str, int], ...]
    gaussians: int
    cells: int
    beyond: BeyondTable | None = None
    shape: tuple[int, int] = (1, 1)


@dataclass(frozen=True)
class District:
    """A few Gaussians that replace a tile, or neighboring tiles, when seen from far.

    Attributes:
        children: Numbers of the nodes that it was made of: one tile, or earlier districts.
        tiles: Numbers of the tiles that it replaces, ascending.
        low: (3,) lowest corner of the box around the centers of its Gaussians.
        high: (3,) highest corner.
        spacing: Median distance from a Gaussian to its nearest neighbor.
        package: SHA-256 of the manifest of its package.
        nbytes: Bytes of the package.
        gaussians: Number of Gaussians.
    """

    children: tuple[int, ...]
    tiles: tuple[int, ...]
    low: Point
    high: Point
    spacing: float
    package: str
    nbytes: int
    gaussians: int


@dataclass(frozen=True)
class WorldManifest:
    """The content of `world.json`. Nodes are the tiles, 0 to T - 1, then the districts.

    Attributes:
        up: (3,) unit axis that points upward.
        meters_per_unit: Meters in a scene unit; 0 if unknown.
        grid: The squares.
        tiles: T tiles, by first square; the tile of what is outside all squares comes last.
        districts: Districts; children come before parents.
        provenance: What made the world; any JSON values.
    """

    up: Point
    meters_per_unit: float
    grid: Grid
    tiles: tuple[Tile, ...]
    districts: tuple[District, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of nodes."""
        return len(self.tiles) + len(self.districts)

    @property
    def gaussians(self) -> int:
        """Gaussians of all tiles, all levels together."""
        return sum(tile.gaussians for tile in self.tiles)

    def node(self, number: int) -> Tile | District:
        """Return a node.

        Raises:
            ValueError: If there is no such node.
        """
        if isinstance(number, bool) or not 0 <= number < len(self):
            raise ValueError(f"node: expected a number in [0, {len(self)}), got {number!r}")
        return self.tiles[number] if number < len(self.tiles) else self.districts[number - len(self.tiles)]

    def tiles_at(self, points: ArrayLike) -> I64:
        """Return the number (M,) of the tile whose squares contain each point (M, 3); -1 for no tile."""
        squares = self.grid.squares_of(points)
        found = np.full(len(squares), -1, np.int64)
        for k, tile in enumerate(self.tiles):
            if tile.coords is not None:
                apart = squares - tile.coords
                found[((apart >= 0) & (apart < tile.shape)).all(axis=1)] = k
        return found

    def write(self, path: Path) -> None:
        """Write the manifest atomically; the same manifest gives the same bytes.

        Raises:
            OutputError: If it cannot be written.
        """
        with atomic_path(path) as partial:
            partial.write_bytes(self.to_json())

    def to_json(self) -> bytes:
        """Return the bytes of the file."""
        value: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "up": self.up,
            "meters_per_unit": self.meters_per_unit,
            "grid": asdict(self.grid),
            "tiles": [_tile_as_dict(tile) for tile in self.tiles],
            "districts": [_district_as_dict(district) for district in self.districts],
            "provenance": self.provenance,
        }
        value = json.loads(json.dumps(value, allow_nan=False))
        return json.dumps({**value, "sha256": _digest(value)}, indent=1, sort_keys=True).encode()

    @classmethod
    def read(cls, path: Path) -> WorldManifest:
        """Read and check a manifest.

        Raises:
            FormatError: If the file is not a manifest, is damaged, has an unsupported version, is a link out of its
                folder, or is inconsistent.
            OSError: If the file cannot be opened.
        """
        inside(path, "", path.parent, path.name)
        fields = parse_object(path, read_whole(path, _MOST_BYTES))
        if fields.raw("format") != FORMAT:
            raise FormatError(path, "format", FORMAT, repr(fields.raw("format"))[:60], "is this a world?")
        version = fields.integer("version", 1, 1 << 30)
        if version > VERSION:
            raise FormatError(path, "version", f"at most {VERSION}", f"{version}", "update gsvis")
        if version < VERSION:
            raise FormatError(path, "version", f"{VERSION}", f"{version}", "prepare the world again")
        value = dict(fields.value)
        digest = value.pop("sha256", None)
        try:
            if digest != _digest(value):
                raise FormatError(path, "sha256", "the hash of the rest", repr(digest)[:20], DAMAGED)
            return _Reader(fields).manifest()
        except RecursionError as error:
            raise FormatError(path, "", "JSON", "objects nested too deeply", DAMAGED) from error


class _Reader:
    """Reads and checks the objects of a manifest."""

    def __init__(self, fields: Fields) -> None:
        self.fields = fields

    def manifest(self) -> WorldManifest:
        """Return the checked manifest."""
        fields = self.fields
        grid = self._grid(fields.child("grid"))
        up = _point(fields, "up")
        if abs(float(np.linalg.norm(up)) - 1.0) > 1e-6:
            raise self._fault("up", "a unit axis", f"{up}")
        meters = fields.number("meters_per_unit")
        if meters < 0.0:
            raise self._fault("meters_per_unit", "a number >= 0", f"{meters}")
        rows = self._rows("tiles")
        more = self._rows("districts")
        if not 1 <= len(rows) <= _MOST_NODES or len(more) > _MOST_NODES:
            raise self._fault("tiles", f"1 to {_MOST_NODES:,} tiles", f"{len(rows):,}")
        districts = tuple(self._district(row, len(rows), k) for k, row in enumerate(more))
        nodes = [tuple[int, ...]((k,)) for k in range(len(rows))] + [district.tiles for district in districts]
        tiles = tuple(self._tile(row, k, grid, nodes) for k, row in enumerate(rows))
        self._check_order(tiles, grid)
        self._check_children(len(tiles), districts)
        self._check_pieces(tiles, districts)
        return WorldManifest(up, meters, grid, tiles, districts, fields.child("provenance").value)

    def _grid(self, fields: Fields) -> Grid:
        """Return the checked grid."""
        axes = _pair(fields, "axes", 0, 2)
        side = fields.number("side")
        if axes[0] >= axes[1]:
            raise FormatError(fields.path, fields.where("axes"), "two axes, ascending", f"{axes}", DAMAGED)
        if side <= 0.0:
            raise FormatError(fields.path, fields.where("side"), "a number > 0", f"{side}", DAMAGED)
        shape = _pair(fields, "shape", 1, _MOST_SQUARES)
        if shape[0] * shape[1] > _MOST_SQUARES:
            raise self._fault("grid.shape", f"at most {_MOST_SQUARES:,} squares", f"{shape}")
        return Grid(_point(fields, "origin"), side, axes, shape)

    def _tile(self, row: Fields, number: int, grid: Grid, nodes: list[tuple[int, ...]]) -> Tile:
        """Return a checked tile; `nodes` are the tiles of each node."""
        coords = _pair(row, "coords", 0, _MOST_SQUARES) if "coords" in row else None
        shape = (1, 1)
        if coords is not None:
            shape = _pair(row, "shape", 1, _MOST_SQUARES)
            if any(first + count > most for first, count, most in zip(coords, shape, grid.shape, strict=True)):
                got = f"{coords} and {shape}"
                raise FormatError(row.path, row.where("coords"), f"squares within {grid.shape}", got, DAMAGED)
        levels = tuple((each.text("name")[:100], each.integer("count", 1, _MOST)) for each in _objects(row, "levels"))
        if not 1 <= len(levels) <= 16:
            raise FormatError(row.path, row.where("levels"), "1 to 16 levels", f"{len(levels)}", DAMAGED)
        beyond = self._beyond(row.child("beyond"), number, nodes) if "beyond" in row else None
        gaussians = row.integer("gaussians", 1, _MOST)
        cells = row.integer("cells", 0, _MOST)
        return Tile(coords, *_box(row), *_package(row), levels, gaussians, cells, beyond, shape)

    def _beyond(self, fields: Fields, number: int, nodes: list[tuple[int, ...]]) -> BeyondTable:
        """Return the checked table of tile `number`; `nodes` are the tiles of each node."""
        pieces = list[Piece]()
        stands = {number: number}  # the node that is used for each tile
        for row in _objects(fields, "pieces"):
            node = row.integer("node", 0, len(nodes) - 1)
            end = 0
            if any(stands.get(tile, node) != node for tile in nodes[node]) or node == number:
                raise FormatError(row.path, row.where("node"), "each tile in one node", f"node {node}", DAMAGED)
            stands |= dict.fromkeys(nodes[node], node)
            runs = []
            for run in row.items("runs"):
                first, count = _pair(Fields(row.path, row.trail, {"runs": run}), "runs", 0, _MOST)
                if first < end or count < 1:
                    raise FormatError(row.path, row.where("runs"), "ascending runs", f"{run}"[:60], DAMAGED)
                end = first + count
                runs.append((first, count))
            pieces.append(Piece(node, row.integer("level", 0, 15), tuple(runs)))
        _check_apart(fields, pieces)
        return BeyondTable(_sha256(fields), fields.integer("bytes", 0, 1 << 50), tuple(pieces))

    def _district(self, row: Fields, tiles: int, number: int) -> District:
        """Return checked district `number` of a world with this number of tiles."""
        members = _numbers(row, "tiles", tiles, "tiles")
        children = _numbers(row, "children", tiles + number, "nodes before it")
        spacing = row.number("spacing")
        count = row.integer("gaussians", 1, _MOST)
        return District(children, members, *_box(row), spacing, *_package(row), count)

    def _check_order(self, tiles: tuple[Tile, ...], grid: Grid) -> None:
        """Raise unless tiles are in order, the outside is last, and no square is in two tiles."""
        squares = [tile.coords for tile in tiles]
        inner = [coords for coords in squares if coords is not None]
        if any(a >= b for a, b in pairwise(inner)):
            before, again = next((a, b) for a, b in pairwise(inner) if a >= b)
            raise self._fault("tiles", "each square once, in order", f"square {again} after {before}")
        if None in squares[:-1]:
            got = f"tile {squares.index(None)} of {len(squares)} without squares"
            raise self._fault("tiles", "the tile without squares as the last one", got)
        taken = np.zeros(grid.shape, bool)
        for tile in tiles:
            if tile.coords is not None:
                (x, y), (width, height) = tile.coords, tile.shape
                if taken[x : x + width, y : y + height].any():
                    raise self._fault("tiles", "each square once", f"square {tile.coords} or one after it twice")
                taken[x : x + width, y : y + height] = True

    def _check_children(self, tiles: int, districts: tuple[District, ...]) -> None:
        """Raise unless each district has the tiles of its children, and no node is a child twice."""
        members: list[tuple[int, ...]] = [(k,) for k in range(tiles)]
        used = set[int]()
        for k, district in enumerate(districts):
            some = sorted(tile for child in district.children for tile in members[child])
            alone = len(district.children) == 1 and district.children[0] < tiles
            if tuple(some) != district.tiles or not (alone or min(district.children) >= tiles):
                raise self._fault(f"districts[{k}].tiles", "those of its children", f"{district.tiles}"[:60])
            if used & set(district.children):
                raise self._fault(f"districts[{k}].children", "each node once", f"{district.children}"[:60])
            used |= set(district.children)
            members.append(district.tiles)

    def _check_pieces(self, tiles: tuple[Tile, ...], districts: tuple[District, ...]) -> None:
        """Raise unless the node of each piece has its level and its ids."""
        sizes = [(len(tile.levels), tile.gaussians) for tile in tiles] + [(1, each.gaussians) for each in districts]
        for k, tile in enumerate(tiles):
            for n, piece in enumerate(() if tile.beyond is None else tile.beyond.pieces):
                (levels, most), where = sizes[piece.node], f"tiles[{k}].beyond.pieces[{n}]"
                if piece.level >= levels:
                    got = f"level {piece.level}"
                    raise self._fault(f"{where}.level", f"one of {levels} levels of node {piece.node}", got)
                if piece.runs and sum(piece.runs[-1]) > most:
                    got = f"an end at {sum(piece.runs[-1]):,}"
                    raise self._fault(f"{where}.runs", f"ids of node {piece.node}, below {most:,}", got)

    def _rows(self, key: str) -> list[Fields]:
        return _objects(self.fields, key)

    def _fault(self, where: str, expected: str, got: str) -> FormatError:
        return FormatError(self.fields.path, where, expected, got, DAMAGED)


def _check_apart(fields: Fields, pieces: list[Piece]) -> None:
    """Raise if an id of a node is in two pieces."""
    for node in {piece.node for piece in pieces}:
        runs = sorted(run for piece in pieces if piece.node == node for run in piece.runs)
        if any(first + count > after for (first, count), (after, _) in pairwise(runs)):
            raise FormatError(fields.path, fields.where("pieces"), "each id once", f"two of node {node}", DAMAGED)


def _tile_as_dict(tile: Tile) -> dict[str, Any]:
    """Return a tile for JSON."""
    beyond = tile.beyond
    return {
        "coords": tile.coords,
        "low": tile.low,
        "high": tile.high,
        "shape": None if tile.coords is None else tile.shape,
        "package": {"sha256": tile.package, "bytes": tile.nbytes},
        "levels": [{"name": name, "count": count} for name, count in tile.levels],
        "gaussians": tile.gaussians,
        "cells": tile.cells,
        "beyond": None
        if beyond is None
        else {
            "sha256": beyond.digest,
            "bytes": beyond.nbytes,
            "pieces": [asdict(piece) for piece in beyond.pieces],
        },
    }


def _district_as_dict(district: District) -> dict[str, Any]:
    """Return a district for JSON."""
    value = asdict(district)
    value["package"] = {"sha256": district.package, "bytes": value.pop("nbytes")}
    return value


def _objects(fields: Fields, key: str) -> list[Fields]:
    """Return the objects of a list."""
    return [Fields(fields.path, f"{fields.where(key)}[{k}]", row) for k, row in enumerate(fields.items(key))]


def _numbers(row: Fields, key: str, end: int, what: str) -> tuple[int, ...]:
    """Return a list of ascending integers in [0, end), at least one; `what` names them in errors."""
    found = row.items(key)
    good = all(isinstance(k, int) and not isinstance(k, bool) and 0 <= k < end for k in found)
    if not found or not good or any(a >= b for a, b in pairwise(found)):
        raise FormatError(
            row.path, row.where(key), f"numbers of {what} below {end}, ascending", f"{found}"[:60], DAMAGED
        )
    return tuple(found)


def _point(fields: Fields, key: str) -> Point:
    """Return three finite numbers."""
    x, y, z = fields.numbers(key, 3).tolist()
    return x, y, z


def _box(row: Fields) -> tuple[Point, Point]:
    """Return the corners `low` and `high` of a box."""
    low = _point(row, "low")
    high = _point(row, "high")
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise FormatError(row.path, row.where("high"), f"a corner above {low}", f"{high}", DAMAGED)
    return low, high


def _pair(fields: Fields, key: str, low: int, high: int) -> tuple[int, int]:
    """Return two integers in [low, high]."""
    found = fields.items(key, 2)
    if not all(isinstance(k, int) and not isinstance(k, bool) and low <= k <= high for k in found):
        raise FormatError(
            fields.path, fields.where(key), f"two integers from {low} to {high}", f"{found}"[:60], DAMAGED
        )
    return found[0], found[1]


def _package(row: Fields) -> tuple[str, int]:
    """Return the hash and the bytes of a package."""
    child = row.child("package")
    return _sha256(child), child.integer("bytes", 0, 1 << 50)


def _sha256(fields: Fields) -> str:
    """Return the field "sha256"."""
    digest = fields.raw("sha256")
    if not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
        raise FormatError(fields.path, fields.where("sha256"), "64 hexadecimal digits", repr(digest)[:80])
    return digest


def _digest(value: dict[str, Any]) -> str:
    """Return the hash of a manifest without its "sha256"."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
