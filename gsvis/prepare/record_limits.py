"""Choose how coarsely records are rounded: the coarsest whose images still have a wanted PSNR, in views drawn for it.

All kinds of fields lose bits together, so one number is searched; with and without rounded places where centers lie on
a lattice, and the smaller result is kept. Then colors may be learned for rounded records, so that still coarser ones
are good enough. Images are compared with those of exact colors and Gaussians. The views are drawn apart from those that
measure the cost of rounding afterwards.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsvis.color.evaluate import Evaluator
from gsvis.color.records import QuantizedColors
from gsvis.color.srbf import SrbfColors
from gsvis.package import Contents, Spread
from gsvis.package.blocks import bytes_of_blocks
from gsvis.package.rounding import (
    MOST_STEP,
    Limits,
    Quality,
    limits_of,
    round_records,
    round_terms,
    rounded_contents,
)
from gsvis.prepare.rounded_colors import RecordLesson, cameras_by_rules
from gsvis.progress import Progress, silent
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["LEARNED_TRIES", "RecordLimits", "cameras_of_choice", "choose_limits", "search_limits"]

F32 = NDArray[np.float32]

FINEST = 4.0
"""Most bits that records have more than those of `Quality()`; with still more, hardly one lacks a bit."""

LEARNED_TRIES = 4
"""Number of roundings for which colors are learned."""

_TRIES = 6
_BELOW = 5.0  # dB that a view may have less than wanted
_LEARNED_BITS = 1.0  # that learning may save of every field at the most


@dataclass(frozen=True, eq=False)
class RecordLimits:
    """How records are rounded, and what that costs in the views of the choice.

    Attributes:
        limits: How they are rounded; None if no rounding has the wanted PSNR.
        finer: Bits more than `Quality()`.
        psnr: Mean PSNR of the views by the rule with the least, dB.
        worst: Least PSNR of a view, dB.
        colors: Colors that were learned for records that are rounded so; None if none were.
    """

    limits: Limits | None
    finer: float
    psnr: float
    worst: float
    colors: QuantizedColors | None = None


def cameras_of_choice(
    levels: Levels, space: NavigableSpace, views: ViewSampling, photos: str | os.PathLike[str] | None = None
) -> list[Cameras]:
    """Return the views that decide how records are rounded: anywhere, of standing people, and of photographs.

    Args:
        levels: Levels.
        space: The navigable space.
        views: Views that measure the cost of rounding; those of the choice are drawn apart from them.
        photos: Folder of photographs; every eighth is left out, as it may judge. None for none.

    Raises:
        SceneError: If too few viewpoints lie outside of solid parts.
        FormatError: If the photographs have no model, or it is malformed.
    """
    apart = replace(views, count=2 * views.count, stream=views.stream + 6)
    return cameras_by_rules(levels, space, apart, photos)


def choose_limits(
    levels: Levels,
    exact: SrbfColors,
    packed: QuantizedColors,
    cameras: Sequence[Cameras],
    wanted: float,
    *,
    lesson: RecordLesson | None = None,
    progress: Progress = silent,
) -> RecordLimits:
    """Return the coarsest rounding with the wanted mean PSNR by every rule, and no view more than 5 dB below it.

    Args:
        levels: Levels in the order of a package; the highest is drawn.
        exact: Colors of the union before rounding.
        packed: Colors of the union after rounding to tables.
        cameras: Views by each of R > 0 rules, at least one by each.
        wanted: Least mean PSNR, dB.
        lesson: What colors of rounded records are learned from, of the same levels and colors; None learns none.
        progress: Called with stages "rounding", in tries, and with a lesson "learn".

    Raises:
        ValueError: If a rule has no camera, or lengths do not match.
    """
    if not cameras or min(map(len, cameras)) == 0:
        raise ValueError("cameras: expected at least one by each rule, got none")
    contents = Contents.from_levels(levels, packed)
    member = levels.member(len(levels) - 1)
    truth = [_draw(levels.union[member], exact[member], views) for views in cameras]

    def judge(rounded: Contents) -> Spread:
        """Return the PSNR of rounded records by the rule with the least mean, and of the worst view of all rules."""
        g = rounded.gaussians(np.flatnonzero(member))
        colors = rounded.colors().dequantize()[member]
        found = []
        for views, images in zip(cameras, truth, strict=True):
            pairs = zip(_draw(g, colors, views), images, strict=True)
            found.append(Spread.from_values([min(100.0, float(psnr(a, b))) for a, b in pairs]))
        return Spread(min(each.psnr for each in found), min(each.worst for each in found))

    found = search_limits(contents, judge, wanted, progress=progress)
    if lesson is None or found.limits is None:
        return found
    return _search_learned(contents, found, lesson, judge, wanted, progress)


def _search_learned(
    contents: Contents,
    plain: RecordLimits,
    lesson: RecordLesson,
    judge: Callable[[Contents], Spread],
    wanted: float,
    progress: Progress,
) -> RecordLimits:
    """Return the coarsest rounding that is good enough with learned colors.

    Args:
        contents: The records with all bits.
        plain: The coarsest rounding without learning, returned if none is better.
        lesson: What colors are learned from.
        judge: Returns the PSNR of rounded records.
        wanted: Least mean PSNR, dB; a view may have 5 dB less.
        progress: Called with stage "learn", in steps of all tries.
    """
    assert plain.limits is not None
    quality = Quality() if plain.limits.place > -MOST_STEP else Quality(place=None)
    high = plain.finer
    low = max(high - _LEARNED_BITS, 0.0)
    found = plain
    steps = lesson.config.steps
    for k in range(LEARNED_TRIES):

        def step(stage: str, done: int, total: int, before: int = k * steps) -> None:
            """Report progress over all tries."""
            progress(stage, before + done, LEARNED_TRIES * steps)

        finer = 0.5 * (low + high)
        limits = limits_of(contents, quality.finer(finer))
        colors = lesson.learn(limits, progress=step)
        spread = judge(rounded_contents(lesson.levels, colors, limits))
        if spread.psnr >= wanted and spread.worst >= wanted - _BELOW:
            found = RecordLimits(limits, finer, spread.psnr, spread.worst, colors)
            high = finer
        else:
            low = finer
    return found


def search_limits(
    contents: Contents, judge: Callable[[Contents], Spread], wanted: float, *, progress: Progress = silent
) -> RecordLimits:
    """Return the coarsest rounding of records that a judge finds good enough; of several ways the smallest.

    Args:
        contents: The records with all bits.
        judge: Returns the PSNR of rounded records.
        wanted: Least mean PSNR, dB; a view may have 5 dB less.
        progress: Called with stage "rounding", in tries.
    """
    ways = [Quality()]
    if contents.table.logarithmic.any():  # exact places on a lattice may take fewer bits than rounded ones
        ways.append(Quality(place=None))
    best = RecordLimits(None, 0.0, 0.0, 0.0)
    smallest = np.inf
    total = _TRIES * len(ways)
    for way, quality in enumerate(ways):

        def step(k: int, before: int = _TRIES * way) -> None:
            """Report progress."""
            progress("rounding", before + k, total)

        found, rounded = _search(contents, quality, judge, wanted, step)
        nbytes = np.inf if rounded is None else bytes_of_blocks(rounded)
        if nbytes < smallest:
            best = found
            smallest = nbytes
    progress("rounding", total, total)
    return best


def _search(
    contents: Contents,
    quality: Quality,
    judge: Callable[[Contents], Spread],
    wanted: float,
    progress: Callable[[int], None],
) -> tuple[RecordLimits, Contents | None]:
    """Return the coarsest rounding that is good enough, and the rounded records; None if none is.

    Args:
        contents: The records with all bits.
        quality: The coarsest rounding to try.
        judge: Returns the PSNR of rounded records.
        wanted: Least mean PSNR, dB.
        progress: Called with the number of tries so far.
    """
    low = 0.0
    high = FINEST
    found = RecordLimits(None, 0.0, 0.0, 0.0)
    kept: Contents | None = None
    for k in range(_TRIES):
        progress(k)
        finer = high if k == 0 else 0.5 * (low + high)
        limits = limits_of(contents, quality.finer(finer))
        rounded = round_terms(round_records(contents, limits), limits)
        spread = judge(rounded)
        if spread.psnr >= wanted and spread.worst >= wanted - _BELOW:
            found = RecordLimits(limits, finer, spread.psnr, spread.worst)
            kept = rounded
            high = finer
        elif k == 0:
            break
        else:
            low = finer
    return found, kept


def _draw(g: Gaussians, colors: SrbfColors, cameras: Cameras) -> list[F32]:
    """Return an image (H, W, 3) in [0, 1] of Gaussians with colors from each camera."""
    shown = Evaluator(colors)
    images = []
    for c in range(len(cameras)):
        camera = cameras[c]
        drawn = rasterize(g, camera, colors=shown.colors(g.means, camera.viewpoints[0])).images[0]
        images.append(np.asarray(np.clip(drawn, 0.0, 1.0), np.float32))
    return images
