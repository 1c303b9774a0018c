"""Targets: what gsvis keeps on disk: levels, colors, visible sets, active terms, journals, kept files, checkpoints."""

from __future__ import annotations

import zipfile
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from gsvis.color.storage import load_srbf, save_srbf, srbf_info
from gsvis.errors import FormatError
from gsvis.files.sums import seal
from gsvis.io.levels import MAP, levels_info, load_levels, save_levels
from gsvis.jobs.resume import KeptWork
from gsvis.package.active_terms import ActiveTerms
from gsvis.pvs._journal import (
    find_kept,
    name_cell,
    name_viewpoint,
    pack_sighting,
    pack_view,
    read_sighting,
    read_view,
)
from gsvis.pvs.cell_view import CellView, Figures
from gsvis.pvs.joined import join_until_small
from gsvis.pvs.sightings import Sighting
from gsvis.pvs.store import CellSet, VisibilityStore, write_store
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import random_scene
from gsvis.train.checkpoint import load_checkpoint, save_checkpoint
from gsvis.train.densify import DensifyConfig
from gsvis.train.images import PosedImages
from gsvis.train.initial import gaussians_from_points
from gsvis.train.trainer import TrainConfig, Trainer
from tests.fuzz.cameras import files_in
from tests.fuzz.targets import Case, Target, change_files
from tests.package.worlds import colors_of, levels_of, lists_of
from tests.train.photo_files import cameras, cloud, pictures

__all__ = ["TARGETS"]

N, CELLS = 70, 6
SEEN = 40
"""Gaussians of the scene of a journal."""


def level_folders() -> list[Case]:
    """Levels, and some of which one has no Gaussians of its own."""
    levels, made = levels_of(20), []
    first = np.where(levels.first == 1, 0, levels.first).astype(np.uint8)
    for each in (levels, Levels(levels.union, first, levels.last, levels.names)):
        with TemporaryDirectory() as folder:
            save_levels(each, folder, {"up": [0, 0, 1]})
            made.append(files_in(Path(folder)))
    return made


def in_levels(folder: Path, case: Case) -> None:
    levels_info(folder)
    found = load_levels(folder)
    assert np.isfinite(found.union.means).all()


def change_levels(rng, case: Case, target: Target) -> Case:  # type: ignore[no-untyped-def]
    """Change a file; a changed PLY gets its new digest into the map, mostly."""
    from tests.fuzz.containers import reheaded

    found = change_files(rng, case, target)
    if MAP in found and rng.random() < 0.7:
        found[MAP] = reheaded(found[MAP], found)
    return found


def color_files() -> list[Case]:
    g, made = random_scene(np.random.default_rng(0), 10), []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.arrow"
        for variant in ("rgb", "hsl"):
            exact, _ = colors_of(10, variant)
            for precision in (None, "wire"):
                save_srbf(path, g, exact, precision=precision, provenance={"a": 1})
                made.append({"a.arrow": path.read_bytes()})
    return made


def in_colors(folder: Path, case: Case) -> None:
    (name,) = case
    srbf_info(folder / name)
    g, colors = load_srbf(folder / name)
    assert len(g) == len(colors)


@cache
def both_stores() -> tuple[bytes, bytes]:
    levels, (exact, _) = levels_of(N), colors_of(N)
    with TemporaryDirectory() as folder:
        lists = lists_of(Path(folder), levels, exact, CELLS)
        return lists.with_name("w.pvs").read_bytes(), lists.read_bytes()


