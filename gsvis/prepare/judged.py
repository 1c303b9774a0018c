"""Check visible sets by two rules: builder's eyes in navigable space, and judge's eyes that do not know of it.

An image from the set of the cell that a client would use is compared with the image of the whole highest level. PSNR in
dB, at most 100. A warning names what to do where judge's eyes see much less than builder's eyes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judging import draw_judges
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["Judged", "judge_sets"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_CAP = 100.0
_LEAST = 35.0  # dB below which a median is warned about
_APART = 6.0  # dB between the medians of the two rules
_GOOD = 50.0  # dB from which a difference of the two rules does not matter


@dataclass(frozen=True, eq=False)
class Judged:
    """The PSNR of images from the sets of cells, by two rules.

    Attributes:
        builder: (B,) dB, at eyes drawn in navigable space.
        judge: (J,) dB, at eyes drawn around the detail; (0,) where no such eye is free.
        in_cells: Share of the judge's eyes that lie in a cell; 0 without such eyes.
    """

    builder: F64
    judge: F64
    in_cells: float

    @property
    def warning(self) -> str | None:
        """A sentence where the sets are not good for judge's eyes; None where they are."""
        advice = "give --cameras, --up or --box if people stand elsewhere"
        if len(self.judge) == 0:
            return None
        mine, theirs = float(np.median(self.builder)), float(np.median(self.judge))
        apart = mine - theirs > _APART and theirs < _GOOD
        if theirs >= _LEAST and mine >= _LEAST and not apart:
            return None
        return (
            f"Warning: eyes around the detail of the scene see {theirs:.1f} dB in the median, eyes in navigable space"
            f" {mine:.1f} dB; {self.in_cells:.0%} of the former lie in cells: {advice}."
        )

    @property
    def line(self) -> str:
        """The figures as a line of text."""
        if len(self.judge) == 0:
            return "no eye around the detail is free: not checked by other eyes"
        low, least = np.percentile(self.judge, 5), self.judge.min()
        return (
            f"{np.median(self.judge):.1f} dB in the median, 5th percentile {low:.1f}, worst {least:.1f},"
            f" in {len(self.judge)} views; {self.in_cells:.0%} of the eyes in cells"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, ready for JSON."""
        return {
            "views": len(self.builder) + len(self.judge),
            "builder": _spread(self.builder),
            "judge": _spread(self.judge),
            "all": _spread(np.concatenate([self.builder, self.judge])),
            "judge_eyes_in_cells": self.in_cells,
            "warning": self.warning,
        }


def judge_sets(
    scene: Levels, space: NavigableSpace, store: VisibilityStore, views: ViewSampling, *, progress: Progress = silent
) -> Judged:
    """Measure images from the sets of a store at eyes of both rules; half of the views by each.

    Args:
        scene: The levels of which the store holds the sets.
        space: Where the builder's eyes are.
        store: The visible sets.
        views: The builder's views; judge's views are as many, of the same size.
        progress: Called with stage "judge", in views.
    """
    member = scene.member(len(scene) - 1)
    g = scene.union[member]

    def look(cameras: Cameras) -> tuple[F32, F32]:
        drawn = rasterize(g, cameras, backend="cpu")
        return drawn.alphas, drawn.depths

    judges = draw_judges(g, views.count, look, seed=views.seed, width=views.width, height=views.height, fov=views.fov)
    mine = views.cameras(scene, space)
    total = len(mine) + len(judges)
    progress("judge", 0, total)
    found: list[float] = []
    for cameras in (mine, judges):
        for c in range(len(cameras)):
            found.append(_measure(scene.union, member, g, store, cameras[c]))
            progress("judge", len(found), total)
    inside = store.grid.cell_at(judges.viewpoints) >= 0 if len(judges) else np.zeros(0, bool)
    values = np.array(found)
    return Judged(values[: len(mine)], values[len(mine) :], float(inside.mean()) if len(judges) else 0.0)


def _measure(
    union: Gaussians, member: NDArray[np.bool_], g: Gaussians, store: VisibilityStore, camera: Cameras
) -> float:
    """Return the PSNR of the image from the set of an eye's cell, or of the nearest cell, against the whole."""
    eye = camera.viewpoints[0]
    cell = int(store.grid.cell_at(eye[None])[0])
    if cell < 0:
        cell = int(np.linalg.norm(store.grid.centers - eye, axis=1).argmin())
    seen = np.zeros(len(union), bool)
    seen[store.visible_ids(cell)] = True
    image, target = _draw(union[member & seen], camera), _draw(g, camera)
    return min(_CAP, float(psnr(image, target)))


def _draw(g: Gaussians, camera: Cameras) -> F32:
    return np.asarray(np.clip(rasterize(g, camera, backend="cpu").images[0], 0.0, 1.0), np.float32)


def _spread(values: F64) -> dict[str, Any]:
    """Return number, mean, median, 5th percentile and worst; None where there are no values."""
    if len(values) == 0:
        return {"views": 0, "mean": None, "median": None, "p5": None, "worst": None}
    return {
        "views": len(values),
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p5": float(np.percentile(values, 5)),
        "worst": float(values.min()),
    }
