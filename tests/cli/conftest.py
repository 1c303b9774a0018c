"""Progress of commands that run in a test says nothing by itself: its clock stands still unless a test sets another."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gsvis.cli import terminal
from tests.known_spaces import remember_spaces


@pytest.fixture(autouse=True)
def a_clock_that_stands(monkeypatch: pytest.MonkeyPatch, bare_plots: None) -> None:
    """Lines of progress appear after seconds; how many pass is no matter of a test."""
    monkeypatch.setattr(terminal, "_clock", lambda: 0.0)


@pytest.fixture(scope="module", autouse=True)
def known_spaces() -> Iterator[None]:
    """Find the navigable space of a scene once; a module that needs it found anew has a fixture of this name."""
    with remember_spaces():
        yield
