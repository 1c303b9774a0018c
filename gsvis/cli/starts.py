"""Views to begin with in a scene that nobody has prepared."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from gsvis.cli.source import Source, navigable_space
from gsvis.scene.navigable import NavigableSpace

if TYPE_CHECKING:
    from gsvis.export.start import Start

__all__ = ["find_starts", "starts_in", "thin"]

_PART = 100_000
"""Number of Gaussians that are looked at. What place a scene is, and where it is free, shows in few."""
_DRAWN = 12


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
    return None if space is None else starts_in(some, space)


def starts_in(some: Source, space: NavigableSpace) -> tuple[Start, ...] | None:
    """Return upright views from a navigable space, the best first; None if no eye finds room.

    Args:
        some: The scene, or as much of it as `thin` leaves.
        space: Where eyes may be.
    """
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
    g = source.gaussians
    most = most or _PART
    if len(g) > most:
        some = np.sort(np.random.default_rng(0).choice(len(g), most, replace=False))
        g = replace(g[some], scales=g.scales[some] * np.float32(np.sqrt(len(g) / most)))
    return replace(source, gaussians=g, levels=None)