@cache
def sparse_store() -> bytes:
    """Visible sets of the same scene in which some cells see nothing, or Gaussians of the first half alone."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.pvs"
        path.write_bytes(both_stores()[0])
        with VisibilityStore.open(path) as store:
            grid, info = store.grid, store.info
        sets = [CellSet(ids := np.arange(N // 2 * (k % 3 > 0)), (ids % 2).astype(np.uint8), 4) for k in range(CELLS)]
        write_store(path, grid, info, sets, np.zeros((N, 10), np.uint8))
        return path.read_bytes()


@cache
def shared_store() -> bytes:
    """The visible sets as in a package seen from around: neighbors share direction sets and changes of classes."""
    with TemporaryDirectory() as folder:
        own, shared = (Path(folder) / name for name in ("a.pvs", "b.pvs"))
        own.write_bytes(both_stores()[0])
        with VisibilityStore.open(own) as store:
            join_until_small(store, shared, may_join=False, in_runs=True)
        return shared.read_bytes()


def in_visibility(folder: Path, case: Case) -> None:
    (name,) = case
    with VisibilityStore.open(folder / name) as store:
        store.verify()
        for cell in range(min(len(store), 3)):
            ids = store.visible_ids(cell)
            assert not len(ids) or 0 <= ids[0] <= ids[-1] < store.gaussians
            store.classes(cell)
            store.neighbors(cell)
        assert store.direction_sets.shape == (store.gaussians, 10)
        store.ever_visible()
        store.sizes()
        certified = store.certificates
        assert len(certified.bound) == len(certified.rays) == len(store)
        known = certified.bound[certified.known]
        assert ((known >= 0.0) & (known <= 1.0)).all()
        certified.as_dict()
        near = store.distance_to_visibility(0, within=0.0)
        assert (store.distance_to_visibility(0) <= near).all()
        assert np.isin(near, (0.0, np.inf)).all()
        with pytest.raises(ValueError, match="within"):
            store.distance_to_visibility(0, within=-1.0)
    with pytest.raises(ValueError, match="closed"):
        store.verify()


def in_terms(folder: Path, case: Case) -> None:
    (name,) = case
    with ActiveTerms.open(folder / name) as store:
        store.verify()
        ids = store.active_ids(0)
        assert not len(ids) or ids[-1] < store.info.terms
        store.share(0)
        with pytest.raises(ValueError, match="cell"):
            store.share(len(store))
    with pytest.raises(ValueError, match="closed"):
        store.active_ids(1)


def kept_files() -> list[Case]:
    rng = np.random.default_rng(0)
    with TemporaryDirectory() as folder:
        kept = KeptWork(Path(folder), {"a": 1})
        arrays = {"sets": rng.integers(0, 255, (12, 10)).astype(np.uint8), "weights": rng.random(5)}
        kept.keep_arrays("kept.npz", {**arrays, "done": np.array(3)})
        return [{"kept.npz": (Path(folder) / "kept.npz").read_bytes()}]


LIKE = {"sets": ((12, 10), np.uint8), "weights": ((5,), np.float64), "done": ((), np.int64)}


def in_kept(folder: Path, case: Case) -> None:
    work = KeptWork(folder, {"a": 1})
    assert work.names() == set(case)
    assert KeptWork(folder / "none", {"a": 1}).names() == set()
    found = work.read_arrays("kept.npz", LIKE)
    for name, array in found.items():
        assert (array.shape, array.dtype.type) == LIKE[name]


def journals() -> list[Case]:
    rng, found = np.random.default_rng(0), {}
    for k in range(3):
        ids = np.flatnonzero(rng.random(SEEN) < 0.5).astype(np.int32)
        classes, figures = (ids % 3).astype(np.uint8), Figures(4 + k, k, 256, 0.001, 0.002, 0.0)
        directions = rng.integers(0, 256, (len(ids), 10)).astype(np.uint8)
        view = CellView(ids, classes, directions, figures, rng.normal(size=(k, 6)))
        found[name_cell(k)] = seal(pack_view(view))
        sighting = Sighting(rng.normal(size=3), 1, ids, (ids % 9 - 6).astype(np.int8))
        found[name_viewpoint(k)] = seal(pack_sighting(sighting))
    return [{**found, "plan.json": b"{}\n"}]


def in_journal(folder: Path, case: Case) -> None:
    work = KeptWork(folder, {})
    with work.opened():
        seen, found = find_kept(work, 3, 3, SEEN)
        for number in seen:
            sighting = read_sighting(work, number, SEEN)
            assert sighting is not None
            assert len(sighting.classes) == len(sighting.ids) <= SEEN
        for cell in found:
            view = read_view(work, cell, SEEN)
            assert view is not None
            assert len(view.classes) == len(view.directions) == len(view.ids) <= SEEN
            assert view.checked.shape[1] == 6


@cache
def trainer(densify: bool = True) -> Trainer:
    rules = DensifyConfig(start=3, stop=18, every=5, threshold=1e-5, reset_every=0) if densify else None
    views, held_out = PosedImages(cameras(), pictures()).split(5)
    return Trainer(
        views, gaussians_from_points(cloud()), TrainConfig(iterations=4, sh_degree=1, densify=rules), held_out=held_out
    )


def checkpoints() -> list[Case]:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.checkpoint"
        found = []
        for densify in (True, False):
            save_checkpoint(path, trainer(densify))
            found.append({"densified.npz" if densify else "plain.npz": path.read_bytes()})
        with zipfile.ZipFile(path, "a") as archive:
            archive.comment = b""  # as earlier versions wrote them, without a checksum
        return [*found, {"earlier.npz": path.read_bytes()}]


def in_checkpoint(folder: Path, case: Case) -> None:
    (name,) = case
    run = trainer(name == "densified.npz")
    load_checkpoint(folder / name, run)
    values = run.parameters.values
    assert len({len(value) for value in values.values()}) == 1


PVS, FILES, JOBS = "gsvis.pvs.", "gsvis.files.", "gsvis.jobs."
TRAIN, IO = "gsvis.train.", "gsvis.io."

TARGETS = [
    Target(
        "levels",
        level_folders,
        in_levels,
        (FormatError, FileNotFoundError),
        {MAP: "arrow"},
        change_levels,
        (IO + "levels", FILES + "arrow"),
    ),
    Target(
        "color",
        color_files,
        in_colors,
        kinds={"a.arrow": "arrow"},
        modules=("gsvis.color.storage", FILES + "arrow", FILES + "fields"),
    ),
    Target(
        "visibility",
        lambda: [{"a.pvs": data} for data in (both_stores()[0], sparse_store(), shared_store())],
        in_visibility,
        kinds={"a.pvs": "pvs"},
        modules=(PVS + "store", PVS + "stored_certificates", PVS + "run_classes", FILES + "sections", PVS + "codec"),
        weight=1.5,
    ),
    Target(
        "active-terms",
        lambda: [{"a.arrow": both_stores()[1]}],
        in_terms,
        kinds={"a.arrow": "active"},
        modules=("gsvis.package.active_terms",),
    ),
    Target("kept", kept_files, in_kept, (), modules=(JOBS + "resume", FILES + "archive"), refuses=False),
    Target(
        "journal",
        journals,
        in_journal,
        (),
        {name(k): kind for k in range(3) for name, kind in ((name_cell, "view"), (name_viewpoint, "sighting"))},
        modules=(PVS + "_journal", JOBS + "resume"),
        refuses=False,
    ),
    Target(
        "checkpoint",
        checkpoints,
        in_checkpoint,
        modules=(TRAIN + "checkpoint", FILES + "archive"),
        weight=0.5,
        beginnings=("checkpoint: expected ",),  # another run's
    ),
]
