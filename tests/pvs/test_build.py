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

from gsvis._extras import has
from gsvis.errors import FormatError, GsvisError, SceneError
from gsvis.jobs.resume import KeptWork
from gsvis.jobs.workers import Workers
from gsvis.pvs import build
from gsvis.pvs._journal import name_cell, name_viewpoint
from gsvis.pvs.build import build_pvs, journal_of
from gsvis.pvs.cell_view import CellView, Finder
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.estimate import estimate_pvs
from gsvis.pvs.sightings import Sighting
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import Solid
from tests.pvs.jobs import CONFIG, Job, Stop


@dataclass
class Counts:
    """How many viewpoints were looked from, and how many cells were found, in this process."""

    viewpoints: int = 0
    cells: int = 0


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> Counts:
    found = Counts()
    look, find_cell = Finder.look, Finder.find_cell

    def counted_look(self: Finder, viewpoint: Any, **how: Any) -> Sighting:
        found.viewpoints += 1
        return look(self, viewpoint, **how)

    def counted_find(self: Finder, *words: Any) -> CellView:
        found.cells += 1
        return find_cell(self, *words)

    monkeypatch.setattr(Finder, "look", counted_look)
    monkeypatch.setattr(Finder, "find_cell", counted_find)
    return found


def kept_in(folder: Path) -> tuple[int, int]:
    """The number of kept viewpoints and cells."""
    return len(list(folder.glob("viewpoint-*.bin"))), len(list(folder.glob("cell-*.bin")))


def test_workers_do_not_change_a_byte_even_if_they_die(job: Job, tmp_path: Path) -> None:
    killed: dict[str, int] = {}

    def kill_one(stage: str, done: int, total: int) -> None:
        if stage in ("viewpoints", "cells") and done == 3 and stage not in killed:
            victim = multiprocessing.active_children()[0]
            assert victim.pid is not None
            killed[stage] = victim.pid
            os.kill(victim.pid, signal.SIGKILL)

    assert job.run(tmp_path / "killed.pvs", workers=Workers(2), progress=kill_one) == job.wanted
    assert set(killed) == {"viewpoints", "cells"}
    assert job.run(tmp_path / "three.pvs", workers=Workers(3)) == job.wanted
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed.pvs", "three.pvs"]
    assert multiprocessing.active_children() == []


def test_the_processes_that_look_find_the_sets_too(job: Job, tmp_path: Path) -> None:
    seen: dict[str, set[int | None]] = {}

    def note(stage: str, done: int, total: int) -> None:
        if stage in ("viewpoints", "cells") and done:
            seen[stage] = {process.pid for process in multiprocessing.active_children()}

    assert job.run(tmp_path / "two.pvs", workers=Workers(2), progress=note) == job.wanted
    assert seen["viewpoints"]
    assert seen["viewpoints"] <= seen["cells"]


def test_the_number_of_threads_does_not_change_a_byte(job: Job, tmp_path: Path) -> None:
    from gsvis.jobs.processes import use_threads

    use_threads(1)
    try:
        assert job.run(tmp_path / "one.pvs") == job.wanted
    finally:
        use_threads(None)


@pytest.mark.parametrize(("stage", "after"), [("viewpoints", 5), ("viewpoints", 99), ("cells", 5), ("check", 0)])
def test_a_stopped_build_goes_on_where_it_stood(
    job: Job, tmp_path: Path, counts: Counts, stage: str, after: int
) -> None:
    cells, viewpoints = len(job.grid), len(job.shared)
    path = tmp_path / "new" / "scene.pvs"
    after = min(after, viewpoints)
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(after, stage))
    assert not path.exists()
    kept = {"viewpoints": (after, 0), "cells": (viewpoints, after), "check": (viewpoints, cells)}[stage]
    assert kept_in(job.journal(path)) == kept
    assert (counts.viewpoints, counts.cells) == kept
    again = Stop(99)
    assert job.run(path, progress=again) == job.wanted
    assert (counts.viewpoints, counts.cells) == (viewpoints, cells)
    assert again.calls[0] == ("viewpoints", kept[0])
    assert next(call for call in again.calls if call[0] == "cells") == ("cells", kept[1])
    assert [entry.name for entry in path.parent.iterdir()] == ["scene.pvs"]


@pytest.mark.parametrize("stage", ["viewpoints", "cells"])
def test_a_stopped_pool_leaves_no_process_and_no_copy_of_the_scene(job: Job, tmp_path: Path, stage: str) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, workers=Workers(2), progress=Stop(1, stage))
    assert multiprocessing.active_children() == []
    kept = sorted(entry.name for entry in job.journal(path).iterdir() if entry.suffix != ".bin")
    assert kept == ["lock", "plan.json"]
    assert job.run(path) == job.wanted


