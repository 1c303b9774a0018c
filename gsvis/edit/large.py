"""Clean a scene that does not fit the memory: in tiles, each with what lies around it.

The classes are those of `clean` but for what differs by its nature: voxels, and what counts as large, follow the size
of a tile; flyaways are judged by a sample of the scene; what is outside all tiles and no flyaway stays; and what an eye
beyond the halo of a tile might see stays too. docs/design/070-out-of-core.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.classes import CLASSES, KEPT, CleanConfig
from gsvis.errors import SceneError
from gsvis.files.archive import load_arrays
from gsvis.files.objects import ObjectStore
from gsvis.io.batches import read_batch
from gsvis.progress import Progress, silent
from gsvis.pvs.workers import Workers
from gsvis.scene.gaussians import Gaussians
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.graph import Facts, Result, Task, run_graph
from gsvis.world.tiling import OUTSIDE, Rect, TilingConfig, tile_name, tiles_of

__all__ = ["LargeCleaning", "clean_large"]


@dataclass(eq=False)
class LargeCleaning:
    """What can go from a scene of N Gaussians in tiles.

    Attributes:
        gaussians: N.
        kept: Gaussians that stay.
        sh_degree: Of the scene.
        found: Gaussians of each class before the guard gave anything back.
        removed: Gaussians that go, by class.
        worst_db: The worst PSNR of a held-out view of any tile, by class and "all"; empty without a guard.
        tiles: Tiles that were cleaned.
        around: Gaussians around them, all together.
        build: How the scene was cut.
        results: The results of the tiles.
    """

    gaussians: int
    kept: int
    sh_degree: int
    found: dict[str, int]
    removed: dict[str, int]
    worst_db: dict[str, float]
    tiles: int
    around: int
    build: WorldBuild
    results: dict[str, Result]

    @cached_property
    def _names(self) -> list[str]:
        return [tile_name((x, y, width, height)) for x, y, width, height in self.build.grid["tiles"]]

    def classes(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the classes of the Gaussians of each batch, in the order of the scene; see `Cleaning.classes`."""
        for k in range(len(self.build.batches)):
            yield self._classes_of(k, read_batch(self.build.batches[k]))

    def parts(self) -> Iterator[Gaussians]:
        """Yield what stays of each batch, in the order of the scene."""
        for k, batch in enumerate(self.build.batches):
            g = read_batch(batch)
            yield g[self._classes_of(k, g) == KEPT]

    def _classes_of(self, number: int, g: Gaussians) -> NDArray[np.uint8]:
        keys, classes = tiles_of(g.means, self.build.grid), np.zeros(len(g), np.uint8)
        for key in np.unique(keys).tolist():
            name = OUTSIDE if key < 0 else self._names[key]
            with TemporaryDirectory(prefix="gsvis-") as cache:
                result = self.results[self._home(name)]
                path = self.build.store.path_of(result.files["classes"], Path(cache))
                classes[keys == key] = load_arrays(path, sealed=True)[f"{number} {name}"]
        return classes

    def _home(self, name: str) -> str:
        """Return the task that judged the rows of a name: those of tiles with few Gaussians went to the outside."""
        return f"clean {name}" if f"clean {name}" in self.results else f"clean {OUTSIDE}"


