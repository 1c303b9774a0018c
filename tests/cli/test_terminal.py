"""Lines that commands say in a terminal."""

from __future__ import annotations

import pytest

from gsvis.cli import terminal
from gsvis.cli.terminal import busy_note


@pytest.mark.parametrize(
    ("load", "note"),
    [(None, ""), (1.9, ""), (2.0, "; the machine is busy (load 2.0 on 4 cores)")],
)
def test_a_busy_machine_is_named(monkeypatch: pytest.MonkeyPatch, load: float | None, note: str) -> None:
    monkeypatch.setattr(terminal.os, "cpu_count", lambda: 4)
    assert busy_note(load) == note
