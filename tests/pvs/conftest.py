"""A small build that tests of several modules repeat, stop and compare."""

from __future__ import annotations

import pytest

from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from tests.pvs.jobs import CONFIG, Job


@pytest.fixture(scope="module", autouse=True)
def pools(warm_processes: None) -> None:
    """Fork the processes of pools from a warm one, in all tests of builds."""


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
