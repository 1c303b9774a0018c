"""Views to begin with in a scene that nobody has prepared."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from gsvis.cli.source import Source, navigable_space

if TYPE_CHECKING:
    from gsvis.export.start import Start

__all__ = ["find_starts", "thin"]

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
    from gsvis.export.start import Mode, Start
    from gsvis.prepare.start_views import choose_start_views
    from gsvis.scene.poses import describe_poses

    some = thin(source)
    space, _ = navigable_space(some, up=up)
    if space is None:
        return None
    mode: Mode = "orbit" if space.kind.kind == "object" else "fly"
    found = describe_poses(choose_start_views(some.gaussians, space, drawn=_DRAWN))
    return tuple(Start.from_dict(view, mode) for view in found) or None


def thin(source: Source) -> Source:
    """Return a scene with Gaussians drawn at random, larger by as much as keeps the area of all together."""
    g = source.gaussians
    if len(g) > _PART:
        some = np.sort(np.random.default_rng(0).choice(len(g), _PART, replace=False))
        g = replace(g[some], scales=g.scales[some] * np.float32(np.sqrt(len(g) / _PART)))
    return replace(source, gaussians=g, levels=None)
