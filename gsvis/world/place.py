"""Open a world for simulated visits: the full scene is the highest level of its tiles, and walks are in its cells.

All records are read; visible sets are read tile by tile, as by a server. Scene frame and units.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.files.temporary import temporary_folder
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.source_frame import SourceFrame
from gsvis.simulate.visits import AS_IS, Place, judged_in
from gsvis.stream.kept import open_kept
from gsvis.world.cells import WorldCells
from gsvis.world.streamed import WorldSource
from gsvis.world.world import World

__all__ = ["open_place"]

F64 = NDArray[np.float64]

_UPRIGHT = np.cos(np.radians(1.0))  # least cosine between the up axes of a walk and a world that agree
_ENOUGH = 0.99  # share of a walk's positions in cells, from which the walk belongs to the world
_RESOLUTION = 256  # voxels along the space in which a walk is placed


def open_place(
    path: str | os.PathLike[str],
    walk: HeadPath,
    *,
    reference: Gaussians | None = None,
    whole_file: str | os.PathLike[str] | None = None,
    as_is: bool = False,
    terms: str = "pose",
    seed: int = 0,
) -> Place:
    """Prepare a world for simulated visits.

    A walk inside the cells stays where it is. Any other walk is moved into the cells of a tile, drawn with the seed,
    and of the tiles within its width around it.

    Args:
        path: Folder of the world.
        walk: The walk.
        reference: The source scenes; None compares with the highest level of all tiles.
        whole_file: A file or folder with the scenes, for its size; None measures the highest level as SOG.
        as_is: Whether to leave walks unchanged.
        terms: Which terms are sent: one of `gsvis.stream.scene.TERMS`.
        seed: Seed that draws the tile for a walk.

    Raises:
        GsvisError: If a tile or a district cannot be read.
        SceneError: If no tile has cells, or there is no space for eyes in those around the drawn tile.
        ArgumentError: If the whole file is empty.
        OSError: If a file cannot be read.
    """
    source = WorldSource.open(path, strict=True)
    with temporary_folder() as folder:  # a mapped file stays readable after it is deleted
        scene, _ = open_kept(source, folder)
    scene = scene.sending(terms)
    contents = scene.contents
    highest = np.zeros(len(contents), bool)
    tiles = source.tiles
    for node in tiles:  # not districts: they only repeat the content of tiles
        some = slice(*source.bases[node : node + 2].tolist())
        highest[some] = contents.last[some] == len(contents.names) - 1
    cells, _ = source.read_cells()
    origin = np.asarray(source.manifest.info.facts.origin)
    walk = SourceFrame(origin, np.median(cells.centers, axis=0)).walk(walk)
    space = None if as_is or _lies_in(walk, cells) else partial(_find_space, world=source.world, cells=cells, seed=seed)
    return Place.prepare(
        scene,
        contents,
        highest,
        space,
        reference=reference,
        whole_file=whole_file,
        whole=f"all {len(tiles):,} tiles of the world" if len(tiles) > 1 else "the one tile of the world",
        facts={
            "tiles": len(tiles),
            "districts": len(source.nodes) - len(tiles),
            **judged_in(source.world.manifest.provenance),
        },
    )


def _lies_in(walk: HeadPath, cells: WorldCells) -> bool:
    """Return whether a walk is upright in a world and inside its cells."""
    inside = cells.cell_at(walk.positions) >= 0
    return bool(walk.upright @ cells.up >= _UPRIGHT and inside.mean() >= _ENOUGH)


def _find_space(full: Gaussians, world: World, cells: WorldCells, seed: int) -> NavigableSpace:
    """Return the space for eyes in the cells of a tile, which the seed draws, and in those around it."""
    m = world.manifest
    tile = int(np.random.default_rng(seed).choice(cells.tiles))  # in proportion to its cells
    low, high = (np.array(corner, np.float64) for corner in (m.tiles[tile].low, m.tiles[tile].high))
    flat = np.isin(np.arange(3), m.grid.axes)
    margin = float((high - low)[flat].max())

    def near(points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return whether each point (M, 3) is within the margin of the tile."""
        return np.asarray(((points >= low - margin) & (points <= high + margin))[:, flat].all(axis=1))

    around = full[near(full.means)]
    some = near(cells.centers)
    own = {name: getattr(cells, name)[some] for name in ("centers", "sizes", "tiles", "places", "boxes")}
    mine = replace(cells, **own)
    for mixed in (True, False):  # an object is neither rooms nor ground
        with suppress(SceneError):
            found = NavigableSpace.from_scene(around, resolution=_RESOLUTION, up=cells.up, mixed=mixed)
            voxels = np.argwhere(found.free)
            held = mine.cell_at(found.origin + found.voxel_size * (voxels + 0.5)) >= 0
            free = np.zeros_like(found.free)
            free[tuple(voxels[held].T)] = True
            return replace(found, free=free, rule=f"{found.rule}, in cells")
    raise SceneError(f"{world.path}: no space for eyes in the cells around tile {tile}; {AS_IS}, or change --seed")
