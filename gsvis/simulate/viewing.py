"""Measure the quality of a playback for a viewer: PSNR against the full scene, latency, bytes over time, QoE.

A step is a tick of the path, 100 ms. PSNR is measured at every tick in the first seconds and less often later, and
holds until the next measurement. The image shows the arrived Gaussians from the current pose; before the first Gaussian
there is no image, which counts as 0 dB. A step counts only if the full scene has content there: if a black image would
already pass for a first image (`CONTENT_DB`), PSNR is meaningless. Seconds, bytes, dB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr.classes import FieldOfView
from gsvis.abr.qoe import FIRST_FRAME_DB, Qoe, QoeConfig, first_frame, quality_of_experience, stall
from gsvis.progress import Progress, silent
from gsvis.scene.paths import HeadPath
from gsvis.simulate.frames import CONTENT_DB, Frame, Stage
from gsvis.simulate.playback import Playback

__all__ = ["CONTENT_DB", "GOOD_DB", "Viewing", "ViewingConfig", "show_at", "watch"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

GOOD_DB = 35.0
"""PSNR of a good image."""
_QOE = ("score", "quality", "delay", "psnr", "latency", "steps")
_HAIR = 1e-6  # rounding error of a tick in float32, seconds


@dataclass(frozen=True)
class ViewingConfig:
    """Options of the measurement.

    Attributes:
        seconds: Duration of the visit.
        tick: Seconds between poses.
        fine: Seconds at the start in which PSNR is measured at every tick.
        every: Seconds between measurements after that.
        width: Pixels of the compared images.
        height: Pixels of the compared images.
        fov: Horizontal field of view, degrees.
        margin: Degrees by which a server widens the view on each side.
        qoe: Constants of equation 8.
    """

    seconds: float = 30.0
    tick: float = 0.1
    fine: float = 3.0
    every: float = 0.5
    width: int = 320
    height: int = 240
    fov: float = 90.0
    margin: float = 8.0
    qoe: QoeConfig = field(default_factory=QoeConfig)

    def __post_init__(self) -> None:
        for name, most in (("seconds", 3600.0), ("tick", self.seconds), ("every", self.seconds)):
            if not 0.0 < getattr(self, name) <= most:
                raise ValueError(f"{name}: expected seconds in (0, {most:g}], got {getattr(self, name)!r}")
        if not 0.0 <= self.fine <= 3600.0:
            raise ValueError(f"fine: expected seconds in [0, 3600], got {self.fine!r}")
        if not 0.0 <= self.margin < 90.0:
            raise ValueError(f"margin: expected degrees in [0, 90), got {self.margin!r}")
        for name in ("width", "height"):
            _check.positive_int(name, getattr(self, name))
        if not 0.0 < self.fov < 180.0:
            raise ValueError(f"fov: expected degrees in (0, 180), got {self.fov!r}")

    @property
    def view(self) -> FieldOfView:
        """The client's field of view, as sent to a server."""
        x = np.tan(np.radians(self.fov) / 2.0)
        y = x * self.height / self.width
        return FieldOfView(float(x), float(x), float(y), float(y), float(np.radians(self.margin)))

    @property
    def ticks(self) -> NDArray[np.int64]:
        """(S,) ticks at which images are compared."""
        count = round(self.seconds / self.tick)
        fine = min(round(self.fine / self.tick), count)
        step = max(round(self.every / self.tick), 1)
        return np.concatenate([np.arange(fine), np.arange(fine, count, step)])

    @property
    def watched(self) -> float:
        """Seconds that a playback must cover, because a pose may become visible after the last step."""
        return self.seconds + self.qoe.latency_scale


