"""Prepare a world as graphs of tasks: cut scenes into tiles; make levels, districts and packages.

Memory never holds the whole scene: this process holds names and sizes, a worker holds one batch, or one tile with its
surroundings. Finished results stay in a store beside the world, so that a killed run resumes. The bytes of the world do
not depend on workers, on order, or on kills. See docs/design/057-worlds.md and 058-graphs-of-tasks.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.io.batches import Batch, align_batches, list_batches
from gsvis.jobs.graph import Facts, Result, Task, run_graph
from gsvis.jobs.objects import ObjectStore
from gsvis.jobs.workers import Workers
from gsvis.prepare.judged import count_judges
from gsvis.progress import Progress
from gsvis.scene.corridor import fill_in
from gsvis.scene.witnesses import hold_out
from gsvis.world.config import WorldConfig
from gsvis.world.tiles import MARGIN, SURROUNDINGS, near_tile
from gsvis.world.tiling import Rect, grid_of, sampling_interval, tile_name

__all__ = ["DistrictPlan", "WorldBuild", "far_from_walk", "plan_districts"]

_GUESSED = 1 << 18  # assumed Gaussians of a batch whose number is unknown until it is read
_FEWEST = 64  # fewest Gaussians of a tile; with fewer they go to the outside
_SHARE = 1e-3  # fewest Gaussians of a tile, as a share of `TilingConfig.most`
_CAMERAS = 512  # most cameras that are used to find the up axis


@dataclass(frozen=True)
class DistrictPlan:
    """The plan of a district.

    Attributes:
        children: Nodes that it is made of: one tile, or earlier districts.
        tiles: Tiles that it stands for, ascending.
    """

    children: tuple[int, ...]
    tiles: tuple[int, ...]


def plan_districts(tree: Any, places: Sequence[int | None], count: int) -> list[DistrictPlan]:
    """Return the districts of a tree of cuts, in which every second cut is skipped; children come before parents.

    Args:
        tree: Numbers of rectangles, cut by cut, as `cut_squares` returns it.
        places: Tile of each rectangle; None for a nearly empty one, whose Gaussians went to the outside.
        count: Number of tiles, the outside included. Districts are numbered from there.
    """
    found: list[DistrictPlan] = []

    def visit(tree: Any) -> int | None:
        """Append the districts of a tree; return the number of its node, or None if it has no tile."""
        if tree is None:
            return None
        if isinstance(tree, list):
            below = [part for child in tree for part in (child if isinstance(child, list) else [child])]
            children = sorted(each for each in map(visit, below) if each is not None)
            if len(children) < 2:
                return children[0] if children else None
            tiles = sorted(tile for each in children for tile in found[each - count].tiles)
            found.append(DistrictPlan(tuple(children), tuple(tiles)))
        else:
            tile = places[tree]
            if tile is None:
                return None
            found.append(DistrictPlan((tile,), (tile,)))
        return count + len(found) - 1

    visit(tree)
    return found


def _thin_cameras(viewmats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return at most 512 of the world-to-camera matrices (C, 4, 4), evenly spaced."""
    some = np.linspace(0, len(viewmats) - 1, min(len(viewmats), _CAMERAS)).astype(int)
    return np.asarray(viewmats[np.unique(some)])


def far_from_walk() -> SceneError:
    """Return the error of a walk that comes near no tile."""
    return SceneError("the walk comes near no tile", "bring it into the frame of the scenes, or raise the margin")


