"""Scenes without viewers are closed and open again; the memory of mapped tables is bounded."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.abr.index import CellSets
from gsvis.package import Package
from gsvis.serve import Limits, ManualClock, Metrics, open_scenes
from gsvis.serve._log import EventLog
from gsvis.serve.upkeep import Upkeep
from tests.serve.servers import advance, ask, has_all, limits_of, patient, serving, until


def test_a_scene_without_viewers_is_closed_and_opens_for_the_next(plain: Path, tmp_path: Path) -> None:
    with serving(plain, tables=tmp_path, limits=limits_of(close_s=600.0)) as server:
        served = server._scenes["plain"]
        client, _ = patient(server.url, plain)
        until(lambda: served.users == 0)
        advance(server, 599.0)
        assert served.opened is not None
        advance(server, 2.0)
        until(lambda: served.opened is None)
        assert ask(server, "/healthz")[0] == 200
        assert b'"state":"ready"' in ask(server, "/")[2]
        assert has_all(client.receiver, plain)
        other, came = patient(server.url, plain)
        assert has_all(other.receiver, plain)
        assert len(came) == len(set(came))
        assert server.metrics.scenes.opened.value("plain") == server.metrics.scenes.closed.value("plain") == 1


def test_a_scene_with_a_viewer_stays_open(plain: Path, tmp_path: Path) -> None:
    with open_scenes([plain], tables=tmp_path) as scenes:
        served = scenes["plain"]
        with served.in_use(lambda: 7.0):
            assert not served.close_unused(1e9, 1.0)
        assert served.used_at == 7.0
        assert not served.close_unused(7.5, 1.0)
        assert served.close_unused(8.0, 1.0)
        assert served.gaussians == Package.open(plain).manifest.gaussians
        assert served.most_hello > 4096
        assert np.isfinite(served.within([0.0, 1e30, 0.0])).all()


def test_scenes_in_memory_are_never_closed(plain: Path) -> None:
    with open_scenes([plain]) as scenes:
        assert not scenes["plain"].close_unused(1e9, 1.0)


def test_a_question_opens_a_scene(plain: Path, tmp_path: Path) -> None:
    with serving(plain, tables=tmp_path, limits=limits_of(close_s=1.0)) as server:
        served = server._scenes["plain"]
        first = ask(server, "/scenes/plain/why/7")
        advance(server, 2.0)
        until(lambda: served.opened is None)
        assert ask(server, "/scenes/plain/why/8")[0] == first[0] == 200
        assert served.users == 0


def test_a_package_that_is_gone_when_it_opens_again_is_refused(plain: Path, tmp_path: Path) -> None:
    import shutil

    from gsvis.errors import ProtocolError

    copy = tmp_path / "copy.gsvis"
    shutil.copytree(plain, copy)
    with serving(copy, tables=tmp_path / "t", limits=limits_of(close_s=1.0)) as server:
        advance(server, 2.0)
        until(lambda: server._scenes["copy"].opened is None)
        (copy / "manifest.json").write_bytes(b"{")
        with pytest.raises(ProtocolError, match="damaged"):
            patient(server.url, plain)
        assert server._scenes["copy"].fault


def test_memory_of_tables_is_given_back_oldest_first(plain: Path, celled: Path, tmp_path: Path) -> None:
    with open_scenes([plain, celled], tables=tmp_path) as scenes:
        resident, released = [100.0], []
        metrics, clock = Metrics(), ManualClock()
        upkeep = Upkeep(
            scenes, Limits(tables_bytes=50), metrics, EventLog(), clock.now, resident=lambda: int(resident[0])
        )
        for served in scenes.values():
            tables = served.tables
            assert tables is not None

            def release(name: str = served.name) -> None:
                released.append(name)
                resident[0] -= 40

            tables.release = release  # type: ignore[method-assign]
        resident[0] = 145
        upkeep.look()
        assert released == []
        assert metrics.scenes.tables_bytes.value() == 45
        resident[0] = 180
        scenes["plain"].used_at = 5.0
        upkeep.look()
        assert released == ["celled"]
        resident[0] = 250
        scenes["celled"].use()
        upkeep.look()
        assert released[1:] == ["plain", "celled"]  # who is used goes last
        assert metrics.scenes.tables_released.value("celled") == 2
        assert metrics.scenes.open.value() == 2


@dataclass(frozen=True)
class RowOfTiles(CellSets):
    """Ten tiles of ten cells each, one after the other along x; those that were opened are listed."""

    opened: set[int]

    @property
    def grid(self) -> RowOfTiles:
        return self

    @property
    def sets(self) -> RowOfTiles:
        return self

    def classes(self, cell: int) -> tuple[np.ndarray, np.ndarray]:
        raise AssertionError("nobody asks what a cell sees")

    def nearest(self, position: np.ndarray) -> int:
        return int(position[0])

    def tiles_near(self, cell: int) -> dict[int, tuple[float, float]]:
        return {tile: (tile / 10, (tile + 1) / 10) for tile in {cell // 10, min(cell + 1, 99) // 10}}

    def is_open(self, tile: int) -> bool:
        return tile in self.opened

    def load(self, tile: int) -> None:
        self.opened.add(tile)


@dataclass(eq=False)
class Walker:
    """A session of a viewer who walks along x, a cell a second."""

    cell: int

    @property
    def planner(self) -> Walker:
        return self

    def position_in(self, seconds: float) -> np.ndarray:
        return np.array([self.cell + seconds, 0.0, 0.0])


def test_tiles_that_viewers_have_left_give_memory_back_before_those_they_are_in(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_scenes([plain], tables=tmp_path) as scenes:
        served, resident, released, walker = scenes["plain"], [0], list[Any](), Walker(5)
        limits, metrics = Limits(tables_bytes=50), Metrics()
        upkeep = Upkeep(scenes, limits, metrics, EventLog(), ManualClock().now, resident=lambda: resident[0])
        assert served.opened is not None
        assert served.tables is not None
        monkeypatch.setattr(served.opened, "index", RowOfTiles(set()))
        monkeypatch.setattr(served, "sessions", {walker})

        def release(shares: Any = None) -> None:
            released.append(shares)
            resident[0] -= 40

        monkeypatch.setattr(served.tables, "release", release)
        for cell, nbytes in ((5, 10), (9, 40), (15, 60), (16, 60)):
            walker.cell, resident[0] = cell, nbytes
            upkeep.look()
        assert released == [[(0.0, 0.1)], None]  # the first tile once; then nothing was left but the walker's own
        walker.cell, resident[0] = 42, 100
        upkeep.look()
        assert released[2:] == [[(0.1, 0.2)], None]


def test_a_tile_is_opened_before_a_walker_comes(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_scenes([plain], tables=tmp_path) as scenes:
        served, walker, index = scenes["plain"], Walker(0), RowOfTiles({0})
        upkeep = Upkeep(scenes, Limits(), Metrics(), EventLog(), ManualClock().now)
        assert upkeep.ahead() == []
        assert served.opened is not None
        monkeypatch.setattr(served.opened, "index", index)
        monkeypatch.setattr(served, "sessions", {walker, Walker(0)})
        for walker.cell in range(100):
            for opening in upkeep.ahead():
                opening()
            assert walker.cell // 10 in index.opened
        assert index.opened == set(range(11))


def test_closing_does_not_wait_for_a_thread_that_opens(plain: Path, tmp_path: Path) -> None:
    with open_scenes([plain], tables=tmp_path) as scenes:
        served = scenes["plain"]
        assert served.close_unused(1e9, 1.0)
        began, go_on = threading.Event(), threading.Event()
        reopen = served.reopen
        assert reopen is not None

        def slow() -> object:
            began.set()
            go_on.wait(60)
            return reopen()

        served.reopen = slow  # type: ignore[assignment]
        thread = threading.Thread(target=served.use)
        thread.start()
        began.wait(60)
        assert not served.close_unused(1e9, 1.0)
        go_on.set()
        thread.join()
        assert served.users == 1
