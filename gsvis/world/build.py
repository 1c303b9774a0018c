"""Prepare a world: cut scenes into tiles, make levels, districts and packages as graphs of tasks, write the manifest.

Nothing but counters is as large as the scene: this process holds names and sizes, a worker one batch or one tile with
what stands around it. What is finished stays in a store beside the world, so that a killed run resumes. The bytes of
the world do not depend on workers, on order, or on kills. docs/design/057-worlds.md, 058-graphs-of-tasks.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gsvis.errors import SceneError
from gsvis.files.objects import ObjectStore
from gsvis.io.batches import Batch, list_batches
from gsvis.progress import Progress
from gsvis.pvs.workers import Workers
from gsvis.world.config import WorldConfig
from gsvis.world.graph import Facts, Result, Task, run_graph
from gsvis.world.tiling import grid_of, sampling_interval, tile_name

__all__ = ["Coords", "WorldBuild"]

Coords = tuple[int, int] | None
"""The square of a tile; None outside all squares."""

_GUESSED = 1 << 18  # Gaussians of a batch that only reading counts
_FEWEST = 64  # Gaussians of a tile; fewer go to the outside
_SHARE = 1e-3  # and of `most`


@dataclass(eq=False)
class WorldBuild:
    """One preparation, stage by stage; each property runs the graph of a stage when it is first asked for.

    Attributes:
        scenes: Path and level of detail of each scene.
        config: The options.
        store: Where results lie.
        workers: The workers.
        progress: Called with stages "sampling", "splitting", "levels" and "tiles".
    """

    scenes: Sequence[tuple[str, int | None]]
    config: WorldConfig
    store: ObjectStore
    workers: Workers
    progress: Progress

    @cached_property
    def batches(self) -> list[Batch]:
        """All batches of all scenes."""
        return [batch for path, lod in self.scenes for batch in list_batches(path, lod)]

    @cached_property
    def _survey_tasks(self) -> list[Task]:
        every = sampling_interval(sum(b.count if b.count >= 0 else _GUESSED for b in self.batches))
        samples = [
            Task(f"sample {k}", "gsvis.world.tiling:sample_rows", {"batch": asdict(batch), "every": every})
            for k, batch in enumerate(self.batches)
        ]
        params = {"config": asdict(self.config.tiling), "every": every}
        return [*samples, Task("grid", "gsvis.world.tiling:find_grid", params, tuple(task.name for task in samples))]

    @cached_property
    def survey(self) -> dict[str, Result]:
        """The samples, and the grid under "grid"."""
        return self._run(self._survey_tasks, "sampling")

    @cached_property
    def grid(self) -> Facts:
        """Facts of the grid."""
        return self.survey["grid"].facts

    @cached_property
    def _split_tasks(self) -> list[Task]:
        splits = [
            Task(f"split {k}", "gsvis.world.tiling:split_batch", {"batch": asdict(batch)}, ("grid",))
            for k, batch in enumerate(self.batches)
        ]
        return [*self._survey_tasks, *splits]

    @cached_property
    def splits(self) -> list[Result]:
        """The files of rows of each batch, one for each tile in it."""
        _ = self.survey
        found = self._run(self._split_tasks, "splitting")
        return [found[f"split {k}"] for k in range(len(self.batches))]

    @cached_property
    def files(self) -> dict[Coords, list[tuple[int, str]]]:
        """For each tile, by square and the outside last: number of the batch and name of each of its files.

        Squares with very few Gaussians go to the outside.
        """
        counts: dict[str, int] = {}
        where: dict[str, list[tuple[int, str]]] = {}
        for k, result in enumerate(self.splits):
            for name, count in result.facts["counts"].items():
                counts[name] = counts.get(name, 0) + count
                where.setdefault(name, []).append((k, name))
        least = max(_FEWEST, int(_SHARE * self.config.tiling.most))
        found: dict[Coords, list[tuple[int, str]]] = {}
        shape = self.grid["grid"]["shape"]
        for x in range(shape[0]):
            for y in range(shape[1]):
                name = tile_name((x, y))
                if counts.get(name, 0) >= least:
                    found[x, y] = where.pop(name)
        if not found:
            raise SceneError(f"no square of the grid has {least} Gaussians or more; use larger tiles, or gsvis prepare")
        if where:
            found[None] = sorted(file for files in where.values() for file in files)
        return found

    @cached_property
    def tiles(self) -> list[Coords]:
        """The tiles, in the order of the manifest."""
        return list(self.files)

    @cached_property
    def districts(self) -> list[tuple[int, tuple[int, int], tuple[int, ...]]]:
        """Size, place and tiles of each district, smallest first."""
        found = []
        size, shape = 1, self.grid["grid"]["shape"]
        while True:
            members: dict[tuple[int, int], list[int]] = {}
            for k, coords in enumerate(self.tiles):
                if coords is not None:
                    members.setdefault((coords[0] // size, coords[1] // size), []).append(k)
            found += [(size, place, tuple(tiles)) for place, tiles in sorted(members.items())]
            if size >= max(shape):
                return found
            size *= 2

    @cached_property
    def _level_tasks(self) -> list[Task]:
        package = self.config.package.as_dict()
        tasks = list(self._split_tasks)
        for k, coords in enumerate(self.tiles):
            files = self.files[coords]
            used = sorted({batch for batch, _ in files})
            listed: Facts = {"files": [(used.index(batch), name) for batch, name in files]}
            needs = tuple(f"split {batch}" for batch in used)
            tasks.append(Task(f"rows {k}", "gsvis.world.tiles:gather_rows", listed, needs))
        for k, coords in enumerate(self.tiles):
            needs = (f"rows {k}",)
            if coords is not None:
                near = tuple(f"rows {other}" for other in self._around(coords))
                tasks.append(Task(f"space {k}", "gsvis.world.tiles:tile_space", self._square(coords), (*needs, *near)))
                needs = (*needs, f"space {k}")
            params: Facts = {"config": package, "most": self.config.far}
            tasks.append(Task(f"levels {k}", "gsvis.world.tiles:make_tile_levels", params, needs))
        about = {"most": self.config.far, "up": self.grid["up"], "meters_per_unit": package["meters_per_unit"]}
        for size, place, tiles in self.districts:
            needs = (f"levels {tiles[0]}",)
            if size > 1:
                below = [(size // 2, each) for each in _children(place)]
                known = {(s, p) for s, p, _ in self.districts}
                needs = tuple(_district(*each) for each in below if each in known)
            params = {"of_tile": size == 1, **about}
            tasks.append(Task(_district(size, place), "gsvis.world.districts:make_district", params, needs))
        return tasks

    @cached_property
    def _node_tasks(self) -> list[Task]:
        rows = [{"size": size, "coords": place, "tiles": tiles} for size, place, tiles in self.districts]
        needs = tuple(_district(size, place) for size, place, _ in self.districts)
        options = {"districts": rows, "angle": self.config.angle, "looks": self.config.looks}
        tasks = []
        for k, coords in enumerate(self.tiles):
            if coords is not None and self.made[f"space {k}"].facts["voxels"]:
                own = (f"levels {k}", f"space {k}")
                params = {"tile": k, **options}
                tasks.append(Task(f"around {k}", "gsvis.world.pieces:choose_nodes", params, (*own, *needs)))
        return [*self._level_tasks, *tasks]

    @cached_property
    def made(self) -> dict[str, Result]:
        """Rows, spaces and levels of tiles, and districts."""
        return self._run(self._level_tasks, "levels")

    @cached_property
    def nodes(self) -> dict[int, list[str]]:
        """For each tile with a space, the tasks of the nodes around it."""
        _ = self.made
        found = self._run(self._node_tasks, "nodes")
        outside = [f"levels {len(self.tiles) - 1}"] if self.tiles[-1] is None else []
        nodes = {}
        for k in range(len(self.tiles)):
            if f"around {k}" in found:
                facts = found[f"around {k}"].facts
                districts = [_district(*self.districts[each][:2]) for each in facts["districts"]]
                nodes[k] = [*(f"levels {each}" for each in facts["tiles"]), *outside, *districts]
        return nodes

    @cached_property
    def _package_tasks(self) -> list[Task]:
        tasks = []
        for k, coords in enumerate(self.tiles):
            around = self.nodes.get(k, [])
            params = {
                "around": around, "angle": self.config.angle, "config": self.config.package.as_dict(),
                "name": tile_name(coords), "up": self.grid["up"], "outside": coords is None,
            }  # fmt: skip
            own = (f"levels {k}",) if coords is None else (f"levels {k}", f"space {k}")
            tasks.append(Task(f"tile {k}", "gsvis.world.packages:prepare_tile", params, (*own, *around)))
        return tasks

    @cached_property
    def packages(self) -> list[Result]:
        """The packages of all tiles."""
        return self.prepared(range(len(self.tiles)))

    def prepared(self, some: Iterable[int]) -> list[Result]:
        """Return the packages of some tiles."""
        names = [f"tile {k}" for k in some]
        _ = self.nodes
        wanted = [task for task in self._package_tasks if task.name in set(names)]
        found = self._run([*self._level_tasks, *wanted], "tiles")
        return [found[name] for name in names]

    def district(self, number: int) -> Result:
        """Return the result of a district."""
        return self.made[_district(*self.districts[number][:2])]

    def _around(self, coords: tuple[int, int]) -> list[int]:
        """Return the tiles that touch a tile."""
        return [
            k for k, other in enumerate(self.tiles)
            if other is not None and other != coords and max(abs(np.subtract(other, coords))) <= 1
        ]  # fmt: skip

    def _square(self, coords: tuple[int, int]) -> dict[str, Any]:
        """Return the params of the space of a tile."""
        grid = grid_of(self.grid["grid"])
        low = [grid.origin[axis] + grid.side * place for axis, place in zip(grid.axes, coords, strict=True)]
        return {
            "low": low, "high": [each + grid.side for each in low], "axes": list(grid.axes), "up": self.grid["up"],
            "resolution": self.config.resolution,
        }  # fmt: skip

    def _run(self, tasks: list[Task], stage: str) -> dict[str, Result]:
        plain = [Task(t.name, t.run, json.loads(json.dumps(t.params)), t.needs) for t in tasks]
        return run_graph(plain, self.store, self.workers, stage=stage, progress=self.progress)


def _district(size: int, place: tuple[int, int]) -> str:
    return f"district {size} {place[0]}-{place[1]}"


def _children(place: tuple[int, int]) -> list[tuple[int, int]]:
    return [(2 * place[0] + i, 2 * place[1] + j) for i in (0, 1) for j in (0, 1)]
