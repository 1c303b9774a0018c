"""The stage of the visible sets: those of the cells, and those that the package gets."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path

from gsvis.files.limits import read_whole
from gsvis.jobs.work_folder import digest_of_folder
from gsvis.jobs.workers import Workers
from gsvis.prepare.memory import left_for_sets
from gsvis.prepare.stages import Stages, hash_levels
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.joined import JoinedCells, join_until_small
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.levels import Levels

__all__ = ["around_of", "find_shipped_sets", "name_sets", "run_sets", "shares_in_runs", "ship_sets"]


def name_sets(stages: Stages, levels: Levels, grid: CellGrid) -> str:
    """Return the name of the file of visible sets."""
    cells = {**grid.as_dict(), "coords": hashlib.sha256(grid.coords.astype("<i4").tobytes()).hexdigest()}
    space = stages.space_hash
    config = stages.config.sets.as_dict()
    around = {} if stages.around is None else {"around": stages.around.digest}
    return (
        f"sets-{stages.key('sets', levels=hash_levels(levels), grid=cells, space=space, config=config, **around)}.pvs"
    )


def run_sets(stages: Stages, levels: Levels, workers: Workers | None) -> Path:
    """Return the path of the store of visible sets."""
    grid = stages.grid
    name = name_sets(stages, levels, grid)
    with stages.stage("sets") as done:
        if not stages.work.whole(name) or not (stages.around is None or stages.work.whole(around_of(name))):
            done.append(True)
            left = left_for_sets(workers, levels, len(levels.union), stages.config.sets)
            _find_sets(stages, levels, grid, name, left)
    return stages.work.at(name)


def _find_sets(stages: Stages, levels: Levels, grid: CellGrid, name: str, workers: Workers | None) -> None:
    """Write the store of visible sets, and that of the surroundings."""
    path = stages.work.at(name)
    around = stages.around

    def build(seen: Levels, target: Path) -> VisibilityStore:
        """Build the visible sets of some levels."""
        return build_pvs(
            seen,
            grid,
            stages.space,
            target,
            stages.config.sets,
            workers=workers,
            one_level=stages.one_level,
            progress=stages.progress,
        )

    if around is None:
        build(levels, path).close()
    else:
        both = stages.work.at(f"joint-{name}")
        joint = around.joined(levels)
        around = stages.around = replace(around, gaussians=joint.union[len(levels.union) :])  # the same, once
        with build(joint, both) as store:
            around.split(store, levels, path, stages.work.at(around_of(name)), progress=stages.progress)
        stages.work.seal_file(around_of(name))
        both.unlink(missing_ok=True)
    stages.work.seal_file(name)


def ship_sets(stages: Stages, store: VisibilityStore) -> Path:
    """Return the path of the store that the package gets: shared direction sets, and joined cells if asked for.

    The store of a tile stays as it is: its surroundings have the same cells.
    """
    path = find_shipped_sets(stages, store.path)
    if path == store.path:
        return path
    record = stages.work.at(path.with_suffix(".json").name)
    if not stages.work.whole(path.name) or not stages.work.whole(record.name):
        tried = join_until_small(
            store, path, may_join=stages.config.join_cells, in_runs=shares_in_runs(stages), progress=stages.progress
        )
        stages.work.seal_file(path.name)
        stages.keep(record.name, [asdict(each) for each in tried])
    stages.joined = tuple(JoinedCells(**each) for each in json.loads(read_whole(record)))
    return path


def find_shipped_sets(stages: Stages, sets: Path) -> Path:
    """Return the path of the store that the package gets, from that of the visible sets."""
    if stages.around is not None or stages.one_level:
        return sets
    join = stages.config.join_cells
    key = stages.key("joined", sets=digest_of_folder(sets).split()[0], join=join, in_runs=shares_in_runs(stages))
    return stages.work.at(f"joined-{key}.pvs")


def shares_in_runs(stages: Stages) -> bool:
    """Return whether runs of Gaussians share how their classes change: around an object (docs/design/162)."""
    return stages.space.kind.kind == "object"


def around_of(sets: str) -> str:
    """Return the name of the store of the surroundings' visible sets, from the name of the visible sets."""
    return f"around-{sets}"
