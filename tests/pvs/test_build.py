"""Building: the same bytes whoever does the work and however often it was stopped, and nothing lost on the way."""

from __future__ import annotations

import errno
import itertools
import multiprocessing
import os
import signal
import subprocess
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError, GsvisError, SceneError
from gsvis.files.resume import KeptWork
from gsvis.progress import Progress, silent
from gsvis.pvs import build
from gsvis.pvs._journal import name_entry
from gsvis.pvs.build import build_pvs, journal_of
from gsvis.pvs.cell_view import CellView
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.estimate import estimate_pvs
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.workers import Workers
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms

CONFIG = PvsConfig(size=16, growth=0.1, min_viewpoints=3, max_viewpoints=6)
"""Small, and cells are done after different numbers of viewpoints."""


@dataclass(frozen=True, eq=False)
class Job:
    """A scene to be looked at, and the bytes of its store."""

    scene: Gaussians
    grid: CellGrid
    space: NavigableSpace
    wanted: bytes

    def run(
        self, path: Path, config: PvsConfig = CONFIG, *, workers: Workers | None = None, progress: Progress = silent
    ) -> bytes:
        build_pvs(self.scene, self.grid, self.space, path, config, workers=workers, progress=progress).close()
        return path.read_bytes()

    def journal(self, path: Path, config: PvsConfig = CONFIG) -> Path:
        return journal_of(self.scene, self.grid, self.space, path, config)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    made = two_rooms(2000, sh_degree=1)
    grid = CellGrid.over(made.navigable, max_cells=12)
    path = tmp_path_factory.mktemp("pvs") / "here.pvs"
    with build_pvs(made.gaussians, grid, made.navigable, path, CONFIG) as store:
        assert len(set(store.viewpoints.tolist())) > 1
    return Job(made.gaussians, grid, made.navigable, path.read_bytes())


class Stop:
    """A progress callback that ends the build after so many cells, and remembers where it began."""

    def __init__(self, after: int, error: type[BaseException] = KeyboardInterrupt) -> None:
        self.after, self.error, self.calls = after, error, []

    def __call__(self, stage: str, done: int, total: int) -> None:
        self.calls.append((stage, done))
        if stage == "cells" and done >= self.after:
            raise self.error


