"""Measure the quality of the levels of a scene from given cameras: similarity to the scene and photos, brightness.

Images are compared as a display shows them, clipped to [0, 1]. Brightness is the mean of these values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.progress import Progress, silent
from gsvis.pvs.cells import CellGrid
from gsvis.render.judges import find_judges
from gsvis.render.metrics import psnr
from gsvis.scene.cameras import Cameras
from gsvis.scene.judged import Judged
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.history import MOST_PSNR
from gsvis.train.images import PosedImages, display_images

__all__ = ["LevelQuality", "judge_levels", "measure_levels"]


@dataclass(frozen=True, eq=False)
class LevelQuality:
    """Quality of L levels in C views.

    Attributes:
        scene_psnr: (L, C) dB, against the highest level, at most 100; the last row is 100.
        photo_psnr: (L, C) dB, against photos; None without photos.
        brightness: (L,) mean of all values in [0, 1] over pixels, channels and views.
    """

    scene_psnr: NDArray[np.float64]
    photo_psnr: NDArray[np.float64] | None
    brightness: NDArray[np.float64]


def measure_levels(
    levels: Levels,
    views: PosedImages,
    *,
    photographs: bool = False,
    backend: str = "auto",
    progress: Progress = silent,
) -> LevelQuality:
    """Render all levels in some views, and compare them.

    Args:
        levels: L levels; the highest is the scene.
        views: C images and cameras, C >= 1.
        photographs: Whether the images are photos to compare with; otherwise only their cameras are used.
        backend: Backend of the rasterizer.
        progress: Called with stage "measure"; counts rendered images.

    Raises:
        ValueError: If there are no views.
    """
    if len(views) == 0:
        raise ValueError("views: expected at least one view to compare, got none")
    top = len(levels) - 1
    count = len(views)
    scene = np.empty((len(levels), count))
    photo = np.empty((len(levels), count)) if photographs else None
    brightness = np.zeros(len(levels))
    progress("measure", 0, count * len(levels))
    images: list[NDArray[np.float32]] = []  # of the highest level, which is measured first
    for place, k in enumerate(reversed(range(len(levels)))):
        cameras = [views.cameras[c] for c in range(count)]
        for c, drawn in enumerate(display_images(levels.drawn_level(k), cameras, backend)):
            brightness[k] += float(drawn.mean(dtype=np.float64)) / count
            if k == top:
                images.append(drawn)
            scene[k, c] = min(float(psnr(drawn, images[c])), MOST_PSNR)
            if photo is not None:
                photo[k, c] = min(float(psnr(drawn, np.clip(views.image(c), 0.0, 1.0))), MOST_PSNR)
            progress("measure", place * count + c + 1, count * len(levels))
    return LevelQuality(scene, photo, brightness)


def judge_levels(
    levels: Levels,
    mine: Cameras,
    views: ViewSampling,
    space: NavigableSpace | None,
    *,
    backend: str = "auto",
    progress: Progress = silent,
) -> tuple[Judged, ...]:
    """Return the quality of each level below the highest at builder's and judge's eyes.

    A lower level need not equal the scene, so no least PSNR is required, only similar quality at both kinds of eyes.

    Args:
        levels: L levels; the highest is the scene.
        mine: Views like those that the levels were trained for.
        views: Number, size, field of view and seed of the judge's views.
        space: Navigable space of `mine`; None for photos.
        backend: Backend of the rasterizer.
        progress: Called with stage "judge", in views of all levels.
    """
    judges = find_judges(levels.bare_level(len(levels) - 1), views, None if space is None else space.witnesses)
    cameras = [each[c] for each in (mine, judges.cameras) for c in range(len(each))]
    below = len(levels) - 1
    total = len(cameras) * (below + 1)
    found = np.empty((below, len(cameras)))
    progress("judge", 0, total)
    whole = []
    for drawn in display_images(levels.drawn_level(len(levels) - 1), cameras, backend):
        whole.append(drawn)
        progress("judge", len(whole), total)
    for k in range(below):
        for number, drawn in enumerate(display_images(levels.drawn_level(k), cameras, backend)):
            found[k, number] = min(float(psnr(drawn, whole[number])), MOST_PSNR)
            progress("judge", (k + 1) * len(cameras) + number + 1, total)
    inside = None
    if space is not None and len(judges):
        inside = np.asarray(CellGrid.over(space).cell_at(judges.cameras.viewpoints) >= 0)
    split = len(mine)
    return tuple(Judged(row[:split], row[split:], inside, judges.named, judges.given, least=0.0) for row in found)
