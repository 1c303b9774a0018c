"""Prepare the levels of a scene for looks and certificates: in memory, one at a time, or once for several processes.

Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gsvis.files.mapped import MappedArrays
from gsvis.files.shelf import Shelf, Shelved, shelve
from gsvis.progress import Progress, silent
from gsvis.pvs.certificate import Certifier
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.look import Look
from gsvis.scene.core import find_core
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = ["PreparedLevel", "PreparedLevels"]

_Thing = TypeVar("_Thing")

_LARGE = 64 << 20  # bytes of the file of a level from which its memory is given back
_SOME = 20_000  # Gaussians that tell in which directions a scene lies


@dataclass(frozen=True, eq=False)
class PreparedLevel:
    """A level of a scene.

    Attributes:
        ids: (n,) int64, its Gaussians in the union of levels, ascending.
        look: Finds the Gaussians that viewpoints see.
        certifier: Its tracer, and its solid parts.
        core: (P, 3) centers of a sample of Gaussians without outliers; (0, 3) in a level without outliers.
    """

    ids: NDArray[np.int64]
    look: Look
    certifier: Certifier
    core: NDArray[np.float32]


class PreparedLevels:
    """The levels of a scene, each prepared on first use.

    Args:
        levels: The levels.
        config: How visible sets are found.
        folder: Folder for what is prepared, so that memory holds one level at a time; None keeps all in memory.
        made: What `shelve` made of the same levels, maybe in another process; empty to prepare them here.
    """

    def __init__(
        self,
        levels: Levels,
        config: PvsConfig,
        folder: Path | None = None,
        made: Sequence[Shelved[PreparedLevel]] = (),
    ) -> None:
        self._levels = levels
        self._config = config
        self._made = made
        self._files: dict[int, MappedArrays] = {}
        self._ready: dict[int, PreparedLevel] = {}
        self._shelf = None if folder is None or len(levels) == 1 else Shelf(folder)
        self._held: int | None = None  # the level asked for last

    def __getitem__(self, level: int) -> PreparedLevel:
        """Return a level; with a folder, release the memory of the level before."""
        if self._shelf is not None and self._held != level:
            self._shelf.release()
        self._held = level
        if level not in self._ready:
            self._ready[level] = self._prepare(level)
        return self._ready[level]

    def rest(self, level: int) -> None:
        """Give back the memory of a large level that `shelve` made; its next use reads the file again."""
        file = self._files.get(level)
        if file is not None and file.nbytes >= _LARGE:
            file.release()

    def shelve(self, folder: Path, progress: Progress = silent) -> tuple[Shelved[PreparedLevel], ...]:
        """Write all levels to files of a folder, which processes share; memory holds one level at a time.

        Args:
            folder: The folder.
            progress: Called with stage "structure", in levels.

        Raises:
            OutputError: If a file cannot be written.
        """
        shelved = []
        for level in range(len(self._levels)):
            progress("structure", level, len(self._levels))
            prepared = self._prepare(level)
            _ = prepared.certifier.tracer.hierarchy  # it is to lie in the file too
            shelved.append(shelve(prepared, folder / f"level_{level}.arrays"))
        progress("structure", len(self._levels), len(self._levels))
        return tuple(shelved)

    def _prepare(self, level: int) -> PreparedLevel:
        """Return a prepared level."""
        from gsvis.raycast import EllipsoidProxies, Tracer

        if self._made:
            self._files[level] = MappedArrays(self._made[level].path)
            return self._made[level].over(self._files[level])
        ids = np.flatnonzero(self._levels.member(level))
        union = self._levels.union
        look = self._keep(
            Look(
                union if len(ids) == len(union) else union[ids],
                self._config.method,
                self._config.size,
                self._config.tau,
            )
        )
        tracer = Tracer.named(self._config.tracer, EllipsoidProxies.from_scene(look.gaussians))
        if self._shelf is not None:
            _ = tracer.hierarchy  # it is to lie on the shelf too
        return PreparedLevel(ids, look, self._keep(Certifier(tracer)), _core_of(look.gaussians))

    def _keep(self, thing: _Thing) -> _Thing:
        return thing if self._shelf is None else self._shelf.put(thing)


def _core_of(g: Gaussians) -> NDArray[np.float32]:
    """Return (P, 3) centers of a sample of Gaussians without outliers; (0, 3) if there are no outliers."""
    members = find_core(g).members
    if members.all():
        return np.zeros((0, 3), np.float32)
    centers = g.means[members]
    return centers[:: -(-len(centers) // _SOME)]
