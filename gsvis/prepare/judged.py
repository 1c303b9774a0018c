"""Measure the visible sets of a package or of a tile at eyes that are independent of navigable space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.prepare.surroundings import Surroundings
from gsvis.progress import Progress, silent
from gsvis.pvs.judged import judge_images
from gsvis.pvs.store import VisibilityStore
from gsvis.render.judges import JUDGES, Judges, count_views, judging_views
from gsvis.scene.judged import Judged
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["count_judges", "judge_tile", "small_views"]

_OF_TILE = 26  # views of a tile by each of the two rules: two tiles have more than a hundred
_FROM = 12  # views of what a client gets from which there are so many


def count_judges(tiles: int) -> int:
    """Return the number of views of a tile by each rule, so that all tiles of a world have at least a hundred."""
    return max(_OF_TILE, -(-JUDGES // max(1, tiles)))


def small_views(views: ViewSampling, most: int) -> ViewSampling:
    """Return the builder's views for judging, half as large as the fidelity views.

    Args:
        views: The fidelity views; if they are few, as in tests, so are the returned ones.
        most: Largest number of views by each rule.
    """
    count = count_views(views.count, _FROM, most)
    small = {name: max(1, getattr(views, name) // 2) for name in ("width", "height")}
    return replace(views, count=count, stream=views.stream + 2, **small)


def judge_tile(
    levels: Levels,
    space: NavigableSpace,
    store: VisibilityStore,
    views: ViewSampling,
    around: tuple[Surroundings, Path] | None,
    *,
    progress: Progress = silent,
) -> Judged:
    """Measure images from the sets of a tile and its surroundings, in base colors.

    Judge's eyes lie on the grid of the tile's space; elsewhere a client uses the sets of a different tile.

    Args:
        levels: The levels of the tile; the highest is drawn.
        space: Navigable space of the builder's eyes.
        store: The visible sets.
        views: The builder's views.
        around: The surroundings of the tile, and the store of their visible sets.
        progress: Called with stage "judge", in views.
    """
    top = len(levels) - 1
    own = levels.bare_level(top)
    mine, judges = judging_views(own, views, space, whole=levels)
    judges = _within(judges, space)
    joint = levels if around is None else around[0].joined(levels)
    member = joint.member(top)
    first = len(levels.union)
    beyond = None if around is None else VisibilityStore.open(around[1])
    try:

        def held(cell: int) -> NDArray[np.bool_]:
            """Return which Gaussians the sets of a cell hold."""
            seen = np.zeros(len(member), bool)
            seen[store.visible_ids(cell)] = True
            if beyond is not None:
                seen[first + beyond.visible_ids(cell)] = True
            return seen & member

        return judge_images(joint.drawn_level(top), store.grid, held, mine, judges, progress=progress)
    finally:
        if beyond is not None:
            beyond.close()


def _within(judges: Judges, space: NavigableSpace) -> Judges:
    """Return the judge's eyes that lie on the grid of a space."""
    eyes = judges.cameras.viewpoints
    high = space.origin + space.voxel_size * np.array(space.free.shape)
    inside = np.all((eyes >= space.origin) & (eyes < high), axis=1)
    given = int(np.count_nonzero(inside[len(inside) - judges.given :])) if judges.given else 0
    return Judges(judges.cameras[inside], given, judges.named)
