"""The check of the soak sees every byte that differs, and nothing else."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks._honest import Checker, Checks, Visit
from gsvis.abr.classes import FieldOfView
from gsvis.stream import Receiver, Session, StreamedScene
from gsvis.stream.batch import Sections
from tests.stream.worlds import package_of


@pytest.fixture(scope="module", params=["rgb", "hsl"])
def visited(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Checker, Visit]:
    """A check of a package, and what a viewer who walks has received."""
    folder = tmp_path_factory.mktemp("visited") / "s.gsvis"
    with package_of(folder, 1500, request.param, stores=False) as package:
        visit = visit_of(StreamedScene.open(package))
    return Checker(folder), visit


def visit_of(scene: StreamedScene) -> Visit:
    """What a viewer who walks receives."""
    session, visit = Session(scene, FieldOfView.from_degrees(80, 60, margin=8)), Visit(scene.header)
    for k in range(40):
        session.on_pose(k / 10, (0.1 * k, 0.0, 0.0), (1.0, 0.1 * k, 0.0, 0.0))
        message = session.next_message(k / 10, 3000.0)
        if message is not None:
            visit.batches.append(message.data)
            session.on_ack(k / 10 + 0.05, len(visit.batches))
    return visit


def test_what_is_right_is_right(visited: tuple[Checker, Visit]) -> None:
    checker, visit = visited
    found = checker.check(visit)
    assert (found["wrong"], found["refused"]) == (0, 0)
    assert found["batches"] == len(visit.batches) > 3
    assert min(found["gaussians"], found["terms"]) > 100
    assert found["bytes"] > sum(map(len, visit.batches))


def test_a_byte_that_differs_is_counted(visited: tuple[Checker, Visit]) -> None:
    checker, visit = visited
    rng, caught = np.random.default_rng(3), 0
    for _ in range(20):
        k = int(rng.integers(len(visit.batches)))
        about = Receiver(visit.welcome).about
        sections = Sections.parse(visit.batches[k], about)
        if not len(sections.records):
            continue
        place = visit.batches[k].index(sections.records.tobytes()) + int(rng.integers(len(sections.records)))
        data = bytearray(visit.batches[k])
        data[place] ^= 1 << int(rng.integers(8))
        found = checker.check(Visit(visit.welcome, [*visit.batches[:k], bytes(data), *visit.batches[k + 1 :]]))
        assert found["wrong"] or found["refused"]
        caught += 1
    assert caught > 5


def test_what_is_missing_or_comes_twice_is_refused(visited: tuple[Checker, Visit]) -> None:
    checker, visit = visited
    for batches in (visit.batches[1:], [visit.batches[0], *visit.batches], [visit.batches[0][:-8], *visit.batches[1:]]):
        assert checker.check(Visit(visit.welcome, list(batches)))["refused"] == 1


@pytest.mark.parametrize(
    ("said", "other"),
    [
        (b'"gaussians":1500', b'"gaussians":1499'), (b'"chunks":', b'"chunkz":'), (b'"protocol":3', b'"protocol":1'),
        (b'"up":[', b'"vp":['), (b'"name":"', b'"nome":"'), (b'"meters_per_unit":', b'"meters_per_unit":1'),
    ],
)  # fmt: skip
def test_a_welcome_that_says_something_else_is_wrong(
    visited: tuple[Checker, Visit], said: bytes, other: bytes
) -> None:  # fmt: skip
    checker, visit = visited
    assert checker.check(visit)["wrong"] == 0
    changed = visit.welcome.replace(said, other, 1)
    assert changed != visit.welcome
    found = checker.check(Visit(changed, visit.batches))
    assert found["wrong"] or found["refused"]


def test_an_identity_that_changes_is_wrong(visited: tuple[Checker, Visit]) -> None:
    checker, visit = visited
    assert checker.check(visit)["wrong"] == 0
    place = visit.welcome.index(b'"identity":"') + 12
    digit = b"0" if visit.welcome[place : place + 1] != b"0" else b"1"
    changed = visit.welcome[:place] + digit + visit.welcome[place + 1 :]
    assert checker.check(Visit(changed, visit.batches))["wrong"] == len(visit.welcome)


@pytest.mark.parametrize("kind", ["owners", "rows"])
def test_what_the_server_builds_wrong_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:  # fmt: skip
    build = StreamedScene.__init__

    def wrong(self: StreamedScene, *args: Any, **options: Any) -> None:
        build(self, *args, **options)
        if kind == "rows":
            assert self.records.chunk_rows["last_level"].any()
            self.records.chunk_rows["last_level"] = 0  # which no picture shows
            self.records.chunk_rows["first_level"] = 0
        else:
            found = self.records.owners
            owners = np.unique(found)
            wrong_owners = owners[np.maximum(np.searchsorted(owners, found) - 1, 0)].astype(np.int32)
            self.records = replace(self.records, owners=wrong_owners)

    monkeypatch.setattr(StreamedScene, "__init__", wrong)
    with package_of(tmp_path / "s.gsvis", 1500, "rgb", stores=False) as package:
        visit = visit_of(StreamedScene.open(package))
    assert Checker(tmp_path / "s.gsvis").check(visit)["wrong"] > 0


def test_viewers_wait_where_checks_are_behind() -> None:
    release = threading.Event()

    def job(visit: Visit) -> dict[str, int]:
        release.wait()
        return {"bytes": len(visit.welcome), "wrong": 0}

    async def run() -> Checks:
        with ThreadPoolExecutor(1) as executor:
            checks = Checks(executor, 3, job)
            for _ in range(2):
                checks.put(Visit(b"12"))
            await checks.wait_for_room()  # there is some
            checks.put(Visit(b"12"))
            waiting = [asyncio.create_task(checks.wait_for_room()) for _ in range(2)]
            for _ in range(20):
                await asyncio.sleep(0)
            assert not any(task.done() for task in waiting)
            release.set()
            await asyncio.wait_for(asyncio.gather(*waiting), 60.0)
            await checks.finish()
            return checks

    checks = asyncio.run(run())
    assert (checks.found["bytes"], checks.longest) == (6, 3)
    assert checks.waited_s > 0.0


def test_a_check_that_fails_is_not_passed_over() -> None:
    def job(_: Visit) -> dict[str, int]:
        raise RuntimeError("out of memory")

    async def run() -> None:
        with ThreadPoolExecutor(1) as executor:
            checks = Checks(executor, 3, job)
            checks.put(Visit(b""))
            await checks.finish()

    with pytest.raises(RuntimeError, match="out of memory"):
        asyncio.run(run())
