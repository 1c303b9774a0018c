"""What the tests of the commands share: a clock of progress that stands still, coarse plots, blank plots."""

from __future__ import annotations

import pytest

from gsvis.cli import terminal
from gsvis.report import theme


@pytest.fixture(autouse=True)
def a_clock_that_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines of progress appear after seconds; how many pass is no matter of a test."""
    monkeypatch.setattr(terminal, "_clock", lambda: 0.0)


@pytest.fixture(scope="session", autouse=True)
def coarse_plots() -> object:
    """Draw the plots of reports with few pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(theme, "_DPI", 40)
        yield


@pytest.fixture(scope="session")
def blank() -> bytes:
    """A PNG without any content."""
    return theme.drawn(lambda axes, colors: axes.set_axis_off())


@pytest.fixture
def blank_plots(monkeypatch: pytest.MonkeyPatch, blank: bytes) -> None:
    """Leave the plots of reports blank, for tests that look at none: drawing takes most of a small report's time."""
    for page in ("document", "color_document", "pvs_document", "session_document"):
        monkeypatch.setattr(f"gsvis.report.{page}.drawn", lambda *arguments: blank)