@pytest.fixture
def looked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows by one for each cell that is looked from in this process."""
    seen: list[int] = []
    from gsvis.pvs import _workers

    def counting(look: Any, viewpoints: Any, config: PvsConfig) -> CellView:
        seen.append(len(viewpoints))
        return see_cell(look, viewpoints, config)

    see_cell = _workers.see_cell
    monkeypatch.setattr(_workers, "see_cell", counting)
    return seen


def test_workers_do_not_change_a_byte_even_if_they_die(job: Job, tmp_path: Path) -> None:
    killed: list[int] = []

    def kill_one(stage: str, done: int, total: int) -> None:
        if stage == "cells" and done == 3 and not killed:
            victim = multiprocessing.active_children()[0]
            assert victim.pid is not None
            killed.append(victim.pid)
            os.kill(victim.pid, signal.SIGKILL)

    assert job.run(tmp_path / "killed.pvs", workers=Workers(2), progress=kill_one) == job.wanted
    assert killed
    assert job.run(tmp_path / "three.pvs", workers=Workers(3)) == job.wanted
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed.pvs", "three.pvs"]
    assert multiprocessing.active_children() == []


def test_the_number_of_threads_does_not_change_a_byte(job: Job, tmp_path: Path) -> None:
    from gsvis.pvs._workers import use_threads

    use_threads(1)
    try:
        assert job.run(tmp_path / "one.pvs") == job.wanted
    finally:
        use_threads(None)


def test_a_stopped_build_goes_on_where_it_stood(job: Job, tmp_path: Path, looked: list[int]) -> None:
    path = tmp_path / "new" / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(5))
    assert not path.exists()
    assert len(list(job.journal(path).glob("cell-*.bin"))) == 5
    assert len(looked) == 5
    again = Stop(99)
    assert job.run(path, progress=again) == job.wanted
    assert len(looked) == len(job.grid)
    assert again.calls[0] == ("cells", 5)
    assert [entry.name for entry in path.parent.iterdir()] == ["scene.pvs"]


def test_a_stopped_pool_leaves_no_process_and_no_copy_of_the_scene(job: Job, tmp_path: Path) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, workers=Workers(2), progress=Stop(1))
    assert multiprocessing.active_children() == []
    kept = sorted(entry.name for entry in job.journal(path).iterdir() if not entry.name.startswith("cell-"))
    assert kept == ["lock", "plan.json"]
    assert job.run(path) == job.wanted


def test_a_build_that_finished_no_cell_leaves_nothing(job: Job, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        job.run(tmp_path / "scene.pvs", progress=Stop(0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", ["cut", "empty", "bit", "other"])
def test_a_damaged_cell_is_looked_from_again(job: Job, tmp_path: Path, looked: list[int], damage: str) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(4))
    victim = sorted(job.journal(path).glob("cell-*.bin"))[2]
    whole = victim.read_bytes()
    flipped = bytearray(whole)
    flipped[-3] ^= 1
    victim.write_bytes({"cut": whole[:-5], "empty": b"", "bit": bytes(flipped), "other": b"x" * 99}[damage])
    (job.journal(path) / ".cell-000009-abc.bin").write_bytes(b"half")
    looked.clear()
    assert job.run(path) == job.wanted
    assert len(looked) == len(job.grid) - 3
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.pvs"]


def test_the_journal_stays_until_the_store_is_open(
    job: Job, tmp_path: Path, looked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise FormatError(path, "", "a store", "another file")

    path = tmp_path / "x.pvs"
    with monkeypatch.context() as patch:
        patch.setattr(VisibilityStore, "open", refuse)
        with pytest.raises(FormatError, match="expected a store"):
            job.run(path)
    assert len(list(job.journal(path).glob("cell-*.bin"))) == len(looked) == len(job.grid)
    assert job.run(path) == job.wanted
    assert len(looked) == len(job.grid)
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.pvs"]


def test_other_settings_do_not_use_the_journal(job: Job, tmp_path: Path, looked: list[int]) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(11))
    other = replace(CONFIG, growth=0.5)
    assert job.journal(path) != job.journal(path, other)
    more = build_pvs(job.scene, job.grid, job.space, path, other)
    assert len(looked) == 11 + len(job.grid)
    assert more.info.config["growth"] == 0.5
    more.close()
    smaller = replace(job.space, free=job.space.free & (np.arange(job.space.free.shape[2]) > 8))
    folders = {job.journal(path), job.journal(tmp_path / "x.pvs")}
    folders.add(journal_of(job.scene, job.grid, smaller, path, CONFIG))
    folders.add(journal_of(job.scene[:-1], job.grid, job.space, path, CONFIG))
    assert len(folders) == 4
    assert job.run(path) == job.wanted  # the first journal is still there


def _full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_keeps_what_was_found_and_what_was_there(
    job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, looked: list[int]
) -> None:
    path = tmp_path / "scene.pvs"
    path.write_bytes(b"what was there before")
    keep = KeptWork.keep
    with monkeypatch.context() as patched, pytest.raises(OSError, match=r"7 of 12 cells are kept.*make room") as caught:
        patched.setattr(
            KeptWork, "keep", lambda self, name, data: keep(self, name, data) if name < name_entry(7) else _full()
        )
        job.run(path)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))
    assert path.read_bytes() == b"what was there before"
    with monkeypatch.context() as patched, pytest.raises(OSError, match="12 of 12 cells are kept"):
        patched.setattr(build.StoreWriter, "finish", _full)
        job.run(path)
    assert len(looked) == 8 + 5
    assert path.read_bytes() == b"what was there before"
    assert job.run(path) == job.wanted
    assert len(looked) == 8 + 5


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on a file system of 64 KiB."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no right to mount a file system")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_a_disk_that_is_really_full(job: Job, tiny_disk: Path) -> None:
    path = tiny_disk / "scene.pvs"
    path.write_bytes(b"what was there before")
    for workers in (1, 2):
        with pytest.raises(OSError, match=r"cell.*make room and run the same command again") as caught:
            job.run(path, workers=Workers(workers))
        assert caught.value.errno == errno.ENOSPC
        assert path.read_bytes() == b"what was there before"
    subprocess.run(["mount", "-o", "remount,size=8m", tiny_disk], check=True)
    assert job.run(path) == job.wanted


def test_two_builds_of_the_same_do_not_meet(job: Job, tmp_path: Path) -> None:
    path = tmp_path / "scene.pvs"

    def meddle(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("cells", 2):
            with pytest.raises(ValueError, match="no other process"):
                job.run(path)

    assert job.run(path, progress=meddle) == job.wanted


def test_any_executor_will_do(job: Job, tmp_path: Path) -> None:
    with ThreadPoolExecutor(3) as executor:
        assert job.run(tmp_path / "scene.pvs", workers=Workers(3, executor=executor)) == job.wanted


class Forgetful(Executor):
    """Loses every third task, or all of them."""

    def __init__(self, everything: bool) -> None:
        self.count, self.everything = 0, everything

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.count += 1
        future: Future[Any] = Future()
        if self.everything or self.count % 3 == 0:
            future.set_exception(CancelledError())
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_lost_tasks_are_given_out_again_but_not_for_ever(job: Job, tmp_path: Path) -> None:
    shared: list[Any] = []
    workers = Workers(2, executor=Forgetful(False), scatter=lambda scene: shared.append(scene) or scene)
    assert job.run(tmp_path / "scene.pvs", workers=workers) == job.wanted
    assert len(shared) > 1
    with pytest.raises(GsvisError, match="again and again"):
        job.run(tmp_path / "never.pvs", workers=Workers(2, executor=Forgetful(True)))


def test_the_order_of_a_scene_is_only_a_matter_of_names(job: Job, tmp_path: Path) -> None:
    order = np.random.default_rng(0).permutation(len(job.scene))
    with (
        build_pvs(job.scene[order], job.grid, job.space, tmp_path / "mixed.pvs", CONFIG) as mixed,
        build_pvs(job.scene, job.grid, job.space, tmp_path / "scene.pvs", CONFIG) as plain,
    ):
        for cell in range(len(job.grid)):
            ids, classes = mixed.classes(cell)
            back = np.argsort(order[ids])
            assert np.array_equal(order[ids][back], plain.classes(cell)[0])
            assert np.array_equal(classes[back], plain.classes(cell)[1])


def test_sh_is_not_looked_at_and_the_store_knows_its_scene(job: Job, tmp_path: Path) -> None:
    g = job.scene
    plain = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0)
    with build_pvs(plain, job.grid, job.space, tmp_path / "scene.pvs", CONFIG) as store:
        (tmp_path / "wanted.pvs").write_bytes(job.wanted)
        with VisibilityStore.open(tmp_path / "wanted.pvs", scene=g) as wanted:
            assert np.array_equal(store.visible_ids(3), wanted.visible_ids(3))
            assert store.info.scene != wanted.info.scene
            assert wanted.info.config["size"] == CONFIG.size


def test_an_estimate_is_near_and_writes_nothing(job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.pvs"
    clock = itertools.count(100.0, 3.0)  # the cells that are tried take 3 seconds together
    monkeypatch.setattr(build, "_clock", lambda: next(clock))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    estimate = estimate_pvs(job.scene, job.grid, job.space, path, CONFIG, workers=Workers(2))
    assert (estimate.cells, estimate.finished, estimate.workers) == (12, 0, 2)
    assert estimate.seconds == pytest.approx(3.0 / 2 * 12 / 1.3)  # two of twelve were tried, two processes share them
    assert estimate.memory > 1 << 28
    assert 0.3 < estimate.disk / len(job.wanted) < 5.0
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(5))
    held = sum(entry.stat().st_size for entry in job.journal(path).glob("cell-*.bin")) / 5 * 12
    before = sorted(path.parent.rglob("*"))
    estimate = estimate_pvs(job.scene, job.grid, job.space, path, CONFIG)
    assert estimate.finished == 5
    assert 0.5 < estimate.working_disk / held < 2.0
    assert sorted(path.parent.rglob("*")) == before


def test_memory_bounds_the_workers(job: Job, tmp_path: Path) -> None:
    def workers(max_memory: int) -> int:
        bound = Workers(64, max_memory)
        return estimate_pvs(job.scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG, workers=bound, sample=1).workers

    counts = [workers(gigabytes << 30) for gigabytes in (1, 4, 16, 64)]
    assert counts == sorted(counts)
    assert counts[0] < counts[1] < 64
    for gigabytes, count in zip((1, 4, 16, 64), counts, strict=True):
        bound = Workers(count, gigabytes << 30)
        estimate = estimate_pvs(job.scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG, workers=bound, sample=1)
        assert estimate.memory <= gigabytes << 30
    with pytest.raises(ValueError, match=r"max_memory: expected at least .* GB for"):
        build_pvs(job.scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG, workers=Workers(1, 1 << 20))
    assert list(tmp_path.iterdir()) == []


def test_scenes_that_show_nothing_are_refused(job: Job, tmp_path: Path) -> None:
    g = job.scene
    faint = Gaussians(g.means, g.quats, g.scales, np.full(len(g), 0.001), g.sh0)
    for scene in (faint, Gaussians.empty()):
        with pytest.raises(SceneError, match=r"nothing to see.*right one"):
            build_pvs(scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG)
        with pytest.raises(SceneError, match="nothing to see"):
            estimate_pvs(scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG)
    block = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[9, 9, 9]], [0.99], np.zeros((1, 1, 3)))
    box = NavigableSpace.from_box((-1, -1, -1), (1, 1, 1), 8)
    with pytest.raises(SceneError, match="every viewpoint lies inside something solid; give"):
        build_pvs(block, CellGrid.over(box, max_cells=8), box, tmp_path / "x.pvs", CONFIG)
    assert list(tmp_path.iterdir()) == []


def test_a_grid_of_another_space_is_refused(job: Job, tmp_path: Path) -> None:
    elsewhere = NavigableSpace.from_box((90, 90, 90), (91, 91, 91), 4)
    with pytest.raises(ValueError, match="free voxel in every cell"):
        build_pvs(job.scene, job.grid, elsewhere, tmp_path / "x.pvs", CONFIG)


@pytest.mark.parametrize("bad", [{"count": 0}, {"count": 1.5}, {"count": True}, {"max_memory": 0}])
def test_workers_are_checked(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        Workers(**bad)
