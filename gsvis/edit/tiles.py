"""Clean a tile of a scene: find what can go from it, in the whole scene, of which what is far is coarse. Graph tasks.

Space, air, eyes and what counts as large are those of the whole scene, found from its tiles one after the other. What
hides things is the tile and a halo as they are, and a few merged Gaussians for everything else. Scene frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.classes import KEPT, CleanConfig, class_of
from gsvis.edit.cleaning import judge
from gsvis.edit.evidence import gather_evidence, part_of_backdrop
from gsvis.edit.memory import cleaning_memory, most_gaussians
from gsvis.edit.shape import Shape, far_from
from gsvis.edit.whole import Whole, core_within, load_whole, save_whole
from gsvis.files.archive import save_arrays
from gsvis.scene.gaussians import Gaussians
from gsvis.world.districts import merge_down
from gsvis.world.graph import Facts, Given
from gsvis.world.rows import content_order, flatten, load_gaussians, load_rows, save_gaussians
from gsvis.world.tiles import MARGIN

__all__ = ["VERSIONS", "clean_tile", "config_of", "find_flyaways", "merge_tile", "survey_scene"]

VERSIONS = {"clean_tile": 2, "find_flyaways": 1, "merge_tile": 1, "survey_scene": 1}

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_SPREAD = 1.6  # times as wide as merged: neighbors of a surface overlap, so that it hides what is behind it


def survey_scene(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find what is known of the whole scene. Inputs are splits of all batches, then all samples.

    Params: `files`, for each tile and the outside (input, name) of its rows; `samples`, the numbers of the other
    inputs; `up`; `config`.
    """
    parts = _Tiles(given, params["files"])
    save_whole(out, Whole.from_parts(parts, _sample(params, given), config_of(params["config"]), up=params["up"]))
    return {}


