"""An open world: the packages of its tiles and districts, opened on request. Scene frame and units.

A single package is a world of one tile.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.limits import DAMAGED, digest_of
from gsvis.package import Package
from gsvis.package.manifest import MANIFEST, Manifest
from gsvis.progress import Progress, silent
from gsvis.world.beyond import Beyond
from gsvis.world.manifest import WORLD, Grid, Tile, WorldManifest

__all__ = ["BEYOND", "PACKAGES", "VerifiedWorld", "World", "is_world", "tile_of_package"]

PACKAGES = "packages"
BEYOND = "beyond"
"""Names of the folders of packages and of tables."""

_REMEDY = "prepare the world again"


@dataclass(frozen=True)
class VerifiedWorld:
    """The result of `World.verify`.

    Attributes:
        tiles: Number of tiles.
        districts: Number of districts.
        gaussians: Gaussians of all tiles, all levels together.
        cells: Cells of all tiles.
        nbytes: Bytes of packages, tables and manifest.
        strays: Number of packages and tables that the manifest does not name.
    """

    tiles: int
    districts: int
    gaussians: int
    cells: int
    nbytes: int
    strays: int


def is_world(path: str | PathLike[str]) -> bool:
    """Return whether a folder is a world."""
    return (Path(path) / WORLD).is_file()


def tile_of_package(folder: Path, manifest: Manifest, **place: object) -> Tile:
    """Return the entry of a tile in the manifest, from its package.

    Args:
        folder: Folder of the package.
        manifest: Its manifest.
        **place: `coords`, `low`, `high`, `cells` and `beyond` of the tile.
    """
    nbytes = sum(part.nbytes for part in {part.name: part for part in manifest.parts()}.values())
    return Tile(
        package=digest_of(folder / MANIFEST),
        nbytes=nbytes + (folder / MANIFEST).stat().st_size,
        levels=tuple(zip(manifest.names, manifest.counts, strict=True)),
        gaussians=manifest.gaussians,
        **place,  # type: ignore[arg-type]
    )


class World:
    """An open world, from `World.open`.

    Attributes:
        path: The folder.
        manifest: The parsed manifest.
        alone: Whether this is a single package: a world of one tile.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        """Read the manifest; see `open`."""
        self.path = _check.path("path", path)
        self.alone = not is_world(self.path) and (self.path / MANIFEST).is_file()
        if self.path.is_dir() and not self.alone and not is_world(self.path):
            expected = f"a world with a {WORLD}, or a package with a {MANIFEST}"
            raise FormatError(self.path, "", expected, "a folder with neither", "was its preparation stopped?")
        self.manifest = self._manifest_of_package() if self.alone else WorldManifest.read(self.path / WORLD)

    @classmethod
    def open(cls, path: str | PathLike[str]) -> World:
        """Open a world, or a package as a world of one tile. Reads only manifests.

        Args:
            path: Folder of the world or of the package.

        Raises:
            FormatError: If the folder is neither, or the manifest is damaged or has an unsupported version.
            OSError: If the manifest cannot be opened.
        """
        return cls(path)

    def __len__(self) -> int:
        """Number of nodes: tiles and districts."""
        return len(self.manifest)

    def __repr__(self) -> str:
        m = self.manifest
        return f"World({m.gaussians:,} Gaussians, {len(m.tiles)} tiles, {len(m.districts)} districts, {self.path.name})"

    def tile_at(self, position: ArrayLike) -> int:
        """Return the tile whose squares contain a position (3,); -1 for no tile."""
        point = _check.floats("position", position, (3,), np.float64)
        return 0 if self.alone else int(self.manifest.tiles_at(point[None])[0])

    def package_path(self, node: int) -> Path:
        """Return the folder of the package of a node.

        Raises:
            ValueError: If there is no such node.
        """
        return self.path if self.alone else self.path / PACKAGES / self.manifest.node(node).package

    def package(self, node: int) -> Package:
        """Open the package of a node; the caller closes it.

        Raises:
            ValueError: If there is no such node.
            FormatError: If the package is missing or damaged, has an unsupported version, or is not the one in the
                manifest.
        """
        expected = self.manifest.node(node)
        folder = self.package_path(node)
        where = f"node {node}"
        if not (folder / MANIFEST).is_file():
            raise FormatError(self.path, where, f"a package in {folder.name[:12]}...", "no such package", _REMEDY)
        if not self.alone and (found := digest_of(folder / MANIFEST)) != expected.package:
            name = f"content with the hash {expected.package[:12]}..., the name of the folder"
            raise FormatError(folder / MANIFEST, "", name, f"{found[:12]}...", DAMAGED)
        package = Package.open(folder)
        if package.manifest.gaussians != expected.gaussians:
            got = f"{package.manifest.gaussians:,}"
            raise FormatError(self.path, where, f"{expected.gaussians:,} Gaussians", got, _REMEDY)
        return package

    def beyond(self, tile: int) -> Beyond | None:
        """Open the table of what the cells of a tile see outside it; None if there is none. The caller closes it.

        Raises:
            ValueError: If there is no such tile.
            FormatError: If the table is missing or damaged.
        """
        found = self.manifest.node(tile)
        if not isinstance(found, Tile) or found.beyond is None:
            return None
        return Beyond(self.path / BEYOND / found.beyond.name, found.beyond)

    def verify(self, *, progress: Progress = silent) -> VerifiedWorld:
        """Read, check and decode every package and every table; one package is in memory at a time.

        Args:
            progress: Called with stage "verify", in nodes.

        Raises:
            FormatError: If anything is damaged or missing; the error names the first damaged place.
        """
        m = self.manifest
        nbytes = 0
        progress("verify", 0, len(self))
        for node in range(len(self)):
            with self.package(node) as package:
                found = package.verify()
            nbytes += found.nbytes
            entry = m.node(node)
            if isinstance(entry, Tile) and found.cells != entry.cells:
                raise FormatError(self.path, f"node {node}", f"{entry.cells:,} cells", f"{found.cells:,}", _REMEDY)
            table = self.beyond(node)
            if table is not None:
                try:
                    table.verify()
                    if len(table) != found.cells:
                        got = f"{len(table):,}"
                        raise FormatError(table.store.path, "cells", f"{found.cells:,} of the tile", got, _REMEDY)
                    nbytes += table.table.nbytes
                finally:
                    table.close()
            progress("verify", node + 1, len(self))
        size = 0 if self.alone else (self.path / WORLD).stat().st_size
        cells = sum(tile.cells for tile in m.tiles)
        return VerifiedWorld(len(m.tiles), len(m.districts), m.gaussians, cells, nbytes + size, len(self.strays()))

    def strays(self) -> list[Path]:
        """Return the packages and tables in the folder that the manifest does not name."""
        if self.alone:
            return []
        m = self.manifest
        known = {
            PACKAGES: {m.node(k).package for k in range(len(m))},
            BEYOND: {tile.beyond.name for tile in m.tiles if tile.beyond is not None},
        }
        folders = [(self.path / name, names) for name, names in known.items() if (self.path / name).is_dir()]
        return [path for folder, names in folders for path in sorted(folder.iterdir()) if path.name not in names]

    def _manifest_of_package(self) -> WorldManifest:
        """Return the manifest of a world whose one tile is this package and covers all space."""
        with Package.open(self.path) as package:
            m = package.manifest
            cells = len(package.visibility) if m.visibility is not None else 0
        everywhere = 1e30
        low = (-everywhere,) * 3
        high = (everywhere,) * 3
        tile = tile_of_package(self.path, m, coords=(0, 0), low=low, high=high, cells=cells)
        grid = Grid((-everywhere,) * 3, 2.0 * everywhere, (0, 1), (1, 1))
        return WorldManifest(m.info.up, m.info.meters_per_unit, grid, (tile,))
