"""Stop the preparation of a world early: write its tiles as PLYs, or their levels as folders, for other tools.

The tasks are those of the world, and their results stay beside the folder, so `prepare_world` to the same folder
resumes from there. Visible sets and fitted colors are not written: they exist only in packages.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.temporary import temporary_folder
from gsvis.io.levels import MAP, save_levels
from gsvis.io.ply import save_ply
from gsvis.jobs.objects import open_store
from gsvis.jobs.work_folder import WorkFolder
from gsvis.jobs.workers import Workers
from gsvis.progress import Progress, silent
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.rows import load_gaussians, load_tile_levels
from gsvis.world.tiling import OUTSIDE, tile_name

__all__ = ["INDEX", "STAGES", "WrittenTile", "check_tiles_target", "write_tiles"]

INDEX = "tiles.json"
"""Name of the list of the tiles in their folder."""

Stage = Literal["tiles", "levels"]
STAGES: tuple[Stage, ...] = ("tiles", "levels")
"""Stages after which a preparation can stop."""

_FORMAT = "gsvis-tiles"
_TILE = re.compile(rf"tile-(\d+-\d+|{OUTSIDE})")


@dataclass(frozen=True)
class WrittenTile:
    """A tile on disk.

    Attributes:
        file: Name of its PLY or of its folder of levels.
        gaussians: Gaussians of all its levels together.
        levels: Names and sizes of its levels, lowest first; empty for a PLY.
        low: (3,) lowest corner of its rectangle, without the axis that is not cut; empty for the outside.
        high: (3,) highest corner.
    """

    file: str
    gaussians: int
    levels: tuple[tuple[str, int], ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


def write_tiles(
    scenes: Sequence[tuple[str, int | None]],
    out: str | os.PathLike[str],
    until: Stage,
    config: WorldConfig | None = None,
    *,
    store: str | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> list[WrittenTile]:
    """Write the tiles of scenes, or their levels, or resume an earlier run; the outside is the last tile.

    Tiles of an earlier run with different options are removed.

    With more than one worker, a script that calls this needs an `if __name__ == "__main__":` guard.

    Args:
        scenes: As for `prepare_world`.
        out: Folder for a PLY or a folder of levels for each tile, and `tiles.json`. Results of tasks are kept beside
            it.
        until: "tiles" or "levels".
        config: Options; None means `WorldConfig()`.
        store: As for `prepare_world`.
        workers: As for `prepare_world`.
        progress: Called with stages "sampling", "splitting", "tiles" or "levels", and "writing".

    Raises:
        SceneError: If the scenes have no visible Gaussian.
        FormatError: If a scene is damaged, or the folder has other files.
        ValueError: If a tile does not fit the memory of a worker, or a second process writes to the same folder.
        OSError: If a file cannot be written; finished work is kept.
    """
    _check.one_of("until", until, STAGES)
    target = _check.path("out", out)
    config = config or WorldConfig()
    check_tiles_target(target)
    work = WorkFolder(target)
    with work.opened():
        found = open_store(store or work.folder)
        build = WorldBuild(
            [(os.path.abspath(path), lod) for path, lod in scenes], config, found, workers or Workers(), progress
        )
        results = build.rows if until == "tiles" else build.levels
        target.mkdir(parents=True, exist_ok=True)
        written = []
        progress("writing", 0, len(build.tiles))
        for k in range(len(build.tiles)):
            written.append(_write(build, k, until, results, target))
            progress("writing", k + 1, len(build.tiles))
        about = {"format": _FORMAT, "version": 1, "stage": until, "up": build.grid["up"]}
        rows = [{**each.__dict__, "levels": dict(each.levels)} for each in written]
        with atomic_path(target / INDEX) as partial:
            partial.write_text(json.dumps({**about, "tiles": rows}, indent=1) + "\n", encoding="utf-8")
        _remove_others(target, until, {each.file for each in written})
    return written


def check_tiles_target(target: Path) -> None:
    """Check that tiles may be written to a folder: a new or empty one, or one of an earlier run.

    Raises:
        FormatError: If the path is a file, or a folder with other files.
    """
    if target.exists() and not target.is_dir():
        raise FormatError(target, "", "a folder, or nothing", "a file", "choose another name")
    others = [] if not target.is_dir() else [path.name for path in target.iterdir() if not path.name.startswith("tile")]
    if others:
        raise FormatError(target, "", "tiles or an empty folder", f"{min(others)!r}", "choose another name")


def _remove_others(target: Path, until: Stage, kept: set[str]) -> None:
    """Remove the tiles in a folder that are of this stage and not in `kept`."""
    for path in target.iterdir():
        if path.name in kept:
            continue
        if until == "tiles" and path.suffix == ".ply" and _TILE.fullmatch(path.stem):
            path.unlink()
        elif until == "levels" and _TILE.fullmatch(path.name) and (path / MAP).is_file():
            shutil.rmtree(path)


def _write(build: WorldBuild, number: int, until: Stage, results: dict[str, Any], target: Path) -> WrittenTile:
    """Write a tile as a PLY, or as a folder of levels."""
    rect = build.tiles[number]
    square = None if rect is None else build.square_of(rect)
    corners = ((), ()) if square is None else (tuple(square["low"]), tuple(square["high"]))
    result = results[f"{'rows' if until == 'tiles' else 'levels'} {number}"]
    name = f"tile-{tile_name(rect)}"
    with temporary_folder() as cache:
        if until == "tiles":
            save_ply(load_gaussians(build.store.path_of(result.files["rows"], cache)), target / f"{name}.ply")
            return WrittenTile(f"{name}.ply", result.facts["gaussians"], (), *corners)
        levels = load_tile_levels(build.store.path_of(result.files["levels"], cache))
        save_levels(levels, target / name, {"up": build.grid["up"]})
    sizes = tuple(zip(levels.names, levels.counts, strict=True))
    return WrittenTile(name, len(levels.union), sizes, *corners)