def merge_tile(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: merge what hides things in a tile to few Gaussians. Inputs are splits of batches, then the whole scene.

    Params: `files` of the tile; `whole`, the number of that input; `near` and `far`, most Gaussians of the results with
    these names.
    """
    whole = _whole(params, given)
    rows = load_rows([given.path(number, name) for number, name in params["files"]])
    g = core_within(flatten(rows), whole.low, whole.high)
    for name in ("near", "far"):
        few = merge_down(g, params[name]) if len(g) else g
        wide = (
            few if few is g else Gaussians(few.means, few.quats, _SPREAD * few.scales, few.opacities, few.sh0, few.shN)
        )
        save_gaussians(out / name, wide)
    return {"gaussians": len(g)}


def clean_tile(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the class of each Gaussian of a tile. Inputs are splits of batches, the whole scene, merged tiles.

    Params: `files` and `halo` list (input, name) of the rows of the tile and of those that touch it; `low`, `high` and
    `axes`, the rectangle of the tile; `room`, most Gaussians in and around the tile; `whole`, the number of that input;
    `merged` lists input, name, and whether the halo reaches into it, of all other tiles and the outside; `config`;
    `name`.

    Leaves "classes" with an array for each file of the tile. Facts: Gaussians found and removed of each class, and the
    cost of each.
    """
    own, around, order = _load(params, given)
    config, whole = config_of(params["config"]), _whole(params, given)
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
    if shape.core[: len(own)].any():
        evidence = gather_evidence(joint, shape, whole.navigable, config, air=whole.air, judged=len(own))
        result = judge(joint, shape, whole.navigable, evidence, config)
        inside = [each[: len(own)] for each in (result.found, result.classes)]
        found, classes = (np.where(each == class_of("flyaways"), np.uint8(KEPT), each) for each in inside)
        costs = {name: asdict(cost) for name, cost in result.costs.items()}
    unsorted = np.empty(len(own), np.uint8)
    unsorted[order] = classes
    _save(out, params, given, unsorted)
    facts = _counts(found, classes, config)
    return {**facts, "costs": costs, "around": len(joint) - len(own)}


def find_flyaways(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the flyaways among what lies outside all tiles. Inputs are splits of batches, then all samples.

    Params: `files` of the outside; `samples`, the numbers of the other inputs; `config`. Leaves what `clean_tile` does.
    """
    config = config_of(params["config"])
    low, high = _sample(params, given).bounds(0.98)
    g = Gaussians.concatenate([load_gaussians(given.path(number, name)) for number, name in params["files"]])
    far = np.flatnonzero(far_from(g.means, low, high))
    classes = np.zeros(len(g), np.uint8)
    if "flyaways" in config.classes:
        classes[far[~part_of_backdrop(g[far], 0.5 * (low + high))]] = class_of("flyaways")
    _save(out, params, given, classes)
    return {**_counts(classes, classes, config), "costs": {}, "around": 0}


def config_of(value: Facts) -> CleanConfig:
    """Return the options of a cleaning from their `asdict`, as JSON keeps them."""
    return CleanConfig(**{**value, "classes": tuple(value["classes"])})


def _load(params: Facts, given: Given) -> tuple[Gaussians, list[Gaussians], NDArray[np.int64]]:
    """Return the rows of a tile by content, what is around it, and the order of the former. All have base colors alone.

    The halo is as wide as there is room for; beyond it are merged Gaussians.
    """
    joined = Gaussians.concatenate([load_gaussians(given.path(number, name)) for number, name in params["files"]])
    order = content_order(joined)
    own = flatten(joined[order])
    low, high, axes = (np.array(params[name]) for name in ("low", "high", "axes"))

    def away(g: Gaussians) -> F64:
        across = g.means[:, axes].astype(np.float64)
        return np.asarray(np.maximum(np.maximum(low - across, across - high), 0.0).max(axis=1, initial=0.0))

    width = MARGIN * float((high - low).max())
    near = [flatten(load_gaussians(given.path(number, name))) for number, name in params["halo"]]
    halo = Gaussians.concatenate([g[away(g) < width] for g in near]) if near else own[:0]
    merged = [(load_gaussians(given.path(number, name)), reached) for number, name, reached in params["merged"]]
    room = max(0, params["room"] - len(own) - sum(len(g) for g, _ in merged))
    if len(halo) > room:
        width = float(np.partition(away(halo), room)[room])
        halo = halo[away(halo) < width]
    beyond = [g[away(g) >= width] if reached else g for g, reached in merged]
    return own, [halo[content_order(halo)], *beyond], order


@dataclass(frozen=True)
class _Tiles:
    """The rows of each tile by content, read again whenever they are iterated over."""

    given: Given
    files: list[list[tuple[int, str]]]

    def __iter__(self) -> Iterator[Gaussians]:
        for files in self.files:
            yield flatten(load_rows([self.given.path(number, name) for number, name in files]))


def _sample(params: Facts, given: Given) -> Gaussians:
    """Return the sample of the scene, by content."""
    sampled = [k for k in params["samples"] if given.inputs[k].facts["sampled"]]
    return load_rows([given.path(k, "sample") for k in sampled])


def _whole(params: Facts, given: Given) -> Whole:
    return load_whole(*(given.path(params["whole"], name) for name in ("space", "air")))


def _save(out: Path, params: Facts, given: Given, classes: U8) -> None:
    """Write the classes of the rows of each file."""
    sizes = [given.inputs[number].facts["counts"][name] for number, name in params["files"]]
    parts = np.split(classes, np.cumsum(sizes)[:-1])
    names = [f"{batch} {name}" for batch, (_, name) in zip(params["batches"], params["files"], strict=True)]
    save_arrays(out / "classes", dict(zip(names, parts, strict=True)))


def _counts(found: U8, classes: U8, config: CleanConfig) -> Facts:
    return {
        "gaussians": len(classes),
        "kept": int(np.count_nonzero(classes == KEPT)),
        "found": {name: int(np.count_nonzero(found == class_of(name))) for name in config.classes},
        "removed": {name: int(np.count_nonzero(classes == class_of(name))) for name in config.classes},
    }