@dataclass(frozen=True, eq=False)
class Viewing:
    """Quality of one playback for one viewer.

    Attributes:
        playback: The playback.
        config: Options of the measurement.
        times: (S,) seconds of the measured steps.
        psnr: (S,) dB of each step, at most `qoe.psnr_scale`.
        latency: (S,) seconds from the pose of each step until it was shown with `qoe.shown_db`, at most the time-out.
        needed: (N,) whether each Gaussian reached a pixel in one of the steps.
        content: (S,) whether the full scene has content at each step; only such steps count in the figures.
    """

    playback: Playback
    config: ViewingConfig
    times: F64
    psnr: F64
    latency: F64
    needed: NDArray[np.bool_]
    content: NDArray[np.bool_]

    @property
    def weights(self) -> NDArray[np.int64]:
        """(S,) number of ticks that each step represents; 0 without content."""
        ticks = np.rint(np.append(self.times, self.config.seconds) / self.config.tick).astype(np.int64)
        return np.where(self.content, np.diff(ticks), 0)

    @property
    def qoe(self) -> Qoe:
        """Equation 8, the mean over all ticks with content.

        Raises:
            ValueError: If no step has content.
        """
        psnr, latency = (np.repeat(values, self.weights) for values in (self.psnr, self.latency))
        return quality_of_experience(psnr, latency, self.config.qoe)

    @property
    def begins(self) -> float:
        """Time of the first step with content, from which a viewer waits; 0 if there is none."""
        seen = np.flatnonzero(self.content)
        return float(self.times[seen[0]]) if len(seen) else 0.0

    def time_of(self, least: float) -> float:
        """Return the time of the first step with content and at least `least` dB; inf if there is none."""
        return first_frame(self.times, self._judged, least)

    def seconds_to(self, least: float) -> float:
        """Return how long a viewer waits for an image of at least `least` dB, from when there is something to see."""
        return self.time_of(least) - self.begins

    @property
    def _judged(self) -> F64:
        """(S,) PSNR, 0 without content."""
        return np.where(self.content, self.psnr, 0.0)

    def figures(self) -> dict[str, float | int | None]:
        """Return the figures of the session; None for events that never happened, or without content."""
        p = self.playback
        end = self.config.seconds
        any_content = bool(self.content.any())
        qoe: Mapping[str, float | None] = self.qoe.as_dict() if any_content else dict.fromkeys(_QOE)
        arrived = p.gaussian_at <= end
        gone = p.gone_at <= end
        count = int(np.count_nonzero(arrived))
        chosen = arrived & ~p.filler
        return {
            **qoe,
            "seconds_to_first_image": _or_none(self.seconds_to(FIRST_FRAME_DB)),
            "seconds_to_good_image": _or_none(self.seconds_to(GOOD_DB)),
            "stall": self._stall() if any_content else None,
            "bytes": float(p.bytes_at(end)),
            "records_twice": p.twice,
            "gaussians": count,
            "gaussian_share": count / max(len(arrived), 1),
            "filling_bytes": float(p.sizes[p.filling & (p.times <= end)].sum()),
            "replaced_share": int(np.count_nonzero(arrived & gone)) / max(count, 1),
            "unseen_share": int(np.count_nonzero(chosen & ~self.needed)) / max(int(np.count_nonzero(chosen)), 1),
            "terms": int(p.terms_at(end)),
            "term_share": int(p.terms_at(end)) / max(len(p.term_at), 1),
        }

    def _stall(self) -> float:
        """Return the total seconds of stalls; time without content does not count."""
        seen = np.where(self.content, self.psnr, np.inf)
        seen[self.times < self.time_of(FIRST_FRAME_DB)] = 0.0
        return stall(self.times, seen, self.config.qoe.shown_db, self.config.seconds)

    def as_dict(self) -> dict[str, Any]:
        """Return figures and curves, ready for JSON."""
        p = self.playback
        n = len(self.playback.gaussian_at)
        terms = len(self.playback.term_at)
        curves = {
            "times": self.times,
            "psnr": self.psnr,
            "latency": self.latency,
            "qoe": self.score,
            "bytes": p.bytes_at(self.times),
            "gaussian_share": p.gaussians_at(self.times) / max(n, 1),
            "term_share": p.terms_at(self.times) / max(terms, 1),
            "content": self.content.astype(np.int64),
        }
        return {
            "system": p.name,
            "about": p.about,
            "figures": self.figures(),
            "curves": {name: np.round(values, 5).tolist() for name, values in curves.items()},
        }

    @property
    def score(self) -> F64:
        """(S,) QoE of each single step."""
        c = self.config.qoe
        delay = np.clip(self.latency / c.latency_scale, 0.0, 1.0)
        return np.asarray(np.clip(self.psnr / c.psnr_scale, 0.0, 1.0) - c.delay_weight * delay)


