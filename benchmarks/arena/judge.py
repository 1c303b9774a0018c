"""Judge a session by the held-out photographs: what is shown of each when the walk passes it, and how soon.

The truth is the photograph, for all systems; no render takes part. A step is a held-out photograph. Its PSNR counts at
the moment when the walk passes it, its latency is the time from then until its pose is shown well enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arena.course import RATE, Course
from arena.stages import Playable, Shown
from gsvis.abr import QoeConfig, quality_of_experience
from gsvis.render import psnr

__all__ = ["LEVELS_DB", "Session", "final_psnr", "judge"]

F64 = NDArray[np.float64]

LEVELS_DB = (20.0, 25.0)
"""PSNR against photographs whose first moment is reported."""

_TICK = 0.1
_HAIR = 1e-6


@dataclass(frozen=True, eq=False)
class Session:
    """One session of one system.

    Attributes:
        psnr: (H,) dB of each held-out photograph when the walk passes it, 0 while nothing is shown: f(t).
        latency: By dB of a shown pose, (H,) seconds from each moment until the pose was shown, at most the time-out.
        first: By dB, seconds until the photograph that was passed last is shown as well as that; inf for never.
        nbytes: Bytes that arrived during the walk.
    """

    psnr: F64
    latency: dict[float, F64]
    first: dict[float, float]
    nbytes: float

    def qoe(self, shown_db: float) -> float:
        """Return the QoE of equation 8.

        Args:
            shown_db: PSNR at which a pose counts as shown, one of `LEVELS_DB`.
        """
        return quality_of_experience(self.psnr, self.latency[shown_db], QoeConfig(shown_db=shown_db)).score

    def figures(self) -> dict[str, Any]:
        """Return the figures of the session, ready for JSON."""
        found: dict[str, Any] = {"psnr": float(self.psnr.mean()), "megabytes": self.nbytes / 1e6}
        for least in LEVELS_DB:
            found[f"qoe_{least:g}"] = self.qoe(least)
            found[f"first_{least:g}"] = self.first[least] if np.isfinite(self.first[least]) else None
        return {**found, "curve": np.round(self.psnr, 3).tolist()}


class Judge:
    """Compares what a system shows in a session with the held-out photographs."""

    def __init__(self, course: Course, shown: Shown) -> None:
        self._course = course
        self._shown = shown

    def psnr(self, view: int, t: float) -> float:
        """Return the PSNR of a held-out pose with what has arrived by t, dB; 0 for nothing."""
        image = self._shown.image(view, t + _HAIR)
        return 0.0 if image is None else float(psnr(image, self._course.held_out.image(view)))

    def latency(self, view: int, t: float, least: float) -> float:
        """Return the seconds from t until a pose is shown with `least` dB, in ticks, at most the time-out.

        Found by bisection, because more data rarely shows less.
        """
        last = round(QoeConfig().latency_scale / _TICK)
        if self.psnr(view, t) >= least:
            return 0.0
        if self.psnr(view, t + last * _TICK) < least:
            return last * _TICK
        low, high = 0, last
        while high - low > 1:
            middle = (low + high) // 2
            enough = self.psnr(view, t + middle * _TICK) >= least
            low, high = (low, middle) if enough else (middle, high)
        return high * _TICK

    def first(self, least: float) -> float:
        """Return the seconds until the photograph that was passed last is shown with `least` dB; inf for never."""
        passed = self._course.passed
        for t in np.arange(round(self._course.seconds * RATE)) / RATE:
            view = int(np.searchsorted(passed, t + _HAIR, side="right")) - 1
            if self.psnr(view, float(t)) >= least:
                return float(t)
        return float("inf")


def judge(course: Course, shown: Shown) -> Session:
    """Return the session of a system over the course."""
    judge = Judge(course, shown)
    passed = [(view, float(t)) for view, t in enumerate(course.passed)]
    return Session(
        np.array([judge.psnr(view, t) for view, t in passed]),
        {least: np.array([judge.latency(view, t, least) for view, t in passed]) for least in LEVELS_DB},
        {least: judge.first(least) for least in LEVELS_DB},
        shown.bytes_at(course.seconds),
    )


def final_psnr(course: Course, system: Playable) -> float:
    """Return the mean PSNR of the held-out photographs with all of a system, dB."""
    found = [
        float(psnr(system.whole(course, view), course.held_out.image(view))) for view in range(len(course.held_out))
    ]
    return float(np.mean(found))