@pytest.mark.parametrize("stage", ["viewpoints", "cells"])
def test_a_build_goes_on_with_another_number_of_workers(job: Job, tmp_path: Path, counts: Counts, stage: str) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(3, stage))
    here = (counts.viewpoints, counts.cells)
    assert job.run(path, workers=Workers(2)) == job.wanted
    assert (counts.viewpoints, counts.cells) == here  # the rest was done elsewhere


def test_a_build_that_finished_nothing_leaves_nothing(job: Job, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        job.run(tmp_path / "scene.pvs", progress=Stop(0, "viewpoints"))
    assert list(tmp_path.iterdir()) == []


def spoil(victim: Path, damage: str) -> None:
    whole = victim.read_bytes()
    flipped = bytearray(whole)
    flipped[-3] ^= 1
    victim.write_bytes({"cut": whole[:-5], "empty": b"", "bit": bytes(flipped), "other": b"x" * 99}[damage])


@pytest.mark.parametrize("damage", ["cut", "empty", "bit", "other"])
def test_a_damaged_cell_is_found_again(job: Job, tmp_path: Path, counts: Counts, damage: str) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(4))
    spoil(sorted(job.journal(path).glob("cell-*.bin"))[2], damage)
    (job.journal(path) / ".cell-000009-abc.bin").write_bytes(b"half")
    counts.viewpoints = counts.cells = 0
    assert job.run(path) == job.wanted
    assert (counts.viewpoints, counts.cells) == (0, len(job.grid) - 3)
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.pvs"]


@pytest.mark.parametrize("damage", ["cut", "empty", "bit", "other"])
def test_a_damaged_viewpoint_is_looked_from_again(job: Job, tmp_path: Path, counts: Counts, damage: str) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(6, "viewpoints"))
    spoil(sorted(job.journal(path).glob("viewpoint-*.bin"))[2], damage)
    counts.viewpoints = counts.cells = 0
    assert job.run(path) == job.wanted
    assert (counts.viewpoints, counts.cells) == (len(job.shared) - 5, len(job.grid))


def test_only_viewpoints_of_unfinished_cells_are_looked_from_again(job: Job, tmp_path: Path, counts: Counts) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(4))
    done, left = (
        set(np.concatenate([job.shared.of_cell(cell) for cell in some]).tolist())
        for some in (range(4), range(4, len(job.grid)))
    )
    assert done - left
    assert done & left
    spoil(job.journal(path) / name_viewpoint(min(done - left)), "cut")
    spoil(job.journal(path) / name_viewpoint(min(done & left)), "bit")
    counts.viewpoints = counts.cells = 0
    assert job.run(path) == job.wanted
    assert (counts.viewpoints, counts.cells) == (1, len(job.grid) - 4)


@pytest.mark.parametrize(
    ("stage", "name", "message"),
    [
        ("cells", name_viewpoint(0), "viewpoint of cell 0 was damaged"),
        ("check", name_cell(1), "cell 1 was damaged while the store was written"),
    ],
)
def test_what_is_damaged_during_a_build_is_named_and_made_again(
    job: Job, tmp_path: Path, counts: Counts, stage: str, name: str, message: str
) -> None:
    path = tmp_path / "scene.pvs"

    def damage(now: str, done: int, total: int) -> None:
        if (now, done) == (stage, 0):
            spoil(job.journal(path) / name, "bit")

    with pytest.raises(OSError, match=rf"{message}; .* are kept in .*run the same again to resume") as caught:
        job.run(path, progress=damage)
    assert (caught.value.errno, caught.value.filename) == (errno.EIO, str(path))
    counts.viewpoints = counts.cells = 0
    assert job.run(path) == job.wanted
    assert (counts.viewpoints, counts.cells) == ((1, len(job.grid)) if stage == "cells" else (0, 1))


def test_the_journal_stays_until_the_store_is_open(
    job: Job, tmp_path: Path, counts: Counts, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise FormatError(path, "", "a store", "another file")

    path = tmp_path / "x.pvs"
    with monkeypatch.context() as patch:
        patch.setattr(VisibilityStore, "open", refuse)
        with pytest.raises(FormatError, match="expected a store"):
            job.run(path)
    assert kept_in(job.journal(path)) == (len(job.shared), len(job.grid)) == (counts.viewpoints, counts.cells)
    assert job.run(path) == job.wanted
    assert (counts.viewpoints, counts.cells) == (len(job.shared), len(job.grid))
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.pvs"]


def test_other_settings_do_not_use_the_journal(job: Job, tmp_path: Path, counts: Counts) -> None:
    path = tmp_path / "scene.pvs"
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(6))
    other = replace(CONFIG, limit=0.5, tile_limit=1.0)
    assert job.journal(path) != job.journal(path, other)
    more = build_pvs(job.scene, job.grid, job.space, path, other)
    assert (counts.viewpoints, counts.cells) == (2 * len(job.shared), 6 + len(job.grid))
    assert more.info.config["limit"] == 0.5
    more.close()
    smaller = replace(job.space, free=job.space.free & (np.arange(job.space.free.shape[2]) > 2))
    folders = {job.journal(path), job.journal(tmp_path / "x.pvs")}
    folders.add(journal_of(job.scene, job.grid, smaller, path, CONFIG))
    folders.add(journal_of(job.scene[:-1], job.grid, job.space, path, CONFIG))
    folders |= {job.journal(path, replace(CONFIG, **{name: 1})) for name in ("rays", "max_inner", "tile_limit")}
    assert len(folders) == 7
    assert job.run(path) == job.wanted  # the first journal is still there


