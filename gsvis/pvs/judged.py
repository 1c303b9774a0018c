"""Check visible sets at builder's eyes in navigable space, and at judge's eyes that are independent of it.

An image from the set of the cell that a client would use is compared with the image of the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.jobs.in_order import in_order
from gsvis.progress import Progress, silent
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.store import VisibilityStore
from gsvis.render import psnr, rasterize, view_weights
from gsvis.render.judges import Judges, judging_views
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judged import Judged
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["JudgedShares", "judge_images", "judge_sets", "judge_shares"]

F32 = NDArray[np.float32]
Held = Callable[[int], NDArray[np.bool_]]

_CAP = 100.0
_TIMES = 2.0  # between the shares of the two rules from which there is a warning: 6 dB


def judge_sets(
    scene: Levels, space: NavigableSpace, store: VisibilityStore, views: ViewSampling, *, progress: Progress = silent
) -> Judged:
    """Measure images from the sets of a store at builder's and judge's eyes, half of the views each.

    Args:
        scene: The levels of which the store holds the sets; the highest is drawn.
        space: Navigable space of the builder's eyes; its witnesses are judge's eyes.
        store: The visible sets.
        views: The builder's views; judge's views are as many, of the same size.
        progress: Called with stage "judge", in views.
    """
    top = len(scene) - 1

    def held(cell: int) -> NDArray[np.bool_]:
        """Return which Gaussians of the highest level the set of a cell holds."""
        seen = np.zeros(len(scene.union), bool)
        seen[store.visible_ids(cell)] = True
        return seen & scene.member(top)

    mine, judges = judging_views(scene.bare_level(top), views, space, whole=scene)
    return judge_images(scene.drawn_level(top), store.grid, held, mine, judges, progress=progress)


def judge_images(
    g: Gaussians, grid: CellGrid, held: Held, mine: Cameras, judges: Judges, *, progress: Progress = silent
) -> Judged:
    """Measure images from the sets of cells at builder's and judge's eyes.

    Args:
        g: The whole scene, N Gaussians.
        grid: The cells.
        held: Function from the number of a cell to a mask (N,) of its set.
        mine: Views at builder's eyes.
        judges: Views at judge's eyes.
        progress: Called with stage "judge", in views.
    """
    total = len(mine) + len(judges)
    progress("judge", 0, total)
    found: list[float] = []

    def seen() -> Iterator[tuple[Cameras, NDArray[np.bool_]]]:
        """Yield each camera with the set of its eye's cell, or of the nearest one."""
        for cameras in (mine, judges.cameras):
            for c in range(len(cameras)):
                yield cameras[c], held(grid.nearest(cameras[c].viewpoints[0]))

    def compare(looked: tuple[Cameras, NDArray[np.bool_]]) -> float:
        """Return the PSNR of the image from a set against the whole scene."""
        camera, shown = looked
        return min(_CAP, float(psnr(_draw(g.showing(shown), camera), _draw(g, camera))))

    for value in in_order(compare, seen()):
        found.append(value)
        progress("judge", len(found), total)
    eyes = judges.cameras.viewpoints
    values = np.array(found)
    inside = grid.cell_at(eyes) >= 0 if len(eyes) else np.zeros(0, bool)
    return Judged(values[: len(mine)], values[len(mine) :], inside, judges.named, judges.given)


def _draw(g: Gaussians, camera: Cameras) -> F32:
    return np.asarray(np.clip(rasterize(g, camera, backend="cpu").images[0], 0.0, 1.0), np.float32)


@dataclass(frozen=True, eq=False)
class JudgedShares:
    """Shares of the Gaussians that views at builder's and judge's eyes see.

    Attributes:
        builder: (B,) shares in views in navigable space.
        judge: (J,) shares in judge's views.
        in_cells: Share of the judge's eyes that lie in cells; None without such eyes.
        named: Source of the given judge's eyes; empty without any.
    """

    builder: NDArray[np.float64]
    judge: NDArray[np.float64]
    in_cells: float | None
    named: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, a line and a warning or None, ready for JSON."""
        if self.in_cells is None or len(self.builder) == 0:
            line = "no eye around the detail is free: not checked by other eyes"
            return {"views": len(self.builder), "line": line, "warning": None, "judge_eyes_in_cells": None}
        mine = float(np.median(self.builder))
        theirs = float(np.median(self.judge))
        low = float(np.percentile(self.judge, 5))
        least = float(self.judge.min())
        also = f", also of {self.named}" if self.named else ""
        line = (
            f"their views see {theirs:.1%} of the Gaussians in the median, 5th percentile {low:.1%}, least"
            f" {least:.1%}, in {len(self.judge)} views{also}; views in navigable space {mine:.1%};"
            f" {self.in_cells:.0%} of the eyes where navigable space is"
        )
        apart = max(mine, theirs) > _TIMES * min(mine, theirs)
        warning = (
            f"Warning: views around the detail of the scene see {theirs:.1%} of the Gaussians, views in navigable space"
            f" {mine:.1%}: give --cameras, --box or --around if people stand elsewhere."
        )
        return {
            "views": len(self.builder) + len(self.judge),
            "builder_median": mine,
            "judge_median": theirs,
            "judge_p5": low,
            "judge_least": least,
            "judge_eyes_in_cells": self.in_cells,
            "line": line,
            "warning": warning if apart else None,
        }


def judge_shares(
    g: Gaussians, space: NavigableSpace, views: ViewSampling, tau: float, *, progress: Progress = silent
) -> JudgedShares:
    """Measure the share of a scene that views at builder's and judge's eyes see, half of the views each.

    Args:
        g: The scene.
        space: Navigable space of the builder's eyes; its witnesses are judge's eyes.
        views: The builder's views; judge's views are as many, of the same size.
        tau: Least weight of a visible Gaussian.
        progress: Called with stage "judge", in views.
    """
    mine, judges = judging_views(g, views, space)
    total = len(mine) + len(judges)
    shares = list[float]()
    progress("judge", 0, total)
    for cameras in (mine, judges.cameras):
        for c in range(len(cameras)):
            shares.append(float((view_weights(g, cameras[c]).largest[0] >= np.float32(tau)).mean()))
            progress("judge", len(shares), total)
    eyes = judges.cameras.viewpoints
    values = np.array(shares)
    inside = float((CellGrid.over(space).cell_at(eyes) >= 0).mean()) if len(eyes) else None
    return JudgedShares(values[: len(mine)], values[len(mine) :], inside, judges.named)
