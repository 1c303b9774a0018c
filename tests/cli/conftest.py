"""Progress of commands that run in a test says nothing by itself: its clock stands still unless a test sets another."""

from __future__ import annotations

import pytest

from gsvis.cli import terminal


@pytest.fixture(autouse=True)
def a_clock_that_stands(monkeypatch: pytest.MonkeyPatch, bare_plots: None) -> None:
    """Lines of progress appear after seconds; how many pass is no matter of a test."""
    monkeypatch.setattr(terminal, "_clock", lambda: 0.0)
