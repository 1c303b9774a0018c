"""Progress of commands that run in a test says nothing by itself: its clock stands still unless a test sets another."""

from __future__ import annotations

import base64
from collections.abc import Iterator

import pytest

from gsvis.cli import analyze, clean, pvs_report, showing, terminal  # before any is patched
from tests.known_spaces import remember_spaces

_PIXEL = base64.b64decode(  # a white PNG of one pixel
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4//8/AAX+Av4N70a4AAAAAElFTkSuQmCC"
)


@pytest.fixture(autouse=True)
def a_clock_that_stands(monkeypatch: pytest.MonkeyPatch, bare_plots: None) -> None:
    """Lines of progress appear after seconds; how many pass is no matter of a test."""
    monkeypatch.setattr(terminal, "_clock", lambda: 0.0)


@pytest.fixture(autouse=True)
def pictures_of_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no picture of where people stand, which takes seconds; a module that needs it has a fixture of this name."""
    for home in (showing, clean, analyze, pvs_report):
        monkeypatch.setattr(home, "picture_of", lambda source, place: _PIXEL)


@pytest.fixture(scope="module", autouse=True)
def known_spaces() -> Iterator[None]:
    """Find the navigable space of a scene once; a module that needs it found anew has a fixture of this name."""
    with remember_spaces():
        yield
