"""A small build of visible sets, and progress that stops it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsvis.jobs.workers import Workers
from gsvis.progress import Progress, silent
from gsvis.pvs.build import build_pvs, journal_of
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["CONFIG", "Job", "Stop"]

CONFIG = PvsConfig(size=16, limit=0.05, rays=128, max_inner=2)
"""Small, and cells are done after different numbers of viewpoints."""


@dataclass(frozen=True, eq=False)
class Job:
    """A scene to be looked at, and the bytes of its store."""

    scene: Gaussians
    grid: CellGrid
    space: NavigableSpace
    wanted: bytes

    @property
    def shared(self) -> SharedViewpoints:
        return SharedViewpoints(CellViewpoints(self.grid, self.space))

    def run(
        self, path: Path, config: PvsConfig = CONFIG, *, workers: Workers | None = None, progress: Progress = silent
    ) -> bytes:
        build_pvs(self.scene, self.grid, self.space, path, config, workers=workers, progress=progress).close()
        return path.read_bytes()

    def journal(self, path: Path, config: PvsConfig = CONFIG) -> Path:
        return journal_of(self.scene, self.grid, self.space, path, config)


class Stop:
    """A progress callback that ends the build after so many steps of a stage, and remembers where it began."""

    def __init__(self, after: int, stage: str = "cells", error: type[BaseException] = KeyboardInterrupt) -> None:
        self.after, self.stage, self.error, self.calls = after, stage, error, []

    def __call__(self, stage: str, done: int, total: int) -> None:
        self.calls.append((stage, done))
        if stage == self.stage and done >= self.after:
            raise self.error
