"""Progress of commands that run in a test says nothing by itself: its clock stands still unless a test sets another."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from gsvis.cli import terminal
from tests.known_parsers import remember_parsers
from tests.known_spaces import coarse_spaces, remember_spaces
from tests.quick_reports import draw_no_places, take_few_judges


@pytest.fixture(scope="session", autouse=True)
def known_parsers() -> Iterator[None]:
    """Build the parser of each command once."""
    with remember_parsers():
        yield


@pytest.fixture(autouse=True)
def a_clock_that_stands(monkeypatch: pytest.MonkeyPatch, bare_plots: None) -> None:
    """Lines of progress appear after seconds; how many pass is no matter of a test."""
    monkeypatch.setattr(terminal, "_clock", lambda: 0.0)


@pytest.fixture(autouse=True)
def pictures_of_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no picture of where people stand; a module that needs it has a fixture of this name."""
    draw_no_places(monkeypatch)


@pytest.fixture(autouse=True)
def few_judges(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge by few eyes; a module that needs all of them has a fixture of this name."""
    take_few_judges(monkeypatch)


@pytest.fixture(scope="module", autouse=True)
def few_voxels() -> Iterator[None]:
    """Look for surfaces on coarse grids: what finer ones show is tested in tests/edit.

    A module that needs a finer one has a fixture of this name.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsvis.edit.shape._VOXELS", 1 << 17)
        yield


@pytest.fixture(scope="module", autouse=True)
def known_spaces(shared_folder: Path) -> Iterator[None]:
    """Find the navigable space of a scene once for all workers, among few voxels.

    A module that needs others has its own fixture.
    """
    with remember_spaces(shared_folder), coarse_spaces():
        yield
