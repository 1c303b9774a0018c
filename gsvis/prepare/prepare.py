"""From a scene to a package that can be served: levels, visible sets, colors, active terms, records, in this order.

Everything that has ids is made for the order of the package. What was found on the way stays beside the package: a run
that is killed goes on, and one after an edit does again only what the edit changed. The same bytes come out whatever
the number of workers, and however often a run was stopped.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsvis import _check
from gsvis._extras import has, missing
from gsvis.color import quantize
from gsvis.errors import FormatError, SceneError
from gsvis.package import Package, PackageInfo, write_package
from gsvis.package.manifest import MANIFEST, Manifest
from gsvis.package.writer import check_target
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.stages import StageRecord, Stages
from gsvis.prepare.work_folder import WorkFolder
from gsvis.progress import Progress, silent
from gsvis.pvs.build import Workers
from gsvis.pvs.store import VisibilityStore
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace

__all__ = ["Prepared", "check_scene", "prepare_package", "stages_of"]


@dataclass(frozen=True, eq=False)
class Prepared:
    """A package and how it came about.

    Attributes:
        manifest: What the package holds.
        stages: What became of each stage.
        quality: How good the levels are, where they were trained for this package; see `measure_levels`.
        parts: Parts of the package.
        parts_kept: Those of them that an older package in its place had already.
        nbytes: Bytes of the parts.
        nbytes_kept: Bytes of those that were there already.
        work: The folder of what is kept between runs, and `work_bytes` its size.
        work_bytes: Its size.
        remarks: Sentences that the user should read.
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
    """Make a package of a scene, from wherever an earlier run of the same stood.

    With more than one worker, a script that calls this needs `if __name__ == "__main__":` around its doings, as all
    Python programs that start processes do.

    Args:
        scene: N Gaussians, of which levels are trained if the configuration says so; or levels that are there.
        out: Folder of the package, `scene.gsvis` by custom; an older one is replaced when the new one is whole. What is
            kept between runs lies beside it, in `scene.gsvis.work`.
        space: Where eyes may be, scene frame and units; its up axis becomes that of the package.
        config: How; None means `PrepareConfig()`.
        photos: Photographs with their cameras, to train levels on; None draws the scene.
        about: Anything that JSON can say, to be kept in the package.
        workers: Who looks for visible sets; None means this process.
        progress: Called with the stages "order", or "views" or "photos", "prune", "train NAME" and "measure"; then with
            "cells", "store", "importance", "price", "fit", "terms", "cost" and "package".

    Returns:
        What the package holds and what had to be done for it.

    Raises:
        SceneError: If the scene is empty or nothing of it can be seen.
        FormatError: If the folder holds something else, or photographs cannot be read.
        ValueError: If the scene is too small for its levels, or another process prepares the same.
        OSError: If nothing can be written; what was finished is kept.
    """
    stages = stages_of(scene, out, space, config, photos=photos, progress=progress)
    work, config, target = stages.work, stages.config, _check.path("out", out)
    with work.opened():
        before = _parts_of(target)
        levels, quality = stages.levels()
        sets = stages.sets(levels, workers)
        with VisibilityStore.open(sets, scene=levels.union) as store:
            exact, directions = stages.colors(levels, store)
            packed = quantize(exact, "wire")
            active = stages.terms(levels, packed, store)
        cost = stages.cost(levels, exact, packed)
        provenance = {**(about or {}), "config": config.as_dict(), "levels": quality, "directions": directions}
        info = PackageInfo(_axis(space), config.meters_per_unit, cost, provenance)
        began = time.perf_counter()
        with write_package(
            target, levels, packed, info=info, visibility=sets, active_terms=active, progress=progress
        ) as package:
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
    )


def stages_of(
    scene: Gaussians | Levels,
    out: str | os.PathLike[str],
    space: NavigableSpace,
    config: PrepareConfig | None,
    *,
    photos: str | os.PathLike[str] | None,
    progress: Progress,
) -> Stages:
    """The stages, once everything that can be refused at once has been looked at; see `prepare_package`.

    Raises:
        SceneError: If there is nothing to see.
        FormatError: If the target holds something else.
        ValueError: If the scene is too small for its levels, or the working folder is not free.
        FileNotFoundError: If there are no photographs.
        BackendError: If levels have to be trained and torch is missing.
    """
    config = config or PrepareConfig()
    check_scene(scene, config)
    check_target(_check.path("out", out))
    if photos is not None and not _check.path("photos", photos).exists():
        raise FileNotFoundError(2, "no such file or folder", os.fspath(photos))
    work = WorkFolder(out)
    work.check()
    stages = Stages(scene, space, config, photos, work, progress, [], [])
    if stages.trains and not has("torch") and stages.reuse_levels() is None:
        raise missing("levels: training them", "torch")
    return stages


def check_scene(scene: Gaussians | Levels, config: PrepareConfig) -> None:
    """Nothing, if a package can be made of a scene.

    Raises:
        SceneError: If there is nothing to see in it.
        ValueError: If it is too small for its levels.
    """
    union = scene.union if isinstance(scene, Levels) else scene
    if not (union.opacities >= MIN_ALPHA).any():
        raise SceneError("the scene has no Gaussian with an opacity of at least 1/255: there is nothing to see")
    if isinstance(scene, Gaussians) and config.levels is not None:
        config.levels.sizes(len(scene))


def _parts_of(folder: Path) -> set[str]:
    """Names of the parts of the package that is there; none if there is no whole one."""
    if not (folder / MANIFEST).exists():
        return set()
    try:
        with Package.open(folder) as package:
            return {part.name for part in package.manifest.parts()}
    except FormatError:
        return set()


def _axis(space: NavigableSpace) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in space.up)
    return x, y, z