@dataclass(eq=False)
class WorldBuild:
    """One preparation, stage by stage. A property runs the graph of its stage on first use.

    Attributes:
        scenes: Path and level of detail of each scene.
        config: The options.
        store: Store of the results.
        workers: The workers.
        progress: Called with stages "sampling", "splitting", "levels" and "tiles".
    """

    scenes: Sequence[tuple[str, int | None]]
    config: WorldConfig
    store: ObjectStore
    workers: Workers
    progress: Progress

    @cached_property
    def walk(self) -> NDArray[np.float64] | None:
        """(T, 3) positions of the walk, at most half a margin apart; None without a walk."""
        return None if self.config.walk is None else fill_in(np.array(self.config.walk), 0.5 * self.config.margin)

    @cached_property
    def batches(self) -> list[Batch]:
        """All batches of all scenes, with centers relative to one origin."""
        scenes = align_batches([list_batches(path, lod, stamped=True) for path, lod in self.scenes])
        return [batch for scene in scenes for batch in scene]

    @cached_property
    def every(self) -> int:
        """The sampling interval: about one of `every` Gaussians is in the samples."""
        return sampling_interval(sum(b.count if b.count >= 0 else _GUESSED for b in self.batches))

    @cached_property
    def _survey_tasks(self) -> list[Task]:
        """The tasks that sample each batch, and the task that finds the grid."""
        every = self.every
        samples = [
            Task(f"sample {k}", "gsvis.world.tiling:sample_rows", {"batch": asdict(batch), "every": every})
            for k, batch in enumerate(self.batches)
        ]
        params: Facts = {"config": asdict(self.config.tiling), "every": every}
        if self.config.cameras is not None:
            params["cameras"] = _thin_cameras(self.config.cameras.viewmats).tolist()
        return [*samples, Task("grid", "gsvis.world.tiling:find_grid", params, tuple(task.name for task in samples))]

    @cached_property
    def survey(self) -> dict[str, Result]:
        """Results of the samples, and of the grid under "grid"."""
        return self._run(self._survey_tasks, "sampling")

    @cached_property
    def grid(self) -> Facts:
        """Facts of the grid."""
        return self.survey["grid"].facts

    @cached_property
    def split_tasks(self) -> list[Task]:
        """The tasks up to splitting each batch."""
        splits = [
            Task(f"split {k}", "gsvis.world.tiling:split_batch", {"batch": asdict(batch)}, ("grid",))
            for k, batch in enumerate(self.batches)
        ]
        return [*self._survey_tasks, *splits]

    @cached_property
    def splits(self) -> list[Result]:
        """The files of rows of each batch, one for each tile in it."""
        _ = self.survey
        found = self._run(self.split_tasks, "splitting")
        return [found[f"split {k}"] for k in range(len(self.batches))]

    @cached_property
    def files(self) -> dict[Rect | None, list[tuple[int, str]]]:
        """For each tile, the outside last: number of the batch and name of each of its files of rows.

        Rectangles with very few Gaussians go to the outside.
        """
        counts: dict[str, int] = {}
        where: dict[str, list[tuple[int, str]]] = {}
        for k, result in enumerate(self.splits):
            for name, count in result.facts["counts"].items():
                counts[name] = counts.get(name, 0) + count
                where.setdefault(name, []).append((k, name))
        least = max(_FEWEST, int(_SHARE * self.config.tiling.most))
        found: dict[Rect | None, list[tuple[int, str]]] = {}
        for x, y, width, height in self.grid["tiles"]:
            name = tile_name((x, y, width, height))
            if counts.get(name, 0) >= least:
                found[x, y, width, height] = where.pop(name)
        if not found:
            raise SceneError(f"no tile of the grid has {least} Gaussians or more; use larger tiles, or gsvis prepare")
        if where:
            found[None] = sorted(file for files in where.values() for file in files)
        return found

    @cached_property
    def reach(self) -> list[tuple[float, float]]:
        """Least and largest value of each component of base colors in the world, so that all packages share tables."""
        rows = [result.facts["reach"] for result in self.splits]
        return [(min(row[k][0] for row in rows), max(row[k][1] for row in rows)) for k in range(3)]

    @cached_property
    def tiles(self) -> list[Rect | None]:
        """The tiles, in the order of the manifest."""
        return list(self.files)

    @cached_property
    def searched(self) -> frozenset[int]:
        """Tiles in which navigable space is searched: all but the outside."""
        return frozenset(k for k, rect in enumerate(self.tiles) if rect is not None)

    @cached_property
    def districts(self) -> list[DistrictPlan]:
        """The districts; children come before parents."""
        numbers = {rect: k for k, rect in enumerate(self.tiles)}
        places = [numbers.get(tuple(rect)) for rect in self.grid["tiles"]]
        return plan_districts(self.grid["tree"], places, len(self.tiles))

    @cached_property
    def _row_tasks(self) -> list[Task]:
        """The tasks up to joining the rows of each tile."""
        tasks = list(self.split_tasks)
        for k, rect in enumerate(self.tiles):
            files = self.files[rect]
            used = sorted({batch for batch, _ in files})
            listed: Facts = {"files": [(used.index(batch), name) for batch, name in files]}
            needs = tuple(f"split {batch}" for batch in used)
            tasks.append(Task(f"rows {k}", "gsvis.world.tiles:gather_rows", listed, needs))
        return tasks

    @cached_property
    def _level_tasks(self) -> list[Task]:
        """The tasks up to the space and the levels of each tile."""
        package = self.config.package.as_dict()
        tasks = list(self._row_tasks)
        for k, rect in enumerate(self.tiles):
            needs: tuple[str, ...] = (f"rows {k}",)
            if rect is not None and k in self.searched:
                params = self.space_params(rect)
                near = tuple(f"rows {other}" for other in self.touching(rect, params["around"]))
                tasks.append(Task(f"space {k}", "gsvis.world.tiles:tile_space", params, (*needs, *near)))
                needs = (*needs, f"space {k}")
            params = {"config": package, "most": self.config.far}
            tasks.append(Task(f"levels {k}", "gsvis.world.tiles:make_tile_levels", params, needs))
        if self.config.walk is not None and not any(task.params.get("walk") for task in tasks):
            raise far_from_walk()
        return tasks

    @cached_property
    def _district_tasks(self) -> list[Task]:
        """The tasks up to all districts."""
        package = self.config.package
        tasks = list(self._level_tasks)
        about = {"most": self.config.far, "up": self.grid["up"], "meters_per_unit": package.meters_per_unit}
        about["reach"] = self.reach
        for k, plan in enumerate(self.districts):
            of_tile = len(plan.children) == 1
            needs = tuple(f"levels {each}" if of_tile else self._district_task(each) for each in plan.children)
            params = {"of_tile": of_tile, **about}
            tasks.append(Task(f"district {k}", "gsvis.world.districts:make_district", params, needs))
        return tasks

    @cached_property
    def _node_tasks(self) -> list[Task]:
        """The tasks up to choosing the nodes around each tile with a space."""
        rows = [asdict(plan) for plan in self.districts]
        needs = tuple(f"district {k}" for k in range(len(rows)))
        options = {"districts": rows, "angle": self.config.angle, "looks": self.config.looks}
        tasks = []
        for k in sorted(self.searched):
            if self.made[f"space {k}"].facts["voxels"]:
                own = (f"levels {k}", f"space {k}")
                params = {"tile": k, "tiles": len(self.tiles), **options}
                tasks.append(Task(f"around {k}", "gsvis.world.pieces:choose_nodes", params, (*own, *needs)))
        return [*self._district_tasks, *tasks]

    @cached_property
    def rows(self) -> dict[str, Result]:
        """Results: rows of tiles."""
        return self._run(self._row_tasks, "tiles")

    @cached_property
    def levels(self) -> dict[str, Result]:
        """Results: rows, spaces and levels of tiles."""
        return self._run(self._level_tasks, "levels")

    @cached_property
    def made(self) -> dict[str, Result]:
        """Results: rows, spaces and levels of tiles, and districts."""
        return self._run(self._district_tasks, "levels")

    @cached_property
    def chosen(self) -> dict[str, Result]:
        """Results: those of `made`, and the nodes around each tile with a space."""
        _ = self.made
        return self._run(self._node_tasks, "nodes")

    @cached_property
    def nodes(self) -> dict[int, list[str]]:
        """For each tile with a space, the names of the tasks that make the nodes around it."""
        found = self.chosen
        outside = [f"levels {len(self.tiles) - 1}"] if self.tiles[-1] is None else []
        nodes = {}
        for k in range(len(self.tiles)):
            if f"around {k}" in found:
                facts = found[f"around {k}"].facts
                districts = [f"district {each}" for each in facts["districts"]]
                nodes[k] = [*(f"levels {each}" for each in facts["tiles"]), *outside, *districts]
        return nodes

    @cached_property
    def _package_tasks(self) -> list[Task]:
        """The tasks that make the package of each tile."""
        tasks = []
        judges = count_judges(len(self.searched))
        for k, rect in enumerate(self.tiles):
            around = self.nodes.get(k, [])
            params = {
                "around": around,
                "angle": self.config.angle,
                "config": self.config.package.as_dict(),
                "name": tile_name(rect),
                "up": self.grid["up"],
                "outside": rect is None,
                "reach": self.reach,
                "judges": judges,
                **self.witnesses_in(rect),
            }
            own = (f"levels {k}", f"space {k}") if k in self.searched else (f"levels {k}",)
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
        found = self._run([*self._district_tasks, *wanted], "tiles")
        return [found[name] for name in names]

    def district(self, number: int) -> Result:
        """Return the result of a district."""
        return self.made[f"district {number}"]

    def _district_task(self, node: int) -> str:
        """Return the name of the task that makes a district, from the number of its node."""
        return f"district {node - len(self.tiles)}"

    def touching(self, rect: Rect, margin: float = MARGIN) -> list[int]:
        """Return the tiles that touch a tile or are within a margin around it, as a share of its longer side."""
        reach = max(margin * max(rect[2:]), 1e-9)
        first, last = self._corners
        gaps = np.maximum(rect[:2] - last, first - np.add(rect[:2], rect[2:])).max(axis=1)
        same = (first == rect[:2]).all(axis=1)
        return [int(k) for k in np.flatnonzero((gaps < reach) & ~same)]

    @cached_property
    def _corners(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(K, 2) first and last corner of each tile but the outside, in squares."""
        rects = np.array([rect for rect in self.tiles if rect is not None], np.float64).reshape(-1, 4)
        return rects[:, :2], rects[:, :2] + rects[:, 2:]

    def space_params(self, rect: Rect) -> Facts:
        """Return the params of the task that finds the space of a tile; along a walk it needs less around the tile."""
        around = SURROUNDINGS if self.config.walk is None else MARGIN
        return {**self.square_of(rect), **self._walk_near(rect), **self._seeds_near(rect), "around": around}

    def square_of(self, rect: Rect) -> Facts:
        """Return the corners and axes of the rectangle of a tile, the up axis, and the resolution of its space."""
        grid = grid_of(self.grid["grid"])
        low = [grid.origin[axis] + grid.side * place for axis, place in zip(grid.axes, rect[:2], strict=True)]
        high = [each + grid.side * count for each, count in zip(low, rect[2:], strict=True)]
        return {
            "low": low,
            "high": high,
            "axes": list(grid.axes),
            "up": self.grid["up"],
            "resolution": self.config.resolution,
        }

    def _walk_near(self, rect: Rect) -> Facts:
        """Return the positions of the walk within its margin of a tile, as params; empty without a walk."""
        if self.walk is None:
            return {}
        square = self.square_of(rect)
        reach = self.config.margin
        across = self.walk[:, square["axes"]]
        near = (across >= np.array(square["low"]) - reach) & (across < np.array(square["high"]) + reach)
        return {"walk": self.walk[near.all(axis=1)].tolist(), "margin": reach}

    def _seeds_near(self, rect: Rect) -> Facts:
        """Return the cameras in and around a tile that help to find its space, as params; empty without any."""
        cameras = self.config.cameras
        if cameras is None or self.walk is not None:
            return {}
        eyes = cameras.viewpoints[hold_out(len(cameras))[0]]
        eyes = eyes[near_tile(eyes, self.square_of(rect))]
        return {"seeds": eyes.tolist()} if len(eyes) else {}

    def witnesses_in(self, rect: Rect | None) -> Facts:
        """Return the cameras in a tile that judge its visible sets, as params; empty without any."""
        cameras = self.config.cameras
        if cameras is None or rect is None:
            return {}
        views = cameras.viewmats[hold_out(len(cameras))[1]]
        views = views[near_tile(cameras.viewpoints[hold_out(len(cameras))[1]], self.square_of(rect), 0.0)]
        return {"witnesses": views.tolist()} if len(views) else {}

    def _run(self, tasks: list[Task], stage: str) -> dict[str, Result]:
        """Run tasks, whose params become plain JSON values first, and return their results by name."""
        made: dict[int, Any] = {}  # by identity: a value that tasks share, such as the districts, stays one object

        def plain(value: Any) -> Any:
            """Return a value as it is after JSON."""
            if id(value) not in made:
                made[id(value)] = json.loads(json.dumps(value))
            return made[id(value)]

        plain_tasks = [
            Task(t.name, t.run, {name: plain(value) for name, value in t.params.items()}, t.needs) for t in tasks
        ]
        return run_graph(plain_tasks, self.store, self.workers, stage=stage, progress=self.progress)
