"""Prepare a world from scenes, and resume a stopped run. See `build.py` for the stages."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_folder, atomic_path
from gsvis.files.limits import digest_of
from gsvis.files.temporary import temporary_folder
from gsvis.jobs.graph import Facts, Result
from gsvis.jobs.objects import ObjectStore, open_store
from gsvis.jobs.work_folder import WorkFolder
from gsvis.jobs.workers import Workers
from gsvis.package.manifest import MANIFEST
from gsvis.progress import Progress, silent
from gsvis.scene.judged import Judged
from gsvis.world.bare import PACKAGE
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.manifest import WORLD, BeyondTable, District, Piece, Tile, WorldManifest
from gsvis.world.tiling import grid_of
from gsvis.world.world import BEYOND, PACKAGES

__all__ = ["PreparedWorld", "check_world_target", "prepare_world"]

_OURS = re.compile(r"[0-9a-f]{64}(\.pvs)?")


@dataclass(frozen=True, eq=False)
class PreparedWorld:
    """A finished world and how it was made.

    Attributes:
        manifest: Its manifest.
        results: Results of all tasks by name, with the time and memory of each.
        nbytes: Bytes of packages and tables.
        work: The work folder, kept between runs.
    """

    manifest: WorldManifest
    results: dict[str, Result]
    nbytes: int
    work: Path


def prepare_world(
    scenes: Sequence[tuple[str, int | None]],
    out: str | os.PathLike[str],
    config: WorldConfig | None = None,
    *,
    about: Mapping[str, Any] | None = None,
    store: str | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> PreparedWorld:
    """Make a world from scenes in one frame, or resume an earlier run.

    With more than one worker, a script that calls this needs an `if __name__ == "__main__":` guard.

    Args:
        scenes: Path and level of detail of each scene, as for `gsvis.io.load_scene`.
        out: Folder of the world, by custom `city.gsworld`. Results of tasks are kept beside it, in `city.gsworld.work`.
        config: Options; None means `WorldConfig()`.
        about: JSON values to store in the provenance of the world.
        store: Address at which to keep results instead, such as `s3://bucket/city`; every worker must reach it.
        workers: The workers; None means this process.
        progress: Called with stages "sampling", "splitting", "levels", "nodes", "tiles" and "world", in tasks.

    Raises:
        SceneError: If the scenes have no visible Gaussian, or `WorldConfig.walk` comes near no tile.
        FormatError: If a scene is damaged, or the folder has other files.
        ValueError: If a tile does not fit the memory of a worker, or a second process prepares the same world.
        BackendError: If workers or store cannot be used.
        OSError: If a file cannot be written; finished work is kept.
    """
    target = _check.path("out", out)
    config = config or WorldConfig()
    check_world_target(target)
    work = WorkFolder(target)
    with work.opened():
        found = open_store(store or work.folder)
        absolute = [(os.path.abspath(path), lod) for path, lod in scenes]  # workers have folders of their own
        build = WorldBuild(absolute, config, found, workers or Workers(), progress)
        packages = build.packages
        manifest = _manifest(build, packages, about or {})
        _write(build, packages, manifest, target, progress)
        results = {**build.chosen, **{f"tile {k}": result for k, result in enumerate(packages)}}
    nbytes = sum(manifest.node(k).nbytes for k in range(len(manifest)))
    nbytes += sum(tile.beyond.nbytes for tile in manifest.tiles if tile.beyond is not None)
    return PreparedWorld(manifest, results, nbytes, work.folder)


def check_world_target(target: Path) -> None:
    """Check that a world may be written to a folder.

    Raises:
        FormatError: If the path is a file, or a folder with other files.
    """
    if target.exists() and not target.is_dir():
        raise FormatError(target, "", "a folder, or nothing", "a file", "choose another name")
    if target.is_dir():
        others = sorted(
            p.name for p in target.iterdir() if p.name not in (PACKAGES, BEYOND, WORLD) and p.name[:1] != "."
        )
        if others:
            raise FormatError(target, "", "a world or an empty folder", f"{others[0]!r}", "choose another name")


def _manifest(build: WorldBuild, packages: Sequence[Result], about: Mapping[str, Any]) -> WorldManifest:
    """Return the manifest of a world from its finished packages; `about` is added to the provenance."""
    numbers = {f"levels {k}": k for k in range(len(build.tiles))}
    districts = []
    for k, plan in enumerate(build.districts):
        facts = build.district(k).facts
        numbers[f"district {k}"] = len(build.tiles) + k
        own = facts["spacing"], facts["package"], facts["bytes"], facts["gaussians"]
        districts.append(District(plan.children, plan.tiles, *_box(facts), *own))
    tiles = []
    for rect, result in zip(build.tiles, packages, strict=True):
        facts = result.facts
        beyond = None
        if "beyond" in result.files:
            pieces = [
                Piece(numbers[each["node"]], each["level"], tuple((first, count) for first, count in each["runs"]))
                for each in facts["pieces"]
            ]
            beyond = BeyondTable(*result.files["beyond"], tuple(pieces))
        levels = tuple((name, count) for name, count in facts["levels"])
        low, high = _box(facts)
        coords, shape = (None, (1, 1)) if rect is None else (rect[:2], rect[2:])
        sizes = facts["gaussians"], facts["cells"]
        tiles.append(Tile(coords, low, high, facts["package"], facts["bytes"], levels, *sizes, beyond, shape))
    x, y, z = (float(v) for v in build.grid["up"])
    meters = build.config.package.meters_per_unit
    provenance = {**about, "angle": build.config.angle, "far": build.config.far, "most": build.config.tiling.most}
    records = [each.facts["judged"] for each in packages if each.facts.get("judged")]
    provenance["judged"] = _judged(records)
    provenance["remarks"] = build.grid["remarks"]
    return WorldManifest(
        (x, y, z), meters, grid_of(build.grid["grid"]), tuple(tiles), tuple(districts), dict(provenance)
    )


def _judged(records: Sequence[Facts]) -> dict[str, Any] | None:
    """Return the joined judgements of the visible sets of all tiles, for JSON; None if no tile has any."""
    if not records:
        return None
    found = Judged.joined(records).as_dict()
    del found["psnr"]  # the package of each tile has its own
    warned = sum(record["warning"] is not None for record in records)
    return {**found, "tiles": len(records), "tiles_warned": warned}


def _write(
    build: WorldBuild, packages: Sequence[Result], manifest: WorldManifest, target: Path, progress: Progress
) -> None:
    """Write missing packages and tables, then the manifest, and remove those that it does not name."""
    results = [*packages, *(build.district(k) for k in range(len(build.districts)))]
    progress("world", 0, len(results))
    for k, result in enumerate(results):
        _write_package(build.store, result, target / PACKAGES / manifest.node(k).package)
        if "beyond" in result.files:
            table = target / BEYOND / f"{result.files['beyond'][0]}.pvs"
            if not table.is_file() or digest_of(table) != result.files["beyond"][0]:
                table.parent.mkdir(parents=True, exist_ok=True)
                with atomic_path(table) as partial:
                    _copy(build.store, result, "beyond", partial)
        progress("world", k + 1, len(results))
    manifest.write(target / WORLD)
    names = {manifest.node(k).package for k in range(len(manifest))}
    names |= {tile.beyond.name for tile in manifest.tiles if tile.beyond is not None}
    for folder in (target / PACKAGES, target / BEYOND):
        for path in folder.iterdir() if folder.is_dir() else ():
            if path.name not in names and _OURS.fullmatch(path.name):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _write_package(store: ObjectStore, result: Result, folder: Path) -> None:
    """Write the package of a result, unless it exists with the same content."""
    names = sorted(name for name in result.files if name.startswith(f"{PACKAGE}/"))
    inner = {name.removeprefix(f"{PACKAGE}/"): result.files[name] for name in names}
    if all((folder / name).is_file() and digest_of(folder / name) == digest for name, (digest, _) in inner.items()):
        return
    folder.parent.mkdir(parents=True, exist_ok=True)
    with atomic_folder(folder, last=(MANIFEST,)) as partial:
        for name in inner:
            (partial / name).parent.mkdir(parents=True, exist_ok=True)
            _copy(store, result, f"{PACKAGE}/{name}", partial / name)


def _copy(store: ObjectStore, result: Result, name: str, to: Path) -> None:
    """Copy a file of a result from the store."""
    with temporary_folder() as cache:
        shutil.copyfile(store.path_of(result.files[name], cache), to)


def _box(facts: Facts) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the corners `low` and `high` of facts."""
    low = facts["low"]
    high = facts["high"]
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
