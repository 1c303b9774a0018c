"""Run the graph tasks that clean a tile of a scene, within a coarse version of the whole scene.

Space, air, eyes and the measure of large Gaussians are those of the whole scene, found from its tiles one by one.
Occluders are the tile and a halo in full detail, and a few merged Gaussians for everything else. In a scene of many
places (`places.py`) the eyes nearest to the tile are used. Scene frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.classes import KEPT, CleanConfig, class_of
from gsvis.edit.cleaning import judge
from gsvis.edit.evidence import gather_evidence, part_of_backdrop
from gsvis.edit.memory import cleaning_memory, most_gaussians
from gsvis.edit.parcels import rows_near
from gsvis.edit.places import Parcel, join_parcels, parcels_of, space_of_parcel
from gsvis.edit.shape import Shape, far_from
from gsvis.edit.whole import Whole, core_within, find_space, load_whole, save_whole
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.jobs.graph import Facts, Given
from gsvis.scene.axes import nearest_axis
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.world.districts import merge_down
from gsvis.world.rows import content_order, flatten, load_gaussians, load_rows, save_gaussians
from gsvis.world.tiles import MARGIN, cut_to_tile, load_space, near_tile, save_space

__all__ = [
    "VERSIONS",
    "clean_tile",
    "config_of",
    "find_flyaways",
    "find_parcel",
    "find_whole",
    "gather_rows",
    "join_far",
    "merge_tile",
    "survey_scene",
]

VERSIONS = {
    "clean_tile": 4,
    "find_flyaways": 2,
    "find_parcel": 1,
    "find_whole": 1,
    "gather_rows": 1,
    "join_far": 1,
    "merge_tile": 2,
    "survey_scene": 3,
}

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_SPREAD = 1.6  # times as wide as merged: neighbors of a surface overlap, so that it hides what is behind it


def gather_rows(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: join the rows of a tile from all batches, with base colors, by content. Inputs are splits of batches.

    Params: `files` lists (input, name). Writes "rows", and "order", the index of each row in the joined files. Facts:
        `gaussians`, and the `sizes` of the files.
    """
    parts = [load_gaussians(given.path(number, name)) for number, name in params["files"]]
    joined = Gaussians.concatenate(parts)
    order = content_order(joined)
    save_gaussians(out / "rows", flatten(joined[order]))
    save_arrays(out / "order", {"order": order})
    return {"gaussians": len(joined), "sizes": [len(g) for g in parts]}


