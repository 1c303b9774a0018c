"""Views to begin with in a scene that nobody has prepared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.cli.arguments_where import WhereSeen
from gsvis.cli.source import Source, navigable_space, parse_up, up_of
from gsvis.cli.where import find_place
from gsvis.scene.navigable import NavigableSpace

if TYPE_CHECKING:
    from gsvis.export.start import Start

__all__ = ["Visit", "find_starts", "plan_visit", "thin"]

_PART = 100_000
"""Number of Gaussians that are looked at. What place a scene is, and where it is free, shows in few."""
_DRAWN = 12


@dataclass(frozen=True, eq=False)
class Visit:
    """How a visit of a scene begins.

    Attributes:
        starts: Upright views that show much of the scene, the best first; None if no eye finds room.
        up: (3,) unit up axis.
        remarks: Remarks for the user, such as what is not sure.
    """

    starts: tuple[Start, ...] | None
    up: NDArray[np.float64]
    remarks: list[str]


def plan_visit(source: Source, up: str | None = None, cameras: str | None = None) -> Visit:
    """Return how a visit of a scene begins, by the evidence that every command weighs.

    Where that is not sure, a remark says so, and views are drawn from where either reading has eyes.

    Args:
        source: The scene.
        up: Value of --up; None means the known one, else that of cameras, else the likely one.
        cameras: File of the cameras that took its photos; None without.
    """
    some = thin(source)
    place = find_place(some, WhereSeen(cameras=cameras), up)
    if place.upright is not None:
        axis = place.upright.up
    else:
        given = parse_up(up)
        axis = up_of(some) if given is None else given
    found = None if place.space is None else _starts_in(some, place.space)
    return Visit(found, axis, place.remarks)


def find_starts(source: Source, up: ArrayLike) -> tuple[Start, ...] | None:
    """Return upright views that show much of a scene, the best first; None if no eye finds room.

    They are found among a part of the Gaussians: about two seconds for any scene, and not the views that `gsvis
    prepare` would choose.

    Args:
        source: The scene.
        up: (3,) unit axis that points upwards.
    """
    some = thin(source)
    space, _ = navigable_space(some, up=up)
    return None if space is None else _starts_in(some, space)


def _starts_in(some: Source, space: NavigableSpace) -> tuple[Start, ...] | None:
    from gsvis.export.start import Mode, Start
    from gsvis.prepare.start_views import choose_start_views
    from gsvis.scene.poses import describe_poses

    mode: Mode = "orbit" if space.kind.kind == "object" else "fly"
    found = describe_poses(choose_start_views(some.gaussians, space, drawn=_DRAWN))
    return tuple(Start.from_dict(view, mode) for view in found) or None


def thin(source: Source, most: int | None = None) -> Source:
    """Return a scene with Gaussians drawn at random, larger by as much as keeps the area of all together.

    Args:
        source: The scene.
        most: Gaussians that remain, at most; by default as many as a view to begin with needs.
    """
    g, most = source.gaussians, most or _PART
    if len(g) > most:
        some = np.sort(np.random.default_rng(0).choice(len(g), most, replace=False))
        g = replace(g[some], scales=g.scales[some] * np.float32(np.sqrt(len(g) / most)))
    return replace(source, gaussians=g, levels=None)