def _full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_keeps_what_was_found_and_what_was_there(
    job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, counts: Counts
) -> None:
    path, cells, viewpoints = tmp_path / "scene.pvs", len(job.grid), len(job.shared)
    path.write_bytes(b"what was there before")
    keep = KeptWork.keep

    def full_from(first: str) -> Any:
        stem = first.split("-")[0]
        return lambda self, name, data: _full() if name.startswith(stem) and name >= first else keep(self, name, data)

    for first, held in (
        (name_viewpoint(0), "nothing was finished"),
        (name_viewpoint(3), f"3 of {viewpoints} viewpoints and 0 of {cells} cells are kept"),
        (name_cell(5), f"{viewpoints} of {viewpoints} viewpoints and 5 of {cells} cells are kept"),
    ):
        with monkeypatch.context() as patched, pytest.raises(OSError, match=rf"{held}.*make room") as caught:
            patched.setattr(KeptWork, "keep", full_from(first))
            job.run(path)
        assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))
        assert path.read_bytes() == b"what was there before"
    with monkeypatch.context() as patched, pytest.raises(OSError, match=f"{cells} of {cells} cells are kept"):
        patched.setattr(build.StoreWriter, "finish", _full)
        job.run(path)
    looked = 1 + 4 + (viewpoints - 3), 6 + (cells - 5)
    assert (counts.viewpoints, counts.cells) == looked
    assert path.read_bytes() == b"what was there before"
    assert job.run(path) == job.wanted
    assert (counts.viewpoints, counts.cells) == looked


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
        with pytest.raises(OSError, match=r"viewpoint.*make room and run the same command again") as caught:
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


def test_the_store_holds_the_certificates_and_what_two_tracers_agree_on(job: Job, tmp_path: Path) -> None:
    (tmp_path / "scene.pvs").write_bytes(job.wanted)
    with VisibilityStore.open(tmp_path / "scene.pvs") as store:
        certified, looked = store.certificates, store.viewpoints
        twice = store.info.config["traced_twice"]
    shared = np.array([len(job.shared.of_cell(cell)) for cell in range(len(job.grid))])
    assert certified.known.all()
    assert (looked - certified.inner <= shared).all()
    assert (certified.inner <= CONFIG.max_inner + CONFIG.probes).all()
    stages = certified.rays / CONFIG.rays
    assert ((stages >= 1) & (stages <= CONFIG.max_inner + 1) & (stages == np.round(stages))).all()
    finished = (certified.bound <= CONFIG.limit) & (certified.tile <= CONFIG.tile_limit)
    assert (finished | (stages == CONFIG.max_inner + 1)).all()
    assert (certified.missed <= certified.bound).all()
    if has("open3d"):
        assert twice == {"rays": 8 * len(job.grid), "agreeing": 8 * len(job.grid), "largest_difference": 0.0}
    else:
        assert twice is None


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


@pytest.mark.parametrize("max_inner", [0, 2])
def test_a_scene_whose_shared_viewpoints_are_all_buried_is_built_from_other_points(
    tmp_path: Path, max_inner: int
) -> None:
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    balls = Gaussians(
        corners, np.tile([1.0, 0, 0, 0], (8, 1)), np.full((8, 3), 0.2), np.full(8, 0.99), np.zeros((8, 1, 3))
    )
    space = NavigableSpace.from_box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 4)
    grid = CellGrid.over(space, max_cells=1)
    shared = SharedViewpoints(CellViewpoints(grid, space)).points
    assert Solid.from_scene(balls).buries(shared).all()
    config = replace(CONFIG, max_inner=max_inner)
    with build_pvs(balls, grid, space, tmp_path / "x.pvs", config) as store:
        assert store.visible_ids(0).tolist() == list(range(8))
        assert store.viewpoints.tolist() == store.certificates.inner.tolist()
        assert store.certificates.rays[0] >= CONFIG.rays
        assert (store.direction_sets.any(axis=1)).all()


def test_a_grid_of_another_space_is_refused(job: Job, tmp_path: Path) -> None:
    elsewhere = NavigableSpace.from_box((90, 90, 90), (91, 91, 91), 4)
    with pytest.raises(ValueError, match="free voxel in every cell"):
        build_pvs(job.scene, job.grid, elsewhere, tmp_path / "x.pvs", CONFIG)
