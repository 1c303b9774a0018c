"""Clean a tile of a scene: find what can go from it, in the whole scene, of which what is far is coarse. Graph tasks.

Space, air, eyes and what counts as large are those of the whole scene, found from its tiles one after the other. What
hides things is the tile and a halo as they are, and a few merged Gaussians for everything else. In a scene of many
places (`places.py`) the eyes are those nearest to the tile. Scene frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.classes import KEPT, CleanConfig, class_of
from gsvis.edit.cleaning import judge
from gsvis.edit.evidence import gather_evidence, part_of_backdrop
from gsvis.edit.memory import cleaning_memory, most_gaussians
from gsvis.edit.places import AROUND, is_well_known, join_pieces, lay_pieces, space_near, space_of_piece
from gsvis.edit.shape import Shape, far_from
from gsvis.edit.whole import Whole, core_within, find_space, load_whole, save_whole
from gsvis.files.archive import save_arrays
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.world.districts import merge_down
from gsvis.world.graph import Facts, Given
from gsvis.world.rows import content_order, flatten, load_gaussians, load_rows, save_gaussians
from gsvis.world.tiles import MARGIN, load_space, near_tile, save_space

__all__ = [
    "VERSIONS",
    "clean_tile",
    "config_of",
    "find_flyaways",
    "find_piece",
    "find_whole",
    "merge_tile",
    "survey_scene",
]

VERSIONS = {
    "clean_tile": 3, "find_flyaways": 1, "find_piece": 1, "find_whole": 1, "merge_tile": 1, "survey_scene": 2,
}  # fmt: skip

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_SPREAD = 1.6  # times as wide as merged: neighbors of a surface overlap, so that it hides what is behind it


def survey_scene(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find where eyes may be by one grid over all. Inputs are splits of all batches, then all samples.

    Params: `files`, for each tile and the outside (input, name) of its rows; `samples`, the numbers of the other
    inputs; `every`, one of how many Gaussians is in these; `up`. Facts: the `kind` and `rule` of the space; `pieces`,
    see `lay_pieces`, none if the grid shows the scene.
    """
    sample = _sample(params, given)
    space = find_space(_Tiles(given, params["files"]), sample, up=params["up"])
    save_space(out / "space", space)
    pieces = [] if is_well_known(space) else lay_pieces(sample, params["every"], params["up"])
    return {"pieces": pieces, "kind": asdict(space.kind), "rule": space.rule}


def find_piece(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find where eyes may be in a piece. Inputs are splits of batches, then all samples.

    Params: `files` lists (input, name) of the rows of the tiles in and around it; `square`, see `lay_pieces`;
    `samples`; `is_object`, whether the whole was taken for one. Facts: its Gaussians, and whether it has a space.
    """
    low, high = _sample(params, given).bounds(0.98)
    square, parts = params["square"], []
    for number, name in params["files"]:
        g = load_gaussians(given.path(number, name))
        parts.append(core_within(flatten(g[near_tile(g.means, square, AROUND)]), low, high))
    near = Gaussians.concatenate(parts)
    count = int(np.count_nonzero(near_tile(near.means, square, 0.0)))
    space = space_of_piece(near[content_order(near)], square, params["is_object"]) if len(near) else None
    if space is not None:
        save_space(out / "space", space)
    return {"gaussians": count, "space": space is not None}


def find_whole(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find what is known of the whole scene. Inputs are splits of all batches, all samples, then all spaces.

    Params: `files`, `samples` and `config` as for other tasks; `survey`, the number of the input of `survey_scene`;
    `pieces`, those of the inputs of `find_piece`; none if the scene is well known. Facts: `pieces`, in how many the
    space was found.
    """
    facts = given.inputs[params["survey"]].facts
    kind = SpaceKind(**{**facts["kind"], "evidence": None})
    space = replace(load_space(given.path(params["survey"], "space")), kind=kind, rule=facts["rule"])
    found = [(given.inputs[k].facts["gaussians"], given.inputs[k].facts["space"], k) for k in params["pieces"]]
    if found:
        pieces = [(count, load_space(given.path(k, "space")) if there else None) for count, there, k in found]
        space = join_pieces(space, pieces)
    parts = _Tiles(given, params["files"])
    save_whole(out, Whole.from_parts(parts, _sample(params, given), space, config_of(params["config"])))
    return {"pieces": space.pieces}


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
    eyes, navigable = whole.air.eyes, whole.navigable
    if given.inputs[params["whole"]].facts["pieces"] > 1:  # those of other pieces see little of this one
        away = _away(eyes, params)
        eyes = eyes[np.argsort(away, kind="stable")[: config.eyes]]
        navigable = space_near(navigable, params) or navigable
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
        air = replace(whole.air, eyes=eyes)
        evidence = gather_evidence(joint, shape, whole.navigable, config, air=air, judged=len(own))
        result = judge(joint, shape, navigable, evidence, config)
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
    width = MARGIN * float(np.subtract(params["high"], params["low"]).max())
    near = [flatten(load_gaussians(given.path(number, name))) for number, name in params["halo"]]
    halo = Gaussians.concatenate([g[_away(g.means, params) < width] for g in near]) if near else own[:0]
    merged = [(load_gaussians(given.path(number, name)), reached) for number, name, reached in params["merged"]]
    room = max(0, params["room"] - len(own) - sum(len(g) for g, _ in merged))
    if len(halo) > room:
        away = _away(halo.means, params)
        width = float(np.partition(away, room)[room])
        halo = halo[away < width]
    beyond = [g[_away(g.means, params) >= width] if reached else g for g, reached in merged]
    return own, [halo[content_order(halo)], *beyond], order


def _away(points: NDArray[np.floating[Any]], params: Facts) -> F64:
    """Return (P,) how far points (P, 3) lie outside of the rectangle of a tile, along the axis on which it is most."""
    low, high, axes = (np.array(params[name]) for name in ("low", "high", "axes"))
    across = points[:, axes].astype(np.float64)
    return np.asarray(np.maximum(np.maximum(low - across, across - high), 0.0).max(axis=1, initial=0.0))


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