def clean_large(
    scene: tuple[str, int | None],
    config: CleanConfig,
    tiling: TilingConfig,
    store: ObjectStore,
    *,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> LargeCleaning:
    """Find the Gaussians that can go from a scene in tiles, and resume an earlier run.

    With more than one worker, a script that calls this needs an `if __name__ == "__main__":` guard.

    Args:
        scene: Path and level of detail, as for `gsvis.io.load_scene`.
        config: As for `clean`.
        tiling: How the scene is cut. A task holds a tile and the halo around it, up to twice `most`.
        store: Where results of tasks lie.
        workers: The workers; None means this process.
        progress: Called with stages "sampling", "splitting", "eyes" and "cleaning", in tasks.

    Raises:
        SceneError: If the scene has nothing to see, or no eye can be anywhere.
        FormatError: If the scene is damaged.
        ValueError: If a tile does not fit the memory of a worker.
        OSError: If a file cannot be written; finished work is kept.
    """
    workers = workers or Workers()
    build = WorldBuild([scene], WorldConfig(tiling), store, workers, progress)
    listed = _Tasks(build, asdict(config))
    rects = [rect for rect in build.tiles if rect is not None]
    eyes = [*build.split_tasks, *(listed.eyes(rect) for rect in rects)]
    results = run_graph(eyes, store, workers, stage="eyes", progress=progress)
    facts = [results[_name("eyes", rect)].facts for rect in rects]
    bands = [(each["low"], each["high"]) for each in facts if each["voxels"]]
    if not bands:
        raise SceneError("no tile of the scene has a place for eyes; clean a level of it that fits the memory")
    band = [min(low for low, _ in bands), max(high for _, high in bands)]
    tasks = [listed.clean(rect, band) for rect in rects]
    if None in build.tiles:
        tasks.append(listed.outside())
    results = run_graph([*eyes, *tasks], store, workers, stage="cleaning", progress=progress)
    return _summary(build, {task.name: results[task.name] for task in tasks})


class _Tasks:
    """The tasks of a cleaning.

    Args:
        build: The tiles.
        config: The options as JSON values.
    """

    def __init__(self, build: WorldBuild, config: Facts) -> None:
        self._build, self._config = build, config

    def eyes(self, rect: Rect) -> Task:
        """Return the task that finds where eyes may be in a tile."""
        params, needs = self._files(rect)
        return Task(_name("eyes", rect), "gsvis.edit.tiles:find_eyes", params, needs)

    def clean(self, rect: Rect, band: list[float]) -> Task:
        """Return the task that judges a tile; `band` are the heights of eyes anywhere."""
        params, needs = self._files(rect)
        params |= {"grid": len(needs), "eyes": len(needs) + 1, "band": band, **self._common(rect)}
        return Task(_name("clean", rect), "gsvis.edit.tiles:clean_tile", params, (*needs, "grid", _name("eyes", rect)))

    def outside(self) -> Task:
        """Return the task that finds flyaways."""
        files = self._build.files[None]
        used = sorted({batch for batch, _ in files})
        samples = range(len(used), len(used) + len(self._build.batches))
        params = {
            "files": [(used.index(batch), name) for batch, name in files], "samples": list(samples),
            **self._common(None), "batches": [batch for batch, _ in files],
        }  # fmt: skip
        needs = (*(f"split {k}" for k in used), *(f"sample {k}" for k in range(len(self._build.batches))))
        return Task(_name("clean", None), "gsvis.edit.tiles:find_flyaways", params, needs)

    def _files(self, rect: Rect) -> tuple[Facts, tuple[str, ...]]:
        """Return the params of a tile, and the splits that it reads."""
        build = self._build
        own = build.files[rect]
        near = [file for k in build.touching(rect) for file in build.files[build.tiles[k]]]
        used = sorted({batch for batch, _ in (*own, *near)})
        square = build.square_of(rect)
        params = {
            "files": [(used.index(batch), name) for batch, name in own],
            "halo": [(used.index(batch), name) for batch, name in near],
            **{name: square[name] for name in ("low", "high", "axes", "up")},
        }
        return params, tuple(f"split {batch}" for batch in used)

    def _common(self, rect: Rect | None) -> Facts:
        batches = [batch for batch, _ in self._build.files[rect]]
        return {"config": self._config, "name": tile_name(rect), "batches": batches}


def _name(kind: str, rect: Rect | None) -> str:
    return f"{kind} {tile_name(rect)}"


def _summary(build: WorldBuild, results: dict[str, Result]) -> LargeCleaning:
    """Return the sums over tiles."""
    facts = [result.facts for result in results.values()]
    totals = {
        key: {name: sum(each[key].get(name, 0) for each in facts) for name in CLASSES} for key in ("found", "removed")
    }
    worst: dict[str, float] = {}
    for each in facts:
        for name, cost in each["costs"].items():
            worst[name] = min(worst.get(name, np.inf), cost["worst_db"])
    return LargeCleaning(
        gaussians=sum(each["gaussians"] for each in facts),
        kept=sum(each["kept"] for each in facts),
        sh_degree=max(build.survey[f"sample {k}"].facts["sh_degree"] for k in range(len(build.batches))),
        **totals,
        worst_db=worst,
        tiles=len(results),
        around=sum(each["around"] for each in facts),
        build=build,
        results=results,
    )
