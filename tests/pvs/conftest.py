"""A small build that tests of several modules repeat, stop and compare."""

from __future__ import annotations

from collections.abc import Iterator
from multiprocessing import get_all_start_methods, get_context

import pytest

from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from tests.pvs.jobs import CONFIG, Job


@pytest.fixture(scope="session", autouse=True)
def warm_processes() -> Iterator[None]:
    """Fork the processes of pools from one that has imported what they need and started no thread.

    To import it anew is most of what they cost here; `tests/cli/test_pvs.py` has pools as they are.
    """
    if "forkserver" not in get_all_start_methods():  # Windows
        yield
        return
    context = get_context("forkserver")
    context.set_forkserver_preload(["gsvis.jobs.processes", "gsvis.pvs._tasks", "gsvis.pvs.build"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsvis.jobs.processes.get_context", lambda method: context)
        yield


@pytest.fixture(scope="session")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    made = two_rooms(1000, sh_degree=1)
    space = NavigableSpace.from_box((0.5, 0.5, 0.3), (7.5, 3.5, 2.7), 14)
    grid = CellGrid.over(space, max_cells=8)
    path = tmp_path_factory.mktemp("pvs") / "here.pvs"
    with build_pvs(made.gaussians, grid, space, path, CONFIG) as store:
        assert len(set(store.viewpoints.tolist())) > 1
        assert len(set(store.certificates.rays.tolist())) > 1
    return Job(made.gaussians, grid, space, path.read_bytes())
