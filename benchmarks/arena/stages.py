"""What a client shows after so many bytes: one list of stages for each system, played over a link.

A stage is complete when its last byte has arrived. Before the first one the client shows nothing. Decoding takes no
time, for any system. gsvis has no such list, as what it sends follows the viewer: `systems/gsvis.py` plays it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from arena.course import Course
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.simulate import Link, Pipe

__all__ = ["Playable", "Shown", "Stages", "cut_rows"]

F32 = NDArray[np.float32]

PARTS = 16
"""Stages of a file that is shown while it arrives."""


class Shown(Protocol):
    """What a client shows during one session."""

    def image(self, view: int, t: float) -> F32 | None:
        """Return the (H, W, 3) image of a held-out pose with what has arrived by t seconds; None for nothing."""
        ...

    def bytes_at(self, t: float) -> float:
        """Return the bytes that have arrived by t seconds."""
        ...


class Playable(Protocol):
    """A trained system that can be sent."""

    @property
    def nbytes(self) -> int:
        """Bytes of all of it."""
        ...

    @property
    def count(self) -> int:
        """Number of Gaussians, or of what stands for them."""
        ...

    def play(self, course: Course, link: Link) -> Shown:
        """Return what a client shows that walks over the course."""
        ...

    def whole(self, course: Course, view: int) -> F32:
        """Return the (H, W, 3) image of a held-out pose with all of it."""
        ...


@dataclass(frozen=True, eq=False)
class Stages:
    """A download: what is shown after each of its parts.

    Attributes:
        ends: (S,) bytes from the beginning after which each stage is complete, strictly rising.
        draw: Function from a stage and a camera to the image (H, W, 3) in [0, 1].
        count: Number of Gaussians, or of what stands for them.
    """

    ends: tuple[int, ...]
    draw: Callable[[int, Cameras], F32]
    count: int

    def __post_init__(self) -> None:
        if not self.ends or self.ends[0] <= 0 or any(b <= a for a, b in zip(self.ends, self.ends[1:], strict=False)):
            raise ValueError(f"ends: expected strictly rising bytes > 0, got {self.ends!r}")
        object.__setattr__(self, "_kept", {})

    @property
    def nbytes(self) -> int:
        """Bytes of the whole download."""
        return self.ends[-1]

    @classmethod
    def at_once(cls, nbytes: int, g: Gaussians) -> Stages:
        """Return the stages of a file that shows nothing until it is complete."""
        return cls((nbytes,), lambda stage, camera: _draw(g, camera), len(g))

    def image(self, course: Course, view: int, stage: int) -> F32:
        """Return the image of a held-out pose at a stage; each is drawn once."""
        kept: dict[tuple[int, int], F32] = self._kept  # type: ignore[attr-defined]
        if (view, stage) not in kept:
            kept[view, stage] = self.draw(stage, course.held_out.cameras[view])
        return kept[view, stage]

    def whole(self, course: Course, view: int) -> F32:
        """Return the image of a held-out pose with all of it."""
        return self.image(course, view, len(self.ends) - 1)

    def play(self, course: Course, link: Link) -> Download:
        """Return the download over a link: the request takes half a round trip, then bytes fill the link."""
        pipe = Pipe(link)
        starts = (0, *self.ends[:-1])
        times = [pipe.send(link.delay, end - start) for start, end in zip(starts, self.ends, strict=True)]
        return Download(self, course, link, np.array(times))


@dataclass(frozen=True, eq=False)
class Download:
    """A download over one link.

    Attributes:
        stages: What is shown.
        course: Where the viewer walks.
        link: The link.
        times: (S,) seconds at which each stage is complete.
    """

    stages: Stages
    course: Course
    link: Link
    times: NDArray[np.float64]

    def image(self, view: int, t: float) -> F32 | None:
        """Return what is shown; see `Shown`."""
        stage = int(np.searchsorted(self.times, t, side="right")) - 1
        return None if stage < 0 else self.stages.image(self.course, view, stage)

    def bytes_at(self, t: float) -> float:
        """Return the bytes that have arrived; see `Shown`."""
        carried = self.link.trace.bytes_between(self.link.delay, max(t - self.link.delay, self.link.delay))
        return min(carried, float(self.stages.nbytes))


def cut_rows(header: int, row_bytes: float, g: Gaussians, parts: int = PARTS) -> Stages:
    """Return the stages of a file whose rows are shown as they arrive.

    Args:
        header: Bytes before the first row.
        row_bytes: Bytes of a row.
        g: The Gaussians, in the order of the rows.
        parts: Number of stages.
    """
    counts = np.unique(np.linspace(0, len(g), parts + 1).astype(np.int64))[1:]
    ends = tuple(int(np.ceil(header + row_bytes * count)) for count in counts)
    return Stages(ends, lambda stage, camera: _draw(g[: counts[stage]], camera), len(g))


def _draw(g: Gaussians, camera: Cameras) -> F32:
    """Return the image of Gaussians in [0, 1]."""
    return np.asarray(np.clip(rasterize(g, camera).images[0], 0.0, 1.0), np.float32)
