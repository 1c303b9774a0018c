"""`gsvis world`: make a world of tiles from scenes of any size; resume an interrupted run."""

from __future__ import annotations

import os
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsvis._extras import require
from gsvis.cli import version
from gsvis.cli.arguments import World
from gsvis.cli.options import config_of, naming
from gsvis.cli.pvs import check_workers, open_workers
from gsvis.cli.stopping import resumable
from gsvis.cli.terminal import Status, busy_note, clock, facts, least_size_of, print_json, show, size_of
from gsvis.cli.where import check_cameras, evidence_cameras, framed_cameras, parse_up
from gsvis.files.output import check_folder
from gsvis.io.batches import align_batches, facts_of_batches, list_batches, read_batch
from gsvis.io.poses import load_path
from gsvis.io.scenes import check_scene
from gsvis.io.sources import is_builtin, is_levels, title_of
from gsvis.package.made_from import note_paths
from gsvis.package.original import about_files
from gsvis.pvs.config import PvsConfig
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.source import Source
from gsvis.scene.source_frame import SourceFrame

if TYPE_CHECKING:
    from gsvis.scene.cameras import Cameras
    from gsvis.world.config import WorldConfig
    from gsvis.world.estimate import WorldEstimate
    from gsvis.world.prepare import PreparedWorld
    from gsvis.world.stages import WrittenTile

__all__ = ["run_world"]

_HIGHEST = "high"
_LOOKED = 8  # batches by which the frame of cameras is found
_SOME = 100_000  # Gaussians of these
_CLUSTERS = (4, 16, 64, 256)
"""Numbers of workers of which a dry run tells the time."""


def run_world(command: World) -> None:
    """Prepare a world: check, run what is missing, write the folder, print the result."""
    from gsvis.jobs.graph import TOO_LARGE
    from gsvis.world.estimate import estimate_world
    from gsvis.world.prepare import prepare_world
    from gsvis.world.stages import write_tiles

    scenes = _check_scenes(command)
    config = _check_arguments(command)
    config = _in_frame(config, scenes, command.meters_per_unit is None)
    cameras = evidence_cameras(command.where)
    remarks: list[str] = []
    with Status() as status:
        if cameras is not None:
            cameras, remarks = _place_cameras(command, cameras, scenes)
            config = replace(config, cameras=cameras)
        if command.work.dry_run:
            with open_workers(command.work) as workers:
                count = workers.count
            estimate = estimate_world(scenes, config, workers=count, progress=status)
        else:
            about: dict[str, Any] = {
                "made_by": f"gsvis {version()}",
                "scenes": [title_of(path) for path, _ in scenes],
                **(about_files(scenes, command.out) if command.until == "world" else {}),
            }
            work = Path(f"{os.path.abspath(command.out)}.work")
            kept = f"what was finished is kept in {command.work.work or work.name}"
            with (
                resumable(kept),
                open_workers(command.work) as workers,
                naming(max_memory=f"--max-memory; {TOO_LARGE}"),
            ):
                common: dict[str, Any] = {"store": command.work.work, "workers": workers, "progress": status}
                if command.until == "world":
                    made = prepare_world(scenes, command.out, config, about=about, **common)
                else:
                    tiles = write_tiles(scenes, command.out, command.until, config, **common)
            if command.discard:
                shutil.rmtree(work, ignore_errors=True)
            elif command.until == "world":
                note_paths(command.out, [path for path, _ in scenes])
    if command.work.dry_run:
        _print_estimate(command, estimate, remarks)
    elif command.until == "world":
        _print_result(command, made, remarks)
    else:
        _print_tiles(command, tiles)


def _check_scenes(command: World) -> list[tuple[str, int | None]]:
    """Raise unless each scene is there and of a known format; return its path and LOD."""
    if not command.scenes:
        raise ValueError("SCENE: expected at least one scene, got none; gsvis world SCENE [SCENE ...] -o DIR")
    streamed = []
    seen = set[str]()
    for scene in command.scenes:
        if os.path.realpath(scene) in seen:
            raise ValueError(f"SCENE: expected each scene once, got {scene} twice; leave one out")
        seen.add(os.path.realpath(scene))
        if is_builtin(scene) or is_levels(scene):
            raise ValueError(f"SCENE: expected a scene file, got {scene}; write it as a PLY first")
        streamed.append(check_scene(scene))
    lods = command.lod or ()
    if len(lods) not in (0, 1, sum(streamed)) or (lods and not any(streamed)):
        raise ValueError(
            f"--lod: expected one number, or one for each streamed scene, which are {sum(streamed)}, got {len(lods)}"
        )
    left = list(lods * sum(streamed) if len(lods) == 1 else lods)
    return [(path, left.pop(0) if has and left else None) for path, has in zip(command.scenes, streamed, strict=True)]


