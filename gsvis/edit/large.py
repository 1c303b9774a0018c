"""Clean a scene that does not fit into memory, tile by tile, each within a coarse version of the whole scene.

Classes, eyes, air and voxels are those of `clean`. Three things differ. Occluders far from a tile are coarse, so
slightly more or fewer Gaussians count as seen. A sample of the scene decides on flyaways. Gaussians outside all tiles
stay unless they are flyaways. docs/design/036-cleaning.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.classes import CLASSES, HIDDEN, KEPT, CleanConfig, class_of
from gsvis.edit.parcels import AROUND
from gsvis.files.archive import load_arrays
from gsvis.files.temporary import temporary_folder
from gsvis.io.batches import facts_of_batches, read_batch
from gsvis.jobs.graph import Facts, Result, Task, run_graph
from gsvis.jobs.objects import ObjectStore
from gsvis.jobs.workers import Workers
from gsvis.progress import Progress, silent
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judged import Judged
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.tiling import OUTSIDE, Rect, TilingConfig, tile_name, tiles_of

__all__ = ["JOINT", "LargeCleaning", "clean_large"]

JOINT = 2.2
"""Gaussians that a task holds, of the tile, its halo and what stands for the rest, in those of the tile at most."""


@dataclass(eq=False)
class LargeCleaning:
    """Gaussians that can go from a scene of N Gaussians in tiles.

    Attributes:
        gaussians: N.
        kept: Number of Gaussians that stay.
        sh_degree: SH degree of the scene.
        found: Number of Gaussians of each class before the guard restored some.
        removed: Number of Gaussians that go, by class.
        worst_db: The worst PSNR of a held-out view of any tile, by class and "all"; empty without a guard.
        tiles: Number of tiles that were cleaned.
        around: Number of Gaussians around them, in total.
        back: Classes that were restored, because all tiles together would show too much of them.
        build: The division into tiles.
        results: The results of the tiles.
        judged: Quality at builder's and judge's eyes in all tiles; None without a guard.
    """

    gaussians: int
    kept: int
    sh_degree: int
    found: dict[str, int]
    removed: dict[str, int]
    worst_db: dict[str, float]
    tiles: int
    around: int
    back: frozenset[str]
    build: WorldBuild
    results: dict[str, Result]
    judged: Judged | None = None

    @cached_property
    def _tile_names(self) -> list[str]:
        """Names of all tiles of the grid."""
        return [tile_name((x, y, width, height)) for x, y, width, height in self.build.grid["tiles"]]

    def classes(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the classes of the Gaussians of each batch, in the order of the scene; see `Cleaning.classes`."""
        for k in range(len(self.build.batches)):
            yield self._classes_of(k, read_batch(self.build.batches[k]))

    @cached_property
    def facts(self) -> SceneFacts:
        """The facts of the scene."""
        return facts_of_batches(self.build.batches)

    def parts(self) -> Iterator[Gaussians]:
        """Yield the Gaussians that stay of each batch, in the order of the scene."""
        for k, batch in enumerate(self.build.batches):
            g = read_batch(batch)
            yield g[self._classes_of(k, g) == KEPT]

    def _classes_of(self, number: int, g: Gaussians) -> NDArray[np.uint8]:
        """Return the classes of the Gaussians of a batch."""
        keys = tiles_of(g.means, self.build.grid)
        classes = np.zeros(len(g), np.uint8)
        for key in np.unique(keys).tolist():
            name = OUTSIDE if key < 0 else self._tile_names[key]
            with temporary_folder() as cache:
                result = self.results[self._class_task(name)]
                path = self.build.store.path_of(result.files["classes"], cache)
                classes[keys == key] = load_arrays(path, sealed=True)[f"{number} {name}"]
        classes[np.isin(classes, [class_of(name) for name in self.back])] = KEPT
        return classes

    def _class_task(self, name: str) -> str:
        """Return the task that classified the rows of a name; tiles with few Gaussians were joined to the outside."""
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
        tiling: The division into tiles. A task holds a tile and its surroundings, up to `JOINT` times `most`.
        store: Storage of the results of tasks.
        workers: The workers; None means this process.
        progress: Called with stages "sampling", "splitting", "space" and "cleaning", in tasks.

    Raises:
        SceneError: If nothing of the scene can be seen, or it has no navigable space.
        FormatError: If the scene is damaged.
        ValueError: If a tile does not fit into the memory of a worker.
        OSError: If a file cannot be written; finished work is kept.
    """
    workers = workers or Workers()
    build = WorldBuild([scene], WorldConfig(tiling), store, workers, progress)
    listed = _Tasks(build, asdict(config))
    rects = [rect for rect in build.tiles if rect is not None]
    tasks = [*build.split_tasks, *(listed.rows(rect) for rect in build.tiles), listed.survey()]
    survey = run_graph(tasks, store, workers, stage="space", progress=progress)["survey"]
    parcels = [listed.parcel(k, survey.facts) for k in range(len(survey.facts["parcels"]))]
    tasks += [*parcels, listed.whole(parcels), *(listed.merge(rect) for rect in build.tiles), listed.far()]
    run_graph(tasks, store, workers, stage="space", progress=progress)
    tasks += [listed.clean(rect) for rect in rects]
    if None in build.tiles:
        tasks.append(listed.outside())
    results = run_graph(tasks, store, workers, stage="cleaning", progress=progress)
    return _summary(
        build, {_task_name("clean", rect): results[_task_name("clean", rect)] for rect in build.tiles}, config
    )


class _Tasks:
    """The tasks of a cleaning.

    Args:
        build: The tiles.
        config: The options as JSON values.
    """

    def __init__(self, build: WorldBuild, config: Facts) -> None:
        self._build = build
        self._config = config

    def rows(self, rect: Rect | None) -> Task:
        """Return the task that joins the rows of a tile."""
        files = self._build.files[rect]
        used = sorted({batch for batch, _ in files})
        params = {"files": [(used.index(batch), name) for batch, name in files]}
        needs = tuple(f"split {batch}" for batch in used)
        return Task(_task_name("rows", rect), "gsvis.edit.tiles:gather_rows", params, needs)

    def survey(self) -> Task:
        """Return the task that finds navigable space by one grid over the whole scene."""
        rows = self._rows(self._build.tiles)
        samples, numbers = self._samples(len(rows))
        params = {"tiles": len(rows), "samples": numbers, "every": self._build.every, "up": self._build.grid["up"]}
        return Task("survey", "gsvis.edit.tiles:survey_scene", params, (*rows, *samples))

    def parcel(self, number: int, survey: Facts) -> Task:
        """Return the task that finds navigable space in a parcel, by the facts of the survey."""
        build = self._build
        square = survey["parcels"][number]
        near = [rect for rect in build.tiles if rect is None or _meets(build.square_of(rect), square)]
        params = {"square": square, "is_object": survey["kind"]["kind"] == "object"}
        params |= {name: survey[name] for name in ("low", "high")}
        return Task(f"parcel {number}", "gsvis.edit.tiles:find_parcel", params, self._rows(near))

    def whole(self, parcels: Sequence[Task]) -> Task:
        """Return the task that combines the results for the whole scene."""
        rows = self._rows(self._build.tiles)
        samples, numbers = self._samples(len(rows))
        needs = (*rows, *samples, "survey", *(task.name for task in parcels))
        survey = len(rows) + len(samples)
        params = {"tiles": len(rows), "samples": numbers, "survey": survey, "config": self._config}
        params["parcels"] = list(range(survey + 1, len(needs)))
        return Task("whole", "gsvis.edit.tiles:find_whole", params, needs)

    @cached_property
    def _most_touching(self) -> int:
        """Most tiles that touch one."""
        return max((len(self._build.touching(rect)) for rect in self._build.tiles if rect), default=0)

    def merge(self, rect: Rect | None) -> Task:
        """Return the task that merges a tile to few Gaussians; all merged tiles together have fewer than `most`."""
        build = self._build
        most = build.config.tiling.most
        near = max(1, most // (4 * max(1, self._most_touching)))
        params = {"near": near, "far": max(1, most // (8 * len(build.tiles)))}
        return Task(
            _task_name("merge", rect), "gsvis.edit.tiles:merge_tile", params, (_task_name("rows", rect), "whole")
        )

    def far(self) -> Task:
        """Return the task that joins all tiles, merged to fewest Gaussians, so that no tile reads each of them."""
        merged = tuple(_task_name("merge", rect) for rect in self._build.tiles)
        return Task("far", "gsvis.edit.tiles:join_far", {}, merged)

    def clean(self, rect: Rect) -> Task:
        """Return the task that classifies the Gaussians of a tile."""
        build = self._build
        touching = build.touching(rect)
        rows = self._rows([rect, *(build.tiles[k] for k in touching)])
        near = [*touching, *(k for k, each in enumerate(build.tiles) if each is None)]
        square = build.square_of(rect)
        params = {
            "whole": len(rows),
            "tile": build.tiles.index(rect),
            "near": {str(k): [len(rows) + 2 + i, k in touching] for i, k in enumerate(near)},
            **{name: square[name] for name in ("low", "high", "axes")},
            "room": int(JOINT * build.config.tiling.most),
            **self._tile_params(rect),
        }
        merged = (_task_name("merge", build.tiles[k]) for k in near)
        needs = (*rows, "whole", "far", *merged)
        return Task(_task_name("clean", rect), "gsvis.edit.tiles:clean_tile", params, needs)

    def outside(self) -> Task:
        """Return the task that finds flyaways."""
        samples, numbers = self._samples(1)
        params = {"samples": numbers, **self._tile_params(None)}
        return Task(
            _task_name("clean", None), "gsvis.edit.tiles:find_flyaways", params, (_task_name("rows", None), *samples)
        )

    def _rows(self, tiles: Sequence[Rect | None]) -> tuple[str, ...]:
        """Return the tasks that join the rows of tiles."""
        return tuple(_task_name("rows", rect) for rect in tiles)

    def _samples(self, after: int) -> tuple[tuple[str, ...], list[int]]:
        """Return all samples, and their numbers among the inputs of a task that come after some others."""
        count = len(self._build.batches)
        return tuple(f"sample {k}" for k in range(count)), list(range(after, after + count))

    def _tile_params(self, rect: Rect | None) -> Facts:
        """Return the parameters that tasks of a tile share."""
        files = [f"{batch} {name}" for batch, name in self._build.files[rect]]
        return {"config": self._config, "name": tile_name(rect), "files": files}


def _meets(tile: Facts, square: Facts) -> bool:
    """Return whether a tile overlaps a parcel or its surroundings."""
    low = np.array(square["low"])
    high = np.array(square["high"])
    reach = AROUND * (high - low).max()
    return bool(np.all((np.array(tile["low"]) < high + reach) & (np.array(tile["high"]) > low - reach)))


def _task_name(kind: str, rect: Rect | None) -> str:
    """Return the name of the task of a kind for a tile."""
    return f"{kind} {tile_name(rect)}"


def _summary(build: WorldBuild, results: dict[str, Result], config: CleanConfig) -> LargeCleaning:
    """Return the sums over tiles. Restore fog or floaters if all tiles together show too much of them."""
    facts = [result.facts for result in results.values()]
    totals = {
        key: {name: sum(each[key].get(name, 0) for each in facts) for name in CLASSES} for key in ("found", "removed")
    }
    worst: dict[str, float] = {}
    changed: dict[str, float] = {}
    for each in facts:
        for name, cost in each["costs"].items():
            worst[name] = min(worst.get(name, np.inf), cost["worst_db"])
            if each["removed"].get(name, 0):
                changed[name] = changed.get(name, 0.0) + cost["changed"]
    back = {name for name, share in changed.items() if name not in HIDDEN and share > config.most_changed}
    removed = {name: 0 if name in back else count for name, count in totals["removed"].items()}
    gaussians = sum(each["gaussians"] for each in facts)
    judged = [each["judged"] for each in facts if each.get("judged")]
    return LargeCleaning(
        gaussians=gaussians,
        kept=gaussians - sum(removed.values()),
        sh_degree=max(build.survey[f"sample {k}"].facts["sh_degree"] for k in range(len(build.batches))),
        found=totals["found"],
        removed=removed,
        worst_db=worst,
        tiles=len(results),
        around=sum(each["around"] for each in facts),
        back=frozenset(back),
        build=build,
        results=results,
        judged=Judged.joined(judged) if judged else None,
    )
