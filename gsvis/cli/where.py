"""Where eyes may be: found by the kind of the scene, or given by hand; with warnings about what they see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gsvis.cli.arguments_where import Where
from gsvis.cli.source import Source, navigable_space, parse_up
from gsvis.errors import SceneError
from gsvis.io.poses import load_path
from gsvis.scene.corridor import corridor, share_in_solid
from gsvis.scene.flyaways import find_flyaways
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.solid import buried

__all__ = [
    "WORDS",
    "Place",
    "check_where",
    "find_place",
    "flyaway_remarks",
    "given",
    "kind_row",
    "space_document",
    "spell",
    "suspect_views",
]

WORDS = ("box", "around", "path", "margin", "retarget")
"""Names of the options."""


_BOX_VOXELS = 96  # along the longest side of a box
_TRIED = 256  # eyes tested for lying inside something solid
_LOOKS, _WIDTH, _HEIGHT = 8, 96, 72
_LEAST_SEEN = 0.01  # share of the Gaussians
_LEAST_LIGHT = 0.05  # mean alpha of a view that does not look into the void
_VISIBLE = 1.0 / 255.0
_CLOSE = 0.01  # of the scene's diagonal: views that end within it look into one surface


@dataclass(frozen=True, eq=False)
class Place:
    """Where eyes may be.

    Attributes:
        space: The navigable space; None if there is none.
        why_not: Why there is none; else empty.
        remarks: Remarks for the user.
        path: The walk of --path, brought into the scene if --retarget is given; None without.
    """

    space: NavigableSpace | None
    why_not: str
    remarks: list[str]
    path: HeadPath | None = None

    def required(self, remedy: str) -> NavigableSpace:
        """Return the navigable space.

        Raises:
            SceneError: If there is none; the message ends with the remedy.
        """
        if self.space is None:
            raise SceneError(f"{self.why_not}; {remedy}")
        return self.space


def given(where: Where) -> list[str]:
    """Return the options that say by hand where eyes may be."""
    return [name for name in ("box", "around", "path") if getattr(where, name) is not None]


def check_where(where: Where, other: str = "") -> HeadPath | None:
    """Check the options before work begins; return the walk of --path.

    Args:
        where: The options.
        other: An option that was given and says itself where eyes are, such as "--camera".

    Raises:
        ValueError: If they contradict each other.
        FormatError: If the walk cannot be read.
    """
    for name in ("margin", "retarget"):
        if getattr(where, name) and where.path is None:
            raise ValueError(f"--{name}: expected --path with it, got none; add it or leave this out")
    names = given(where)
    if names and other:
        raise ValueError(f"--{names[0]}: expected none with {other}, which says where eyes are; leave one out")
    if len(names) > 1:
        value = getattr(where, names[1])
        raise ValueError(f"--{names[1]}: expected none with --{names[0]}, got {' '.join(spell(value))}; leave one out")
    return None if where.path is None else load_path(where.path)


def find_place(
    source: Source, where: Where, up: str | None = None, walk: HeadPath | None = None, seeds: ArrayLike | None = None
) -> Place:
    """Find where eyes may be.

    Args:
        source: The scene.
        where: What the user said.
        up: Value of --up; None means the known one, else +z for a box, else a guess.
        walk: The walk of --path.
        seeds: (S, 3) positions known to be navigable.

    Raises:
        SceneError: If eyes given by hand lie inside something solid.
        ValueError: If the walk lies elsewhere.
    """
    axis = source.known_up if up is None else parse_up(up)
    outside = flyaway_remarks(source.gaussians)
    if where.box is not None:
        upward = (0.0, 0.0, 1.0) if axis is None else axis
        space = NavigableSpace.from_box(where.box[:3], where.box[3:], _BOX_VOXELS, up=upward)
        return Place(space, "", _check_buried(source, space, "box"))
    if where.around is not None:
        center, radius = (where.around[:3], where.around[3]) if where.around else (None, None)
        try:
            space = NavigableSpace.around(source.gaussians, center, radius, up=axis)
        except SceneError as error:
            raise SceneError(f"--around: {error.problem}; give another center or radius") from None
        return Place(space, "", outside)
    found, why_not = navigable_space(source, up=axis, seeds=seeds)
    if found is None:
        return Place(None, f"{source.path or source.name}: {why_not}", outside)
    if walk is None:
        return Place(found, "", outside)
    return _along(found, where, walk, outside)


def flyaway_remarks(g: Gaussians) -> list[str]:
    """Return a remark on Gaussians that lie too far outside to count, if they are many."""
    count = int(np.count_nonzero(find_flyaways(g.means, g.scales, g.opacities)))
    if not count:
        return []
    return [
        f" {count:,} Gaussians, {count / len(g):.1%} of all, lie far outside of the scene and do not count for where"
        " eyes may be; gsvis clean removes them."
    ]


def _along(space: NavigableSpace, where: Where, walk: HeadPath, remarks: list[str]) -> Place:
    """Return the space near a walk, with more remarks."""
    remarks = [*remarks]
    if where.retarget:
        from gsvis.scene.retarget import retarget

        moved = retarget(walk, space)
        walk = moved.path
        remarks.append(f" The path was brought into the scene: {moved.rule}; {moved.inside:.0%} of it inside.")
    try:
        return Place(corridor(space, walk.positions, where.margin), "", remarks, walk)
    except ValueError as error:
        lost = where.retarget or share_in_solid(space, walk.positions) >= 0.5
        hint = "" if lost else "; --retarget brings it there"
        raise ValueError(f"--path {where.path}: {error}{hint}") from None


def _check_buried(source: Source, space: NavigableSpace, option: str) -> list[str]:
    """Return a remark if many eyes lie inside something solid; raise if all do."""
    eyes = space.sample_viewpoints(_TRIED, np.random.default_rng(0))
    lost = float(buried(source.union, eyes).mean())
    if lost == 1.0:
        raise SceneError(
            f"--{option}: expected room for eyes, got a place in which all of {_TRIED} eyes drawn lie inside something"
            " solid; give another, or a larger one"
        )
    return [f" {lost:.0%} of the eyes in --{option} lie inside something solid and are left out."] if lost > 0.5 else []


def suspect_views(g: Gaussians, space: NavigableSpace) -> list[str]:
    """Return a remark for each way in which what eyes see is implausible; empty if nothing is.

    Args:
        g: The scene.
        space: Where eyes may be; a few views are drawn in it.
    """
    from gsvis.render import rasterize
    from gsvis.render.weights import view_weights
    from gsvis.scene.view_sampling import ViewSampling

    try:
        cameras = ViewSampling(_LOOKS, _WIDTH, _HEIGHT, 90.0).cameras(g, space)
    except SceneError as error:
        return [f" What eyes see is implausible: {error}."]
    seen = float((view_weights(g, cameras).largest >= _VISIBLE).mean())
    drawn = rasterize(g, cameras, backend="cpu", sh_degree=0)
    light = drawn.alphas.reshape(_LOOKS, -1).mean(axis=1)
    depth = np.median(drawn.depths.reshape(_LOOKS, -1), axis=1)
    diagonal = float(np.linalg.norm(np.subtract(*g.bounds(0.98)[::-1])))
    remedy = "; say where eyes belong with --box, --around or --path"
    found = []
    if seen < _LEAST_SEEN:
        found.append(f" Implausible: a view sees {seen:.2%} of the Gaussians on average{remedy}.")
    if np.mean(light < _LEAST_LIGHT) >= 0.5:
        found.append(f" Implausible: {np.mean(light < _LEAST_LIGHT):.0%} of the views look into the void{remedy}.")
    close = (light > 0.9) & (depth < _CLOSE * diagonal)
    if np.mean(close) >= 0.5:
        found.append(f" Implausible: {np.mean(close):.0%} of the views look into one surface{remedy}.")
    return found


def spell(value: Any) -> list[str]:
    """Return the value of an option as the words of a command line; none for a flag."""
    if value is True:
        return []
    if isinstance(value, tuple):
        return [f"{each:.9g}" for each in value] or ["auto"]
    return [f"{value:g}" if isinstance(value, float) else str(value)]


def kind_row(space: NavigableSpace) -> tuple[str, str]:
    """Return a row of a table: what the scene is, and why."""
    return "taken for", str(space.kind)


def space_document(space: NavigableSpace) -> dict[str, Any]:
    """Return where eyes may be, for JSON."""
    return {
        "rule": space.rule,
        "voxel_size": space.voxel_size,
        "volume": space.volume,
        "kind": space.kind.as_dict(),
    }