def _in_frame(config: WorldConfig, scenes: list[tuple[str, int | None]], takes_meters: bool) -> WorldConfig:
    """Return a configuration whose walk is in the frame of the scenes, and with the length of a unit that they state.

    Args:
        config: As the user gave it; the walk may be in the coordinates of the files.
        scenes: Path and level of detail of each.
        takes_meters: Whether the length of a unit is what all scenes state, if they agree.
    """
    stated = SceneFacts.merge(
        [facts_of_batches(batches) for batches in align_batches([list_batches(*s) for s in scenes])]
    )
    if takes_meters:
        config = replace(config, package=replace(config.package, meters_per_unit=stated.meters_per_unit or 0.0))
    if config.walk is None:
        return config
    frame = SourceFrame(np.asarray(stated.origin), np.zeros(3))
    return replace(config, walk=tuple(map(tuple, frame.points(config.walk).tolist())))


def _check_arguments(command: World) -> WorldConfig:
    """Check the arguments before work begins; return the settings of the world."""
    from gsvis.prepare.config import PrepareConfig
    from gsvis.train.levels import LevelsConfig
    from gsvis.world.config import WorldConfig
    from gsvis.world.prepare import check_world_target
    from gsvis.world.stages import check_tiles_target
    from gsvis.world.tiling import TilingConfig

    check_folder(Path(command.out).absolute().parent)
    (check_world_target if command.until == "world" else check_tiles_target)(Path(command.out))
    check_cameras(command.where)
    if command.where.margin is not None and command.where.path is None:
        raise ValueError("--margin: expected --path with it, got none; add it or leave this out")
    check_workers(command.work)
    levels = None
    if command.tiling.levels:
        require("levels: training them", "torch")
        count = len(command.tiling.levels)
        names = ("low", "medium")[:count] if count <= 2 else tuple(f"level{k}" for k in range(count))
        reuse = LevelsConfig.reuse if count == 2 else (0.9,) * count
        with naming(shares="--levels"):
            levels = LevelsConfig(
                command.tiling.levels, reuse, (*names, _HIGHEST), iterations=command.tiling.steps, seed=command.seed
            )
    package = PrepareConfig(
        levels=levels,
        level_views=replace(PrepareConfig.level_views, seed=command.seed),
        cells=command.sets.cells,
        cell_size=command.sets.cell_size,
        sets=config_of(PvsConfig, command.sets, size=command.sets.face_size),
        meters_per_unit=command.meters_per_unit or 0.0,
    )
    up = parse_up(command.where.up)
    direction = None if up is None else (float(up[0]), float(up[1]), float(up[2]))
    config = WorldConfig(
        TilingConfig(command.tiling.tile, up=direction), package, command.tiling.far, command.tiling.angle
    )
    if command.where.path is None:
        return config
    margin = WorldConfig.margin if command.where.margin is None else command.where.margin
    return replace(config, walk=tuple(map(tuple, load_path(command.where.path).positions.tolist())), margin=margin)


