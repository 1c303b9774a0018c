"""Learn colors of rounded records: base colors and intensities make up for what the rest of a record lost.

Rounded places, shapes and lobes change images. Where they stay as they are, an image is linear in base colors and
intensities, so that learning these takes back a part of the change. The images to resemble are those of exact records;
no photographs are needed. Images and frames are those of `PosedImages`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis.color.evaluate import Evaluator
from gsvis.color.records import Grids, QuantizedColors, quantize
from gsvis.color.srbf import SrbfColors
from gsvis.package.rounding import Limits, rounded_contents
from gsvis.progress import Progress, silent
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.images import PosedImages
from gsvis.train.photos import load_photo_cameras

if TYPE_CHECKING:
    from gsvis.train.colors import LearnConfig

__all__ = ["EVERY", "LESSON", "STEPS", "WIDE", "RecordLesson", "cameras_by_rules"]

LESSON = ViewSampling(256, 320, 240, stream=13)
"""Views to learn from, shared among the rules; no other views of a preparation are of this stream."""

STEPS = 300
"""Steps of learning, one view each."""

WIDE = 80.0
"""Degrees that eyes of standing people see."""

EVERY = 8
"""Of photographs, one is left out: it may judge."""


@dataclass(frozen=True, eq=False)
class RecordLesson:
    """What colors of rounded records are learned from.

    Attributes:
        levels: Levels in the order of a package.
        exact: Colors of the union before rounding.
        packed: Colors of the union after rounding to tables.
        views: Images of the highest level with exact colors.
        config: How to learn.
        backend: Backend that draws while colors are learned, see `learn_colors`.
    """

    levels: Levels
    exact: SrbfColors
    packed: QuantizedColors
    views: PosedImages
    config: LearnConfig
    backend: str = "auto"

    @classmethod
    def draw(
        cls,
        levels: Levels,
        exact: SrbfColors,
        packed: QuantizedColors,
        space: NavigableSpace,
        photos: str | os.PathLike[str] | None = None,
        *,
        views: ViewSampling | None = None,
    ) -> RecordLesson:
        """Draw the images to learn from: anywhere, of standing people, and at poses of photographs.

        Args:
            levels: Levels in the order of a package; the highest is drawn.
            exact: Colors of the union before rounding.
            packed: Colors of the union after rounding to tables.
            space: The navigable space.
            photos: Folder of photographs, of which only the cameras are used; None for none.
            views: Number and size of all images; None means `LESSON`.

        Raises:
            SceneError: If too few viewpoints lie outside of solid parts.
            FormatError: If the photographs have no model, or it is malformed.
        """
        from gsvis.train.colors import LearnConfig

        member = levels.member(len(levels) - 1)
        drawn = views or LESSON
        rules = 2 if photos is None else 3
        each = replace(drawn, count=max(drawn.count // rules, 1))
        cameras = _join(cameras_by_rules(levels, space, each, photos))
        images = _draw(levels, exact, member, cameras)
        return cls(levels, exact, packed, PosedImages(cameras, images), LearnConfig.for_records(STEPS))

    def learn(self, limits: Limits, *, progress: Progress = silent) -> QuantizedColors:
        """Return the colors of records that are rounded by these limits: other base colors and intensities.

        Gaussians that no image shows keep their colors, but for rounding. Rounding again by the same limits changes
        few lobes: those whose intensity fell so far that they lack another bit.

        Args:
            limits: How records are rounded.
            progress: Called with every step; stage "learn".
        """
        from gsvis.train.colors import learn_colors

        contents = rounded_contents(self.levels, self.packed, limits)
        begun = replace(contents.colors().dequantize(), base=self.exact.base)
        shown = self.levels.member(len(self.levels) - 1)
        learned = learn_colors(
            contents.gaussians(),
            begun,
            self.views,
            self.config,
            shown=shown,
            backend=self.backend,
            progress=progress,
        )
        grids = self.packed.grids
        return quantize(_clip(learned, grids), grids=grids)


def cameras_by_rules(
    levels: Levels, space: NavigableSpace, views: ViewSampling, photos: str | os.PathLike[str] | None = None
) -> list[Cameras]:
    """Return views by each of two or three rules: anywhere, of standing people, and of photographs.

    Args:
        levels: Levels.
        space: The navigable space.
        views: Views by each rule.
        photos: Folder of photographs; every eighth is left out, as it may judge. None for none.

    Raises:
        SceneError: If too few viewpoints lie outside of solid parts.
        FormatError: If the photographs have no model, or it is malformed.
    """
    rules = views, replace(views, fov=max(views.fov, WIDE), standing=1.0)
    found = [rule.cameras(levels, space) for rule in rules]
    if photos is not None:
        poses = load_photo_cameras(photos)
        taken = poses[np.flatnonzero(np.arange(len(poses)) % EVERY)] if len(poses) > 1 else poses
        found.append(taken.evenly(views.count).resize(views.width, views.height))
    return found


def _join(cameras: list[Cameras]) -> Cameras:
    """Return all cameras of one size together, without names."""
    viewmats = np.concatenate([each.viewmats for each in cameras])
    Ks = np.concatenate([each.Ks for each in cameras])
    return Cameras(viewmats, Ks, cameras[0].width, cameras[0].height)


def _draw(levels: Levels, colors: SrbfColors, member: NDArray[np.bool_], cameras: Cameras) -> NDArray[np.float32]:
    """Return images (C, H, W, 3) of a level, with values above white."""
    g = levels.union[member]
    shown = Evaluator(colors[member])
    images = np.empty((len(cameras), cameras.height, cameras.width, 3), np.float32)
    for c in range(len(cameras)):
        seen = shown.colors(g.means, cameras[c].viewpoints[0])
        images[c] = rasterize(g, cameras[c], colors=seen).images[0]
    return images


def _clip(colors: SrbfColors, grids: Grids) -> SrbfColors:
    """Return colors within the ranges of tables."""
    lows, highs = np.array(grids.base, np.float32).T
    base = np.clip(colors.base, lows, highs)
    if grids.kind.space == "hsl":
        base[:, 0] = colors.base[:, 0]  # hues go around
    largest = np.float32(grids.intensity)
    return replace(colors, base=base, intensities=np.clip(colors.intensities, -largest, largest))
