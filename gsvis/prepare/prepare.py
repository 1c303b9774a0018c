"""Prepare a package from a scene: levels, visible sets, colors, measurements, then records.

All ids follow the order of the package. Intermediate results stay beside the package. So a killed run resumes, and a
run after an edit repeats only what the edit changed. The bytes of the package do not depend on the number of workers
or on interruptions.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._extras import has, missing
from gsvis.color.sh import seen_sh_colors
from gsvis.errors import FormatError, SceneError
from gsvis.jobs.work_folder import WorkFolder
from gsvis.jobs.workers import Workers
from gsvis.package import Package, PackageInfo, write_package
from gsvis.package.manifest import MANIFEST, Manifest
from gsvis.package.rounding import rounded_contents
from gsvis.package.writer import check_target
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.stage_colors import round_colors, run_colors
from gsvis.prepare.stage_levels import reuse_levels, run_levels
from gsvis.prepare.stage_quality import run_cost, run_fidelity, run_judges, run_overdraw
from gsvis.prepare.stage_records import run_epsilon, run_rounding, run_terms
from gsvis.prepare.stage_sets import around_of, run_sets, ship_sets
from gsvis.prepare.stages import StageRecord, Stages
from gsvis.prepare.start_views import describe_start_views
from gsvis.progress import Progress, silent
from gsvis.pvs.joined import JoinedCells
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.stored_certificates import StoredCertificates
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace

__all__ = ["Prepared", "check_scene", "finish_package", "prepare_package", "stages_of"]


@dataclass(frozen=True, eq=False)
class Prepared:
    """A finished package and the record of its preparation.

    Attributes:
        manifest: Manifest of the package.
        stages: Record of each stage.
        quality: Record of the levels' quality; None if no levels were trained. See `measure_levels`.
        parts: Number of parts of the package.
        parts_kept: Number of parts that an older package in the folder already had.
        nbytes: Bytes of the parts.
        nbytes_kept: Bytes of the parts that an older package already had.
        work: The folder of work kept between runs.
        work_bytes: Bytes of that folder.
        remarks: Sentences that the user should read.
        around: The store of the visible sets of the surroundings; None without surroundings.
        certificates: Bounds on the light that the visible sets miss.
        traced_twice: Comparison of two tracers on a sample of these rays; None if there is only one tracer.
        judged: Quality of the sets at builder's and judge's eyes; see `gsvis.scene.judged.Judged`.
        joined: Sizes of cells that were tried, and what their sets cost and save; empty for a tile.
    """

    manifest: Manifest
    stages: tuple[StageRecord, ...]
    quality: dict[str, Any] | None
    parts: int
    parts_kept: int
    nbytes: int
    nbytes_kept: int
    work: Path
    work_bytes: int
    remarks: tuple[str, ...]
    around: Path | None = None
    certificates: StoredCertificates | None = None
    traced_twice: dict[str, Any] | None = None
    judged: dict[str, Any] | None = None
    joined: tuple[JoinedCells, ...] = ()

    @property
    def learned(self) -> dict[str, Any] | None:
        """What learning colors after the fit gained, see `StageColors`; None without learning."""
        return self.manifest.info.provenance.get("learned_colors")


def prepare_package(
    scene: Gaussians | Levels,
    out: str | os.PathLike[str],
    space: NavigableSpace,
    config: PrepareConfig | None = None,
    *,
    photos: str | os.PathLike[str] | None = None,
    about: Mapping[str, Any] | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> Prepared:
    """Make a package of a scene, and resume an earlier run of the same preparation.

    With more than one worker, a script that calls this needs an `if __name__ == "__main__":` guard, like every
    Python program that starts processes.

    Args:
        scene: N Gaussians, from which levels are trained unless `config.levels` is None; or levels.
        out: Folder of the package, usually `scene.gsvis`. An older package is replaced when the new one is complete.
            Work kept between runs lies beside it, in `scene.gsvis.work`.
        space: The navigable space, scene frame and units; its up axis becomes that of the package.
        config: Options; None means `PrepareConfig()`.
        photos: Photos with their cameras, to train levels and learn colors on; None trains levels on renders of the
            scene.
        about: JSON values to store in the provenance of the package.
        workers: The workers that build visible sets; None means this process.
        progress: Called with the stages "order", or "views" or "photos", "prune", "train NAME" and "measure"; then with
            "structure", "viewpoints", "cells", "check", "store", "importance", "price", "fit", "learn", "epsilon",
            "rounding", "cost", "fidelity", "judge", "fill", "terms" and "package".

    Returns:
        The manifest of the package, and what each stage did.

    Raises:
        SceneError: If the scene has nothing to see, or every viewpoint lies inside something solid.
        FormatError: If the folder holds something else, or photos cannot be read.
        ValueError: If the scene is too small for its levels, or another process prepares the same package.
        OSError: If a file cannot be written; finished work is kept.
    """
    stages = stages_of(scene, out, space, config, photos=photos, progress=progress)
    return finish_package(stages, out, about=about, workers=workers)


def finish_package(
    stages: Stages,
    out: str | os.PathLike[str],
    *,
    about: Mapping[str, Any] | None = None,
    workers: Workers | None = None,
) -> Prepared:
    """Run all stages and write the package; `prepare_package` with stages that the caller has made.

    With `stages.around`, the visible sets of the surroundings go to a separate store, `Prepared.around`, in the working
    folder.

    Args:
        stages: The stages, from `stages_of`.
        out: Folder of the package, as given to `stages_of`.
        about: JSON values to store in the provenance of the package.
        workers: The workers that build visible sets; None means this process.

    Raises:
        GsvisError: As `prepare_package` does.
        ValueError: If another process prepares the same package.
        OSError: If a file cannot be written; finished work is kept.
    """
    work = stages.work
    config = stages.config
    target = _check.path("out", out)
    with work.opened():
        before = _parts_of(target)
        levels, quality = run_levels(stages)
        sets = run_sets(stages, levels, workers)
        with VisibilityStore.open(sets, scene=levels.union) as store:
            colors = run_colors(stages, levels, store)
            exact = colors.exact
            packed = stages.lay_away(round_colors(stages, exact))
            epsilon = run_epsilon(stages, levels, packed)
            limits, packed = run_rounding(stages, levels, exact, packed)
            cost = run_cost(stages, levels, exact, packed, limits)
            contents = stages.lay_away(rounded_contents(levels, packed, limits))
            shipped = ship_sets(stages, store)
        with VisibilityStore.open(shipped, scene=levels.union) as store:
            fidelity = run_fidelity(stages, levels, exact, contents, store, epsilon.value)
            judged = run_judges(stages, levels, store)
            overdraw = run_overdraw(stages, levels, store)
            listed = run_terms(stages, levels, contents, store, epsilon.value)
            certificates = store.certificates
            twice = store.info.config.get("traced_twice")
        began = time.perf_counter()
        views = _find_start_views(stages, levels)
        found = {"levels": quality, "directions": colors.directions, "views": views, "judged": judged}
        found |= _known(learned_colors=colors.learned, overdraw=overdraw, staircase=epsilon.staircase)
        provenance = {**(about or {}), "config": config.as_dict(), **found}
        info = PackageInfo(_axis(stages.space), config.meters_per_unit, cost, provenance, fidelity, epsilon.value)
        parts: dict[str, Any] = {"visibility": shipped, "active_terms": listed}
        with write_package(target, levels, contents, info=info, **parts, progress=stages.progress) as package:
            manifest = package.manifest
        sizes = {part.name: part.nbytes for part in manifest.parts()}
        kept = {name: size for name, size in sizes.items() if name in before}
        stages.records.append(StageRecord("package", len(kept) == len(sizes), time.perf_counter() - began))
        work.clear()
    return Prepared(
        manifest,
        tuple(stages.records),
        quality,
        len(sizes),
        len(kept),
        sum(sizes.values()),
        sum(kept.values()),
        work.folder,
        work.nbytes,
        tuple(stages.remarks),
        None if stages.around is None else work.folder / around_of(sets.name),
        certificates,
        twice,
        judged,
        stages.joined,
    )


def _find_start_views(stages: Stages, levels: Levels) -> list[dict[str, Any]]:
    """Return the start views of the highest level, of which no harmonics are copied: pictures of objects need few."""
    last = len(levels) - 1
    ids = np.flatnonzero(levels.member(last))

    def colors_of(some: NDArray[np.int64], eye: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the colors of some Gaussians of the level."""
        return seen_sh_colors(levels.union, ids[some], eye)

    highest = levels.bare_level(last)
    found = describe_start_views(highest, stages.space, seed=stages.config.level_views.seed, colors_of=colors_of)
    stages.rest()
    return found


