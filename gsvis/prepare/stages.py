"""What the stages from a scene to a package share: scene, options, working folder, records of what ran.

Each stage makes one piece in the working folder, or reuses it from there. The name of a piece is a hash of its inputs'
content and of its options, never of a path or a date. Each result is read back from its file, so a resumed run gives
the same bytes as an uninterrupted one. The stages themselves are in `stage_levels.py`, `stage_sets.py`,
`stage_colors.py`, `stage_records.py` and `stage_quality.py`; their order is in `prepare.py`.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from gsvis.files.atomic import atomic_path
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import read_whole
from gsvis.files.mapped import release_mapped
from gsvis.files.shelf import LARGE, Shelf
from gsvis.jobs.freed_memory import release_freed_memory
from gsvis.jobs.work_folder import WorkFolder, digest_of_folder
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.surroundings import Surroundings
from gsvis.progress import Progress
from gsvis.pvs.cell_count import FEWER_CELLS, MOST_CELLS, fitting_cells
from gsvis.pvs.cells import MAX_CELLS, CellGrid
from gsvis.pvs.joined import JoinedCells
from gsvis.render.judges import JUDGES
from gsvis.scene.content import scene_hash, space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace

__all__ = ["VERSIONS", "StageRecord", "Stages", "hash_levels"]

_Thing = TypeVar("_Thing")

VERSIONS = {
    "levels": 12,
    "sets": 7,
    "joined": 6,
    "colors": 10,
    "epsilon": 1,
    "rounding": 2,
    "cost": 2,
    "fidelity": 3,
    "judged": 3,
    "overdraw": 1,
    "terms": 1,
}
"""Version of the results of each stage; increase it when they change."""


@dataclass(frozen=True)
class StageRecord:
    """The record of a stage in this run.

    Attributes:
        name: "levels", "sets", "colors", "epsilon" if it has to be found, "rounding" if records are rounded, "cost",
            "fidelity", "terms" if they are stored, or "package".
        reused: Whether the whole result existed already.
        seconds: Time that it took in this run.
    """

    name: str
    reused: bool
    seconds: float


@dataclass(eq=False)
class Stages:
    """A scene, the options of its package, and the stages between them.

    Attributes:
        scene: The scene or levels, as given.
        space: The navigable space.
        config: The options.
        photos: Photos to train levels and learn colors on; None trains levels on renders of the scene.
        work: The folder that keeps the pieces.
        progress: Called with the progress stages of the functions that run.
        records: Records of the stages so far.
        remarks: Sentences that the user should read.
        around: Gaussians around the scene that belong to other packages; None for none.
        reach: Least and largest value of each component of base colors of all these packages; None for this one's own.
        one_level: Whether sets are found with one level in memory; see `build_pvs`.
        judges: Largest number of views by each rule that judge the sets.
        joined: Sizes of cells that were tried for the package; empty for a tile.
    """

    scene: Gaussians | Levels
    space: NavigableSpace
    config: PrepareConfig
    photos: str | os.PathLike[str] | None
    work: WorkFolder
    progress: Progress
    records: list[StageRecord]
    remarks: list[str]
    around: Surroundings | None = None
    reach: tuple[tuple[float, float], ...] | None = None
    one_level: bool = False
    judges: int = JUDGES
    joined: tuple[JoinedCells, ...] = ()

    @property
    def trains(self) -> bool:
        """Whether levels must be trained."""
        return not isinstance(self.scene, Levels) and self.config.levels is not None

    @property
    def highest(self) -> Gaussians:
        """The scene as given, or its highest level."""
        return self.scene.level(len(self.scene) - 1) if isinstance(self.scene, Levels) else self.scene

    @cached_property
    def grid(self) -> CellGrid:
        """The cells."""
        size = self.config.cell_size
        if size is not None:
            return CellGrid.over(self.space, max_cells=MAX_CELLS, cell_size=size)
        most = self.config.cells or fitting_cells(self.highest, self.space, MOST_CELLS, FEWER_CELLS)
        return CellGrid.over(self.space, max_cells=most, cell_size=None)

    @cached_property
    def scene_hash(self) -> str:
        """Hash of the scene as given, or of its highest level."""
        return scene_hash(self.highest)

    @cached_property
    def space_hash(self) -> str:
        """Hash of the navigable space, which is in the names of most pieces."""
        return space_hash(self.space)

    @cached_property
    def photos_hash(self) -> str | None:
        """Hash of the photos; None without them."""
        return None if self.photos is None else digest_of_folder(self.photos)

    def key(self, stage: str, **decides: Any) -> str:
        """Return what names a piece of a stage: a hash of the stage's version and of what decides its result."""
        return self.work.key(stage, {"version": VERSIONS[stage], **decides})

    def keep(self, name: str, value: Any) -> None:
        """Write a piece of JSON to the working folder."""
        with atomic_path(self.work.at(name)) as partial:
            partial.write_text(json.dumps(value), encoding="ascii")
        self.work.seal_file(name)

    def read(self, name: str) -> Fields:
        """Return a piece of JSON from the working folder."""
        path = self.work.at(name)
        return parse_object(path, read_whole(path))

    @contextmanager
    def stage(self, name: str) -> Iterator[list[bool]]:
        """Record a stage. Yields a list; the caller appends to it if the stage had work to do."""
        began = time.perf_counter()
        done = list[bool]()
        yield done
        self.rest()
        self.records.append(StageRecord(name, not done, time.perf_counter() - began))

    def shelve(self, levels: Levels) -> Levels:
        """Return levels; the arrays of large ones lie in a file of the working folder, and leave memory on `rest`."""
        if levels.union.nbytes < LARGE:
            return levels
        kept = self._shelf.put(levels)
        scene_hash(kept.union)  # reads all of it, once
        self.rest()
        return kept

    @property
    def is_large(self) -> bool:
        """Whether large objects of this preparation lie in files."""
        whole = self.scene.union if isinstance(self.scene, Levels) else self.scene
        return whole.nbytes >= LARGE

    @property
    def scratch_folder(self) -> Path | None:
        """Folder for arrays that change; None keeps them in memory, as a small scene's."""
        return self.work.folder / "shelf" if self.is_large else None

    def lay_away(self, thing: _Thing) -> _Thing:
        """Return colors or records; those of a large scene lie in a file, and leave memory on `rest`."""
        if not self.is_large:
            return thing
        kept = self._shelf.put(thing)
        self.rest()
        return kept

    @cached_property
    def _shelf(self) -> Shelf:
        """The files of large objects, which `WorkFolder.clear` removes at the end."""
        return Shelf(self.work.folder / "shelf")

    def rest(self) -> None:
        """Give back memory between two pieces of work: what was freed, and what can be read again."""
        self._shelf.release()
        if isinstance(self.scene, Gaussians):
            release_mapped(vars(self.scene).values())
        release_freed_memory()


def hash_levels(levels: Levels) -> dict[str, Any]:
    """Return what identifies levels: hashes of Gaussians and membership, and names."""
    member = hashlib.sha256(levels.first.tobytes() + levels.last.tobytes()).hexdigest()
    return {"scene": scene_hash(levels.union), "names": list(levels.names), "member": member}
