"""A server of one process ends when its event loop stands still, and at no other time."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import pytest

from gsvis.serve import Server
from gsvis.serve._log import EventLog
from gsvis.serve.hang import HangWatch
from tests.serve.servers import PATIENCE, serving, until


class Passing:
    """A clock that stands still until a test lets time pass."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def watched(hung_s: float = 10.0) -> tuple[HangWatch, Passing, list[bool]]:
    clock, ended = Passing(), list[bool]()
    return HangWatch(EventLog(), hung_s, clock=clock, end=lambda: ended.append(True)), clock, ended


def pass_time(watch: HangWatch, clock: Passing, seconds: int) -> bool:
    """Let seconds pass one by one; return whether the loop hangs."""
    for _ in range(seconds):
        clock.now += 1.0
        if watch.look():
            return True
    return False


def test_a_loop_that_beats_goes_on_and_one_that_stops_ends(caplog: pytest.LogCaptureFixture) -> None:
    watch, clock, ended = watched()
    assert not pass_time(watch, clock, 100)  # silence before the first beat does not count
    for _ in range(20):
        watch.beat()
        assert not pass_time(watch, clock, 9)
    watch.beat()
    with caplog.at_level(logging.ERROR, "gsvis.serve"):
        assert pass_time(watch, clock, 10)
    assert ended == [True]
    assert "test_hang.py" in caplog.records[-1].facts["stack"]  # this thread made the watch, and hangs
    assert "\n" not in caplog.records[-1].getMessage()


def test_a_machine_that_slept_ends_nothing() -> None:
    watch, clock, ended = watched()
    watch.beat()
    clock.now += 3600.0
    assert not watch.look()
    assert ended == []


def test_a_server_ends_when_work_blocks_its_loop(plain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, ended, blocked = Passing(), threading.Event(), threading.Event()
    run = Server.run
    monkeypatch.setattr("gsvis.serve.hang._LOOK_S", 0.01)
    monkeypatch.setattr(
        "gsvis.serve.server.HangWatch", lambda log, hung_s: HangWatch(log, hung_s, clock=clock, end=ended.set)
    )
    monkeypatch.setattr(Server, "run", lambda server: run(server, hung_s=10.0))

    def block() -> None:
        blocked.set()
        assert ended.wait(PATIENCE)

    def passes() -> bool:
        clock.now += 1.0
        return ended.is_set()

    with serving(plain) as server:
        server._upkeep.look = block  # type: ignore[method-assign]
        assert blocked.wait(PATIENCE)
        assert not ended.is_set()
        until(passes)