def watch(
    stage: Stage,
    playbacks: Sequence[Playback],
    path: HeadPath,
    config: ViewingConfig | None = None,
    *,
    progress: Progress = silent,
) -> list[Viewing]:
    """Measure playbacks of one path, step by step; each pose is prepared once for all of them.

    Latency is found by bisection between the pose and the time-out, because more data rarely shows less.

    Args:
        stage: The scene.
        playbacks: Playbacks of this scene, each at least `config.watched` seconds long.
        path: The path of the playbacks.
        config: Options; None means `ViewingConfig()`.
        progress: Called with stage "watching"; counts steps.

    Raises:
        ValueError: If a playback is too short or belongs to a different scene.
    """
    config = config or ViewingConfig()
    for p in playbacks:
        if p.seconds < config.watched - 1e-9:
            raise ValueError(f"playbacks: expected at least {config.watched:g} seconds, got {p.seconds:g}")
        if (len(p.gaussian_at), len(p.term_at)) != stage.size:
            raise ValueError(
                f"playbacks: expected {stage.size[0]:,} Gaussians and {stage.size[1]:,} terms, as the scene has, got"
                f" {len(p.gaussian_at):,} and {len(p.term_at):,} in {p.name}"
            )
    times: F64 = config.ticks.astype(np.float64) * config.tick
    positions, quats = path.at(times)
    cameras = HeadPath(times, positions, quats).cameras(config.width, config.height, config.fov)
    psnr, latency = np.zeros((2, len(playbacks), len(times)))
    needed = np.zeros(stage.size[0], bool)
    content = np.zeros(len(times), bool)
    progress("watching", 0, len(times))
    for k, t in enumerate(times.tolist()):
        frame = Frame(stage, cameras[k])
        needed[frame.ids] = True
        content[k] = frame.has_content
        for m, p in enumerate(playbacks):
            seen = _Sight(frame, p)
            psnr[m, k] = min(seen.psnr(t), config.qoe.psnr_scale)
            latency[m, k] = _latency(seen, t, config)
        progress("watching", k + 1, len(times))
    return [Viewing(p, config, times, psnr[m], latency[m], needed, content) for m, p in enumerate(playbacks)]


def show_at(
    stage: Stage, playbacks: Sequence[Playback], path: HeadPath, t: float, config: ViewingConfig
) -> tuple[F32, list[F32 | None]]:
    """Return the images visible at one time.

    Args:
        stage: The scene.
        playbacks: Playbacks of this scene.
        path: The path of the playbacks.
        t: Seconds.
        config: Size and field of view of the images.

    Returns:
        (H, W, 3) the full scene in [0, 1], and the image of each playback; None before its first Gaussian.
    """
    position, quat = path.at(t)
    camera = HeadPath(np.zeros(1), position[None], quat[None]).cameras(config.width, config.height, config.fov)[0]
    frame = Frame(stage, camera)
    return frame.reference, [_Sight(frame, p).image(t) for p in playbacks]


class _Sight:
    """Quality of one pose in one playback at any time."""

    def __init__(self, frame: Frame, playback: Playback) -> None:
        self._frame = frame
        self._playback = playback
        self._here = playback.gaussian_at[frame.ids]
        self._gone = playback.gone_at[frame.ids]
        self._first = playback.first
        self._exact_from = float(self._here[frame.highest].max(initial=-np.inf)) if playback.exact else np.inf

    def psnr(self, t: float) -> float:
        """Return the PSNR of the image at a time."""
        p = self._playback
        now = np.float32(t + _HAIR)
        if now < self._first:
            return 0.0
        if now >= self._exact_from:
            return np.inf
        return self._frame.psnr((self._here <= now) & (self._gone > now), p.term_at <= now)

    def image(self, t: float) -> F32 | None:
        """Return the image at a time; None before the first Gaussian."""
        p = self._playback
        now = np.float32(t + _HAIR)
        if now < self._first:
            return None
        if now >= self._exact_from:
            return self._frame.reference
        return self._frame.image((self._here <= now) & (self._gone > now), p.term_at <= now)


def _latency(seen: _Sight, t: float, config: ViewingConfig) -> float:
    """Return the seconds until the pose of time t is shown well enough, in ticks, at most the time-out."""
    enough = config.qoe.shown_db
    last = round(config.qoe.latency_scale / config.tick)
    if seen.psnr(t) >= enough:
        return 0.0
    if seen.psnr(t + last * config.tick) < enough:
        return config.qoe.latency_scale
    # not yet; by then
    low = 0
    high = last
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if seen.psnr(t + middle * config.tick) >= enough else (middle, high)
    return high * config.tick


def _or_none(value: float) -> float | None:
    """Return a finite value; None for infinity."""
    return value if np.isfinite(value) else None
