"""Improve fitted colors by learning from photographs or renders, and measure what it gained.

Rounded colors are measured, as records hold them. Views that measure are never learned from.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsvis._extras import has
from gsvis.color.blend import blend_colors
from gsvis.color.evaluate import Evaluator
from gsvis.color.sh import seen_sh_colors
from gsvis.color.srbf import SrbfColors
from gsvis.files.mapped import release_mapped
from gsvis.files.scratch import Scratch
from gsvis.jobs.freed_memory import release_freed_memory
from gsvis.jobs.in_order import in_order
from gsvis.progress import Progress, silent
from gsvis.render.fixed_view import FixedView
from gsvis.render.metrics import psnr
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.history import MOST_PSNR
from gsvis.train.images import PosedImages

if TYPE_CHECKING:
    from gsvis.train.colors import LearnConfig

__all__ = [
    "RENDERS",
    "ColorMeasure",
    "Learned",
    "Lesson",
    "draw_lesson",
    "learn_lesson",
    "read_lesson",
    "renders_teach",
    "steps_of_learning",
]

F64 = NDArray[np.float64]

RENDERS = ViewSampling(256, 320, 240, stream=3)
"""Views to learn from without photographs; streams 0 to 2 are those of the fit, of held-out views and of epsilon."""

_EVERY = 8  # of the renders, one is held out
_STEPS = 300  # unless somebody asks for another number
_GAINED = 0.05  # dB in the mean below which learning is said to have gained nothing
_MAY_LOSE = 0.25  # dB that the worst held-out view may lose
_SHARES = (0.5, 0.25)  # of the change, that are tried where the whole costs the worst view more


@dataclass(frozen=True, eq=False)
class Lesson:
    """What colors are learned from: images, or cameras alone, from which the scene with its SH colors is to be shown.

    Attributes:
        views: What to show.
        held_out: What measures the result; None measures nothing.
        named: What the images are, such as "photographs".
        config: How to learn.
    """

    views: PosedImages | Cameras
    held_out: PosedImages | Cameras | None
    named: str
    config: LearnConfig


@dataclass(frozen=True, eq=False)
class Learned:
    """What learning changed, on images that were held out.

    Attributes:
        named: What the images are.
        views: Number of images learned from.
        config: How it was learned, as plain values.
        psnr: dB at most 100 of each held-out image, by what was drawn: "fitted" for the colors before, "learned" for
            those after, both rounded, and with photographs "sh" for the scene with its own colors. Empty without
            held-out images.
        share: Share of the change that is kept: 1 for learned colors, 0 for fitted ones. With a share of 0 "learned" is
            the whole change.
    """

    named: str
    views: int
    config: dict[str, Any]
    psnr: dict[str, F64] = field(default_factory=dict)
    share: float = 1.0

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain numbers and strings for JSON."""
        found = {name: {"mean": float(each.mean()), "worst": float(each.min())} for name, each in self.psnr.items()}
        held_out = len(next(iter(self.psnr.values()), ()))
        about = {"from": self.named, "views": self.views, "held_out": held_out, "share": self.share}
        return {**about, "config": self.config, "psnr": found}

    @property
    def gain(self) -> float:
        """Change of held-out images in the mean, dB; 0 without any."""
        return float(self.psnr["learned"].mean() - self.psnr["fitted"].mean()) if self.psnr else 0.0

    @property
    def worst_gain(self) -> float:
        """Change of the worst held-out image, which may be another one then, dB; 0 without any."""
        return float(self.psnr["learned"].min() - self.psnr["fitted"].min()) if self.psnr else 0.0

    @property
    def helps(self) -> bool:
        """Whether the mean of held-out images does not fall, and the worst falls by little."""
        return self.gain >= 0.0 and self.worst_gain >= -_MAY_LOSE

    @property
    def remark(self) -> str | None:
        """A sentence for the user if nothing was gained, else None."""
        if not self.psnr:
            return None
        gain = self.gain
        if gain >= _GAINED and self.share:
            return None
        if self.named == "renders":
            worst = f", the worst by {self.worst_gain:+.2f} dB. They keep the fit" if not self.share else ""
            return f"Learning from renders changed held-out views by {gain:+.2f} dB{worst}."
        wrong = "; check that they show this scene, in its frame" if self.named == "photographs" else ""
        return f"Learning from {self.named} changed held-out views by {gain:+.2f} dB{wrong}."


