"""Which classes the visible sets of a package get, by the kind of space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.jobs.work_folder import WorkFolder
from gsvis.prepare import PrepareConfig
from gsvis.prepare.stage_sets import ship_sets
from gsvis.prepare.stages import Stages
from gsvis.progress import silent
from gsvis.pvs.shipped import CLASSES_RUN
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.scene.kinds import Kind, SpaceKind
from gsvis.scene.procedural import two_rooms

N = 1000


@pytest.mark.parametrize(("kind", "run"), [("object", CLASSES_RUN), ("open place", 0), ("rooms", 0)])
def test_runs_share_classes_around_objects_alone(tmp_path: Path, kind: Kind, run: int) -> None:
    scene = two_rooms(N)
    space = scene.navigable
    space = replace(space, kind=SpaceKind(kind, "for this test"))
    stages = Stages(
        scene.gaussians, space, PrepareConfig(cells=4), None, WorkFolder(tmp_path / "a.gsvis"), silent, [], []
    )
    sees = CellSet(np.arange(N), (np.arange(N) % 2).astype(np.uint8))
    info = StoreInfo(N, "made", 1 / 255, np.array([1 / 255, 0.1]))
    cells = [sees] * len(stages.grid)
    path = write_store(tmp_path / "sets.pvs", stages.grid, info, cells, np.zeros((N, 10), np.uint8))
    with stages.work.opened(), VisibilityStore.open(path) as store:
        shipped = ship_sets(stages, store)
        with VisibilityStore.open(shipped) as found:
            assert found.classes_run == run
            assert np.array_equal(found.classes(0)[1], sees.classes)