def _known(**found: dict[str, Any] | None) -> dict[str, dict[str, Any]]:
    """Return what was found; without what is None."""
    return {name: value for name, value in found.items() if value is not None}


def stages_of(
    scene: Gaussians | Levels,
    out: str | os.PathLike[str],
    space: NavigableSpace,
    config: PrepareConfig | None,
    *,
    photos: str | os.PathLike[str] | None,
    progress: Progress,
) -> Stages:
    """Return the stages, after every check that needs no work; see `prepare_package`.

    Raises:
        SceneError: If the scene has nothing to see.
        FormatError: If the target folder holds something else.
        ValueError: If the scene is too small for its levels, or the working folder holds something else.
        FileNotFoundError: If `photos` does not exist.
        BackendError: If levels have to be trained and torch is missing.
    """
    config = config or PrepareConfig()
    if isinstance(scene, Gaussians) and config.levels is not None:
        config = replace(config, levels=config.levels.fit_to(len(scene)))
    check_scene(scene, config)
    check_target(_check.path("out", out))
    if photos is not None and not _check.path("photos", photos).exists():
        raise FileNotFoundError(2, "no such file or folder", os.fspath(photos))
    work = WorkFolder(out)
    work.check()
    stages = Stages(scene, space, config, photos, work, progress, [], [])
    if stages.trains and not has("torch") and reuse_levels(stages) is None:
        raise missing("levels: training them", "torch")
    return stages


def check_scene(scene: Gaussians | Levels, config: PrepareConfig) -> None:
    """Raise unless a scene can become a package.

    Raises:
        SceneError: If the scene has nothing to see.
        ValueError: If the scene is too small for its levels.
    """
    union = scene.union if isinstance(scene, Levels) else scene
    if not (union.opacities >= MIN_ALPHA).any():
        raise SceneError("the scene has no Gaussian with an opacity of at least 1/255: there is nothing to see")
    if isinstance(scene, Gaussians) and config.levels is not None:
        config.levels.sizes(len(scene))


def _parts_of(folder: Path) -> set[str]:
    """Return the names of the parts of the package in a folder; empty if it holds no valid package."""
    if not (folder / MANIFEST).exists():
        return set()
    try:
        with Package.open(folder) as package:
            return {part.name for part in package.manifest.parts()}
    except FormatError:
        return set()


def _axis(space: NavigableSpace) -> tuple[float, float, float]:
    """Return the up axis of a space as a tuple."""
    x, y, z = (float(v) for v in space.up)
    return x, y, z