def steps_of_learning(asked: int | None, *, photos: bool, renders: bool = False) -> int:
    """Return the steps of learning colors: as asked, or else 300 where something teaches and 0 elsewhere.

    Args:
        asked: The number that somebody asked for; None for nobody.
        photos: Whether there are photographs.
        renders: Whether renders of the scene teach; see `renders_teach`.
    """
    if asked is not None:
        return asked
    return _STEPS if photos or renders else 0


def renders_teach(g: Gaussians) -> bool:
    """Return whether colors are learned from renders of a scene unless somebody says otherwise.

    Without view dependence base colors are exact. Learning needs torch.
    """
    return g.sh_degree > 0 and len(g) > 0 and has("torch")


def read_lesson(
    g: Gaussians,
    photos: str | os.PathLike[str],
    steps: int,
    *,
    size: tuple[int, int] | None = None,
    downscale: float | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> tuple[Lesson, tuple[str, ...]]:
    """Return photographs to learn from, every eighth held out, and remarks for the user.

    Args:
        g: The scene, trained from the same reconstruction.
        photos: Folder of a COLMAP model or a `transforms.json` with its images.
        steps: Steps of learning.
        size: Pixels (width, height) to shrink the photographs to; None keeps their size.
        downscale: Factor to shrink the photographs by instead.
        seed: Seed of the order of photographs.
        progress: Called with stage "photos".

    Raises:
        GsvisError: If they cannot be read, or show nothing of the scene.
    """
    from gsvis.train.colors import LearnConfig
    from gsvis.train.level_views import load_photograph_views

    read = load_photograph_views(g, photos, size, downscale=downscale, progress=progress)
    return Lesson(read.views, read.held_out, "photographs", LearnConfig(steps=steps, seed=seed)), read.remarks


def draw_lesson(g: Gaussians, space: NavigableSpace, steps: int, *, seed: int = 0) -> Lesson:
    """Return views of a scene to learn from, every eighth held out.

    Args:
        g: The scene with its SH colors.
        space: Where the eyes are.
        steps: Steps of learning.
        seed: Seed of the cameras and of their order.

    Raises:
        SceneError: If no viewpoint is usable.
    """
    from gsvis.train.colors import LearnConfig

    cameras = replace(RENDERS, seed=seed).cameras(g, space)
    last = np.arange(len(cameras)) % _EVERY == 0
    return Lesson(cameras[~last], cameras[last], "renders", LearnConfig.for_renders(steps, seed))


def learn_lesson(
    g: Gaussians,
    colors: SrbfColors,
    lesson: Lesson,
    to_records: Callable[[SrbfColors], SrbfColors],
    *,
    shown: NDArray[np.bool_] | None = None,
    backend: str = "auto",
    folder: Path | None = None,
    progress: Progress = silent,
) -> tuple[SrbfColors, Learned]:
    """Learn colors from images, and measure them before and after.

    Args:
        g: N Gaussians with their SH colors.
        colors: Fitted colors.
        lesson: The images, and how to learn.
        to_records: Function that rounds colors as records hold them.
        shown: (N,) bool, the Gaussians of the highest of several levels; None means all.
        backend: Backend that draws while colors are learned, see `learn_colors`; the CPU measures.
        folder: Folder for temporary files, see `learn_colors`.
        progress: Called with stages "learn" and "measure".

    Returns:
        The learned colors, not rounded, and what was gained. Where renders teach, it is the largest share of the change
        with which the mean of held-out images does not fall and the worst falls by at most 0.25 dB: all, half, a
        quarter, or the colors as they were.
    """
    from gsvis.train.colors import learn_colors

    whole = np.ones(len(g), bool) if shown is None else shown
    learned = learn_colors(
        g, colors, lesson.views, lesson.config, shown=shown, backend=backend, folder=folder, progress=progress
    )
    about = Learned(lesson.named, len(lesson.views), asdict(lesson.config))
    if lesson.held_out is None:
        return learned, about
    drawn: dict[str, SrbfColors | None] = {} if lesson.named == "renders" else {"sh": None}
    drawn |= {"fitted": colors, "learned": learned}
    release_freed_memory()
    measure = ColorMeasure(g, whole, lesson.held_out, folder)
    about.psnr.update(
        zip(drawn, measure.psnr_of(*drawn.values(), to_records=to_records, progress=progress), strict=True)
    )
    if lesson.named != "renders" or about.helps:
        return learned, about
    for share in _SHARES:
        blended = blend_colors(colors, learned, share)
        release_mapped([*vars(colors).values(), *vars(learned).values()])
        (found,) = measure.psnr_of(blended, to_records=to_records)
        less = replace(about, psnr={"fitted": about.psnr["fitted"], "learned": found}, share=share)
        if less.helps:
            return blended, less
    return colors, replace(about, share=0.0)


def _lay_out(colors: SrbfColors, to_records: Callable[[SrbfColors], SrbfColors] | None, scratch: Scratch) -> Evaluator:
    """Return what draws colors, rounded if they are to be; rounded ones are not kept."""
    if to_records is None:
        return Evaluator(colors, scratch=scratch)
    return Evaluator(to_records(colors), keep=False, scratch=scratch)


class ColorMeasure:
    """Views that measure colors.

    Args:
        g: N Gaussians with their SH colors.
        shown: (N,) bool, those that are drawn.
        views: Images with their cameras; or cameras alone, for which the SH colors make the images.
        folder: Folder for temporary files of the colors, so that memory holds those of one view; None keeps all in
            memory.
    """

    def __init__(
        self, g: Gaussians, shown: NDArray[np.bool_], views: PosedImages | Cameras, folder: Path | None = None
    ) -> None:
        self._scene = g
        self._scratch = Scratch(folder)
        self._ids = np.flatnonzero(shown)
        self._drawn = g.without_harmonics()[shown]
        self._views = views

    def psnr_of(
        self,
        *tried: SrbfColors | None,
        to_records: Callable[[SrbfColors], SrbfColors] | None = None,
        progress: Progress = silent,
    ) -> tuple[F64, ...]:
        """Return (C,) dB of drawn views against their images, both clipped to [0, 1], for each of some colors.

        Args:
            tried: Colors of the Gaussians; None means SH.
            to_records: Function that rounds the colors first; None draws them as they are.
            progress: Called with stage "measure", in views.
        """
        views = self._views
        cameras = views if isinstance(views, Cameras) else views.cameras
        evaluators: list[Evaluator | None] = []
        for colors in tried:
            evaluators.append(None if colors is None else _lay_out(colors, to_records, self._scratch))
            self._scratch.release()
            release_freed_memory()
        found = np.empty((len(tried), len(views)))

        def measure(c: int) -> None:
            """Measure all colors in one view."""
            seen = FixedView(self._drawn, cameras[c])
            ids = self._ids[seen.ids]
            own = seen_sh_colors(self._scene, ids, seen.eye)
            wanted = np.clip(seen.image(own) if isinstance(views, Cameras) else views.image(c), 0.0, 1.0)
            for k, evaluator in enumerate(evaluators):
                shades = own if evaluator is None else evaluator.colors(self._scene.means, seen.eye, ids=ids)
                self._scratch.release()
                found[k, c] = min(float(psnr(np.clip(seen.image(shades), 0.0, 1.0), wanted)), MOST_PSNR)

        progress("measure", 0, len(views))
        for c, _ in enumerate(in_order(measure, range(len(views)))):
            progress("measure", c + 1, len(views))
        return tuple(found)
