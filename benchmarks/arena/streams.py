"""What a client shows whose server follows the viewer: a delivery of `gsvis.simulate`, seen at the held-out poses.

The same rules as in `gsvis.simulate.viewing`, with photographs' own cameras. Seconds; images (H, W, 3) in [0, 1].
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from arena.course import Course
from gsvis.scene.cameras import Cameras
from gsvis.simulate import Delivery, Frame, Link, Playback, Stage, play

__all__ = ["Streamed"]

F32 = NDArray[np.float32]

_TICK = 0.1
_AFTER = 1.1  # seconds after the walk in which the last pose may still be shown


@dataclass(frozen=True, eq=False)
class Streamed:
    """A package and the way in which it is delivered.

    Attributes:
        stage: The package as clients draw it.
        deliver: Returns a new delivery.
        nbytes: Bytes of all that can be sent.
        count: Number of Gaussians of the highest level.
        frames: Prepared poses, by held-out view; several systems of one package share them.
    """

    stage: Stage
    deliver: Callable[[], Delivery]
    nbytes: int
    count: int
    frames: dict[int, Frame] = field(default_factory=dict)

    def frame(self, course: Course, view: int) -> Frame:
        """Return a held-out pose, prepared once."""
        if view not in self.frames:
            camera: Cameras = course.held_out.cameras[view]
            self.frames[view] = Frame(self.stage, camera)
        return self.frames[view]

    def whole(self, course: Course, view: int) -> F32:
        """Return the image of a held-out pose with all of the highest level."""
        frame = self.frame(course, view)
        return frame.image(frame.highest, np.ones(self.stage.size[1], bool))

    def play(self, course: Course, link: Link) -> StreamShown:
        """Return what a client shows that walks over the course."""
        playback = play(self.deliver(), link, course.path, self.stage.size, seconds=course.seconds + _AFTER, tick=_TICK)
        return StreamShown(self, course, playback)


class StreamShown:
    """One session of a delivery.

    Args:
        streamed: What is delivered.
        course: Where the viewer walks.
        playback: When what arrives.
    """

    def __init__(self, streamed: Streamed, course: Course, playback: Playback) -> None:
        self._streamed = streamed
        self._course = course
        self._playback = playback
        self._last: dict[int, tuple[bytes, F32]] = {}

    def image(self, view: int, t: float) -> F32 | None:
        """Return what is shown; see `arena.stages.Shown`."""
        p = self._playback
        now = np.float32(t)
        if now < p.first:
            return None
        frame = self._streamed.frame(self._course, view)
        here = p.gaussian_at[frame.ids]
        if p.exact and now >= here[frame.highest].max(initial=-np.inf):
            return frame.reference
        shown = (here <= now) & (p.gone_at[frame.ids] > now)
        terms = p.term_at <= now
        key = hashlib.blake2b(np.packbits(shown).tobytes() + np.packbits(terms).tobytes(), digest_size=16).digest()
        last = self._last.get(view)
        if last is None or last[0] != key:
            last = self._last[view] = key, frame.image(shown, terms)
        return last[1]

    def bytes_at(self, t: float) -> float:
        """Return the bytes that have arrived; see `arena.stages.Shown`."""
        return float(self._playback.bytes_at(t))