def survey_scene(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find navigable space by one grid. Inputs are rows of all tiles and the outside, then samples.

    Params: `tiles`, the number of inputs with rows; `samples`, the numbers of the others; `every`, the number of
        Gaussians
    that one of a sample represents; `up`. Facts: `low` and `high` of the robust box; the `kind` and `rule` of the
    space; `parcels`, see `parcels_of`.
    """
    sample = _sample(params, given)
    space = find_space(_Tiles(given, params["tiles"]), sample, up=params["up"])
    save_space(out / "space", space)
    up = params["up"]
    parcels = [{**each, "up": up} for each in parcels_of(space, sample, params["every"], nearest_axis(up))]
    low, high = sample.bounds(0.98)
    known = {"low": low.tolist(), "high": high.tolist(), "kind": asdict(space.kind), "rule": space.rule}
    return {**known, "parcels": parcels}


def find_parcel(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find navigable space in a parcel. Inputs are rows of the tiles in and around it, and of the outside.

    Params: `low` and `high`, the robust box of the whole scene; `square`, see `lay_parcels`; `is_object`, whether the
        whole scene looks like an object. Facts: its Gaussians, and whether it has a space.
    """
    low = np.array(params["low"])
    high = np.array(params["high"])
    square = params["square"]
    tiles = _Tiles(given, len(given))
    count = sum(int(np.count_nonzero(near_tile(g.means, square, 0.0))) for g in tiles)
    near = core_within(rows_near(tiles, square), low, high) if count else None
    space = None if near is None else space_of_parcel(near, square, params["is_object"])
    if space is not None:
        save_space(out / "space", space)
    return {"gaussians": count, "space": space is not None}


def find_whole(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: combine the results for the whole scene. Inputs are rows of all tiles, all samples, then all spaces.

    Params: `tiles`, `samples` and `config` as for other tasks; `survey`, the number of the input of `survey_scene`;
    `parcels`, the numbers of the inputs of `find_parcel`; none if one grid suffices. Facts: `parcels`, the number of
    grids of the space.
    """
    facts = given.inputs[params["survey"]].facts
    kind = SpaceKind(**{**facts["kind"], "evidence": None})
    space = replace(load_space(given.path(params["survey"], "space")), kind=kind, rule=facts["rule"])
    if params["parcels"]:
        space = join_parcels(space, _Parcels(given, params["parcels"]))
    parts = _Tiles(given, params["tiles"])
    save_whole(out, Whole.from_parts(parts, _sample(params, given), space, config_of(params["config"])))
    return {"parcels": space.parcels}


def merge_tile(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: merge the occluders of a tile to few Gaussians. Inputs are its rows, and the whole scene.

    Params: `near` and `far`, the largest numbers of Gaussians of the results with these names.
    """
    whole = _whole(given, 1)
    g = core_within(load_gaussians(given.path(0, "rows")), whole.low, whole.high)
    for name in ("near", "far"):
        few = merge_down(g, params[name]) if len(g) else g
        wide = few if few is g else replace(few, scales=_SPREAD * few.scales)
        save_gaussians(out / name, wide)
    return {"gaussians": len(g)}


def join_far(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: join the results named "far" of all tiles. Facts: `sizes`, the number of Gaussians of each tile."""
    parts = [load_gaussians(given.path(k, "far")) for k in range(len(given))]
    save_gaussians(out / "far", Gaussians.concatenate(parts))
    return {"sizes": [len(g) for g in parts]}


def clean_tile(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the class of each Gaussian of a tile.

    Inputs are its rows, those of the tiles that touch it, the whole scene, all tiles merged and joined, and some merged
    tiles. Params: `tile`, the number of the tile; `low`, `high` and `axes`, its rectangle; `room`, the largest number
    of Gaussians in and around the tile; `whole`, the number of the input for the whole scene, which that of the joined
    tiles follows; `near`, by number of a tile near it, or of the outside, the input and whether the halo reaches into
    it; `config`; `name`; `files`, the names of the arrays to write.

    Writes "classes" with an array for each file of a batch that was joined to the rows. Facts: Gaussians found and
    removed of each class, the cost of each, and the quality at builder's and judge's eyes.
    """
    own, around = _load(params, given)
    config = config_of(params["config"])
    whole = _whole(given, params["whole"])
    eyes = whole.air.eyes
    navigable = whole.navigable
    if given.inputs[params["whole"]].facts["parcels"] > 1:  # eyes of other parcels see little of this one
        away = _distances_from_tile(eyes, params)
        eyes = eyes[np.argsort(away, kind="stable")[: config.eyes]]
        navigable = cut_to_tile(navigable, params) or navigable
    joint = Gaussians.concatenate([own, *around])
    needed = cleaning_memory(len(joint), 0)
    if given.max_memory is not None and needed > given.max_memory:
        fits = most_gaussians(given.max_memory, 0)
        raise ValueError(
            f"tile {params['name']}: expected at most {fits:,} Gaussians in and around it for the memory, got"
            f" {len(joint):,}; raise --max-memory"
        )
    shape = Shape.within(joint, whole.low, whole.high)
    found = classes = np.zeros(len(own), np.uint8)
    costs: Facts = {}
    judged = None
    if shape.core[: len(own)].any():
        air = replace(whole.air, eyes=eyes)
        evidence = gather_evidence(joint, shape, whole.navigable, config, air=air, judged=len(own))
        result = judge(joint, shape, navigable, evidence, config)
        inside = [each[: len(own)] for each in (result.found, result.classes)]
        found, classes = (np.where(each == class_of("flyaways"), np.uint8(KEPT), each) for each in inside)
        costs = {name: asdict(cost) for name, cost in result.costs.items()}
        judged = None if result.judged is None else result.judged.as_dict()
    _save(out, params, given, classes)
    facts = _counts(found, classes, config)
    return {**facts, "costs": costs, "judged": judged, "around": len(joint) - len(own)}


def find_flyaways(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the flyaways among Gaussians outside all tiles. Inputs are their rows, then all samples.

    Params: `samples`, the numbers of the other inputs; `config`; `files`. Writes the same files as `clean_tile`.
    """
    config = config_of(params["config"])
    low, high = _sample(params, given).bounds(0.98)
    g = load_gaussians(given.path(0, "rows"))
    far = np.flatnonzero(far_from(g.means, low, high))
    classes = np.zeros(len(g), np.uint8)
    if "flyaways" in config.classes:
        classes[far[~part_of_backdrop(g[far], 0.5 * (low + high))]] = class_of("flyaways")
    _save(out, params, given, classes)
    return {**_counts(classes, classes, config), "costs": {}, "around": 0}


def config_of(value: Facts) -> CleanConfig:
    """Return the options of a cleaning from their `asdict`, as read from JSON."""
    return CleanConfig(**{**value, "classes": tuple(value["classes"])})


def _load(params: Facts, given: Given) -> tuple[Gaussians, list[Gaussians]]:
    """Return the rows of a tile, and the Gaussians around it.

    The halo is as wide as memory allows; merged Gaussians represent everything beyond.
    """
    own = load_gaussians(given.path(0, "rows"))
    width = MARGIN * float(np.subtract(params["high"], params["low"]).max())
    near = [load_gaussians(given.path(number, "rows")) for number in range(1, params["whole"])]
    halo = Gaussians.concatenate([g[_distances_from_tile(g.means, params) < width] for g in near]) if near else own[:0]
    merged = _load_merged(params, given)
    room = max(0, params["room"] - len(own) - sum(len(g) for g, _ in merged))
    if len(halo) > room:
        away = _distances_from_tile(halo.means, params)
        width = float(np.partition(away, room)[room])
        halo = halo[away < width]
    beyond = [g[_distances_from_tile(g.means, params) >= width] if reached else g for g, reached in merged]
    return own, [halo, *beyond]


def _load_merged(params: Facts, given: Given) -> list[tuple[Gaussians, bool]]:
    """Return the merged Gaussians of each other tile and of the outside, and whether the halo reaches into it."""
    far = params["whole"] + 1
    joined = load_gaussians(given.path(far, "far"))
    ends = np.cumsum(given.inputs[far].facts["sizes"]).tolist()
    found = []
    for k, (first, last) in enumerate(pairwise([0, *ends])):
        if str(k) in params["near"]:
            number, reached = params["near"][str(k)]
            found.append((load_gaussians(given.path(number, "near")), reached))
        elif k != params["tile"]:
            found.append((joined[first:last], False))
    return found


def _distances_from_tile(points: NDArray[np.floating[Any]], params: Facts) -> F64:
    """Return (P,) distances of points (P, 3) from the rectangle of a tile, the larger of both axes."""
    low, high, axes = (np.array(params[name]) for name in ("low", "high", "axes"))
    across = points[:, axes].astype(np.float64)
    return np.asarray(np.maximum(np.maximum(low - across, across - high), 0.0).max(axis=1, initial=0.0))


@dataclass(frozen=True)
class _Tiles:
    """The rows of each tile, the first inputs of a task, read again at each iteration."""

    given: Given
    count: int

    def __iter__(self) -> Iterator[Gaussians]:
        for number in range(self.count):
            yield load_gaussians(self.given.path(number, "rows"))


@dataclass(frozen=True)
class _Parcels:
    """The parcels of a scene, read again at each iteration."""

    given: Given
    numbers: list[int]

    def __iter__(self) -> Iterator[Parcel]:
        for k in self.numbers:
            facts = self.given.inputs[k].facts
            yield facts["gaussians"], load_space(self.given.path(k, "space")) if facts["space"] else None


def _sample(params: Facts, given: Given) -> Gaussians:
    """Return the sample of the scene, sorted by content."""
    sampled = [k for k in params["samples"] if given.inputs[k].facts["sampled"]]
    return load_rows([given.path(k, "sample") for k in sampled])


def _whole(given: Given, number: int) -> Whole:
    """Return the results for the whole scene from an input."""
    return load_whole(*(given.path(number, name) for name in ("space", "air")))


def _save(out: Path, params: Facts, given: Given, classes: U8) -> None:
    """Write the classes of the rows of a tile, the first input, for each file of a batch in the order of its rows."""
    unsorted = np.empty(len(classes), np.uint8)
    unsorted[load_arrays(given.path(0, "order"), sealed=True)["order"]] = classes
    parts = np.split(unsorted, np.cumsum(given.inputs[0].facts["sizes"])[:-1])
    save_arrays(out / "classes", dict(zip(params["files"], parts, strict=True)))


def _counts(found: U8, classes: U8, config: CleanConfig) -> Facts:
    """Return the numbers of Gaussians found and removed, by class."""
    return {
        "gaussians": len(classes),
        "kept": int(np.count_nonzero(classes == KEPT)),
        "found": {name: int(np.count_nonzero(found == class_of(name))) for name in config.classes},
        "removed": {name: int(np.count_nonzero(classes == class_of(name))) for name in config.classes},
    }