def _place_cameras(command: World, cameras: Cameras, scenes: list[tuple[str, int | None]]) -> tuple[Cameras, list[str]]:
    """Return cameras in the frame of the scenes, by some of their Gaussians, and remarks on their frame."""
    batches = [batch for scene in align_batches([list_batches(*each) for each in scenes]) for batch in scene]
    chosen = np.unique(np.linspace(0, len(batches) - 1, min(len(batches), _LOOKED)).astype(int))
    parts = [read_batch(batches[k]) for k in chosen]
    some = Gaussians.concatenate([g[:: max(1, len(g) * len(parts) // _SOME)] for g in parts])
    path = Path(scenes[0][0])
    return framed_cameras(Source(path.name, some, path), cameras, command.where)


def _print_estimate(command: World, estimate: WorldEstimate, remarks: list[str]) -> None:
    """Print what a world would cost."""
    remarks = [each.strip() for each in (*remarks, *estimate.remarks)]
    if command.output.json:
        document = {"format": "gsvis-world-estimate", "version": 2, **asdict(estimate), "remarks": remarks}
        times = {str(count): estimate.seconds_with(count) for count in (estimate.workers, *_more_workers(estimate))}
        print_json(
            {
                **document,
                "core_hours": estimate.core_hours,
                "seconds": estimate.seconds,
                "seconds_by_workers": times,
            }
        )
        return
    workers = "1 worker" if estimate.workers == 1 else f"{estimate.workers} workers"
    rows = [
        ("Gaussians", f"{estimate.gaussians:,}"),
        ("tiles", f"{estimate.tiles:,} of side {estimate.side:.3g}, the fullest {estimate.largest:,}"),
        ("time", f"about {_rough(estimate.seconds)} with {workers}{busy_note(estimate.load)}"),
        ("core hours", f"about {estimate.core_hours:.2g}"),
        ("memory", f"about {size_of(estimate.memory)} a worker"),
        ("--max-memory", f"{least_size_of(estimate.max_memory)} or more"),
        ("world", f"about {size_of(estimate.nbytes)}"),
        ("kept beside it", f"about {size_of(estimate.work_bytes)}"),
        ("how found", _how_found(estimate)),
    ]
    stages = [(name, _rough(seconds)) for name, seconds in estimate.core_seconds.items()]
    more = [
        (f"{count:,} workers", f"about {_rough(estimate.seconds_with(count))}") for count in _more_workers(estimate)
    ]
    tables = [facts(f"{command.out}: what it would cost", rows), facts("on one core", stages)]
    show(*tables, *([facts("on a cluster", more)] if more else []), *_lines(remarks), " Nothing was written.")


def _rough(seconds: float) -> str:
    """Return expected seconds as text, without digits that nobody knows."""
    return f"{round(seconds / 60.0)} min" if 120.0 <= seconds < 3570.0 else clock(seconds)


def _more_workers(estimate: WorldEstimate) -> list[int]:
    """Return numbers of workers of a cluster that save time beside those of the run; the last is the most that do."""
    most = estimate.most_workers
    return [count for count in (*(count for count in _CLUSTERS if count < most), most) if count > estimate.workers]


def _how_found(estimate: WorldEstimate) -> str:
    """Return what the times rest on, and what it took to find them."""
    trial = estimate.trial
    spent = clock(estimate.spent)
    if trial.eyes == 0.0:
        return f"no tile that was tried has room for eyes, so it takes longer if others have; in {spent} of a core"
    eyes = f"about {trial.eyes:.0%} of the tiles have room for eyes"
    return f"times by trying {trial.tiles} of {estimate.tiles:,} tiles, in {spent} of a core; {eyes}"


def _print_tiles(command: World, tiles: list[WrittenTile]) -> None:
    """Print the tiles that were written."""
    count = sum(tile.gaussians for tile in tiles)
    if command.output.json:
        print_json(
            {
                "format": "gsvis-written-tiles",
                "version": 1,
                "folder": command.out,
                "stage": command.until,
                "gaussians": count,
                "tiles": len(tiles),
            }
        )
        return
    of = ", all levels together" if command.until == "levels" else ""
    show(f"{command.out}: {len(tiles):,} tiles, {count:,} Gaussians{of}")


def _lines(remarks: list[str]) -> list[str]:
    """Return remarks as lines of `show`."""
    return [f" {each}" for each in remarks]


def _print_result(command: World, made: PreparedWorld, remarks: list[str]) -> None:
    """Print the world that was made."""
    m = made.manifest
    remarks = [each.strip() for each in (*remarks, *m.provenance["remarks"])]
    cells = sum(tile.cells for tile in m.tiles)
    seconds = sum(result.cpu for result in made.results.values())
    judged = m.provenance["judged"]
    peak = max((result.peak for result in made.results.values()), default=0)
    if command.output.json:
        print_json(
            {
                "format": "gsvis-prepared-world",
                "version": 1,
                "world": command.out,
                "gaussians": m.gaussians,
                "tiles": len(m.tiles),
                "districts": len(m.districts),
                "cells": cells,
                "bytes": made.nbytes,
                "core_seconds": seconds,
                "peak_memory_of_a_worker": peak,
                "judged": judged,
                "remarks": remarks,
            }
        )
        return
    empty = sum(not tile.cells for tile in m.tiles)
    rows = [
        ("Gaussians", f"{m.gaussians:,}, all levels together"),
        ("tiles", f"{len(m.tiles):,}" + (f", {empty} of them without cells" if empty else "")),
        ("districts", f"{len(m.districts):,}"),
        ("cells", f"{cells:,}"),
        ("size", size_of(made.nbytes)),
        ("time of processors", clock(seconds)),
        ("memory", f"at most {size_of(peak)} a worker"),
    ]
    if judged is not None:
        rows.append(("checked by other eyes", judged["line"]))
    if judged is not None and judged["warning"]:
        remarks = [*remarks, judged["warning"]]
    show(facts(command.out, rows), *_lines(remarks))
