"""Define head-pose paths: position and orientation of a head over time.

Times are seconds from 0. Positions keep the frame and units of the recording. Orientations are world from camera in
OpenCV axes (+x right, +y down, +z forward), wxyz. A path replays at any time; it knows no file and no scene.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene.cameras import Cameras, intrinsics
from gsvis.scene.gaussians import rotations_from_quats
from gsvis.scene.similarity import Similarity

__all__ = ["HeadPath"]

F64 = NDArray[np.float64]

_MOST_SAMPLES = 10_000_000


@dataclass(frozen=True, eq=False, repr=False)
class HeadPath:
    """A moving head: T poses with their times.

    Args:
        times: (T,) seconds, from 0, strictly rising; T >= 1.
        positions: (T, 3) midpoint between the eyes, world frame.
        quats: (T, 4) wxyz, world from camera, OpenCV axes. Any length but 0, either sign: they are normalized, and each
            sign is chosen nearest to the previous one.
        up: (3,) direction against gravity in the same frame; None if unknown.
        meters_per_unit: Size of one unit of `positions`; None if unknown.

    Raises:
        ValueError: If a shape or a value is wrong.
    """

    times: F64
    positions: F64
    quats: F64
    up: F64 | None = None
    meters_per_unit: float | None = None

    def __post_init__(self) -> None:
        times = _check.floats("times", self.times, ("T",), np.float64)
        positions = _check.floats("positions", self.positions, ("T", 3), np.float64)
        quats = _check.floats("quats", self.quats, ("T", 4), np.float64)
        if _check.same_length(times=times, positions=positions, quats=quats) == 0:
            raise ValueError("times: expected at least one pose, got none")
        if times[0] != 0.0:
            raise ValueError(f"times: expected to start at 0, got {times[0]:g}; subtract the first time")
        _check_rising("times", times)
        arrays: dict[str, F64 | None] = {
            "times": times,
            "positions": positions,
            "quats": _align_signs(quats),
            "up": None if self.up is None else _check.unit_vectors("up", np.reshape(self.up, (1, -1)))[0],
        }
        for name, array in arrays.items():
            if array is not None:
                array = array.view()
                array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.meters_per_unit is not None:
            if not (np.isfinite(self.meters_per_unit) and self.meters_per_unit > 0):
                raise ValueError(f"meters_per_unit: expected a finite number > 0, got {self.meters_per_unit!r}")
            object.__setattr__(self, "meters_per_unit", float(self.meters_per_unit))

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        unit = "units" if self.meters_per_unit is None else "m" if self.meters_per_unit == 1.0 else "scaled units"
        return f"HeadPath({len(self)} poses over {self.duration:.3g} s, {self.length:.3g} {unit} long)"

    @property
    def duration(self) -> float:
        """Time from the first pose to the last, seconds."""
        return float(self.times[-1])

    @property
    def length(self) -> float:
        """Distance traveled, in units of the positions."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @property
    def forwards(self) -> F64:
        """(T, 3) unit view directions."""
        return np.ascontiguousarray(rotations_from_quats(self.quats)[:, :, 2])

    @property
    def head_ups(self) -> F64:
        """(T, 3) unit directions out of the top of the head."""
        return np.ascontiguousarray(-rotations_from_quats(self.quats)[:, :, 1])

    @property
    def upright(self) -> F64:
        """(3,) `up` if it is known, else the mean direction out of the top of the head."""
        if self.up is not None:
            return self.up
        mean = self.head_ups.mean(axis=0)
        if np.linalg.norm(mean) < 1e-6:  # the head rotates fully, so no direction is up
            mean = self.head_ups[0]
        return np.asarray(mean / np.linalg.norm(mean))

    def speed(self) -> F64:
        """Return (T - 1,) speeds between consecutive poses, units per second."""
        return np.asarray(np.linalg.norm(np.diff(self.positions, axis=0), axis=1) / np.diff(self.times))

    def at(self, times: ArrayLike) -> tuple[F64, F64]:
        """Interpolate position and orientation at any time: linear in position, slerp in orientation.

        Args:
            times: Seconds, one or (S,). Before the start and after the end the first and last pose are returned.

        Returns:
            positions: (S, 3), or (3,) for one time.
            quats: (S, 4) unit, or (4,).
        """
        single = np.ndim(times) == 0
        wanted = _check.floats("times", np.reshape(times, -1) if single else times, ("S",), np.float64)
        wanted = np.clip(wanted, 0.0, self.duration)
        right = np.clip(np.searchsorted(self.times, wanted, side="right"), 1, max(len(self) - 1, 1))
        left = right - 1
        right = np.minimum(right, len(self) - 1)
        span = self.times[right] - self.times[left]
        part = np.where(span > 0, (wanted - self.times[left]) / np.where(span > 0, span, 1.0), 0.0)[:, None]
        positions = (1.0 - part) * self.positions[left] + part * self.positions[right]
        quats = _slerp(self.quats[left], self.quats[right], part)
        return (positions[0], quats[0]) if single else (positions, quats)

    def resample(self, rate_hz: float | None = None, *, times: ArrayLike | None = None) -> HeadPath:
        """Return the same motion sampled at a steady rate, or at given times.

        Args:
            rate_hz: Poses per second, from time 0 to the last sample inside the path.
            times: (S,) seconds within the path, strictly rising, instead of a rate; the first becomes time 0.

        Raises:
            ValueError: If not exactly one of the two is given, or one is out of range.
        """
        if (rate_hz is None) == (times is None):
            raise ValueError("rate_hz: expected either a rate or times, got both or neither")
        if rate_hz is not None:
            if not (np.isfinite(rate_hz) and rate_hz > 0 and self.duration * rate_hz < _MOST_SAMPLES):
                most = f"and fewer than {_MOST_SAMPLES:,} poses in all"
                raise ValueError(f"rate_hz: expected a rate > 0 {most}, got {rate_hz!r} over {self.duration:g} s")
            wanted = np.arange(int(np.floor(self.duration * rate_hz + 1e-6)) + 1) / rate_hz
        else:
            wanted = _check.floats("times", times if times is not None else (), ("S",), np.float64)
            _check_rising("times", wanted)
            _check.in_range("times", wanted, 0.0, self.duration)
        positions, quats = self.at(wanted)
        return replace(self, times=wanted - wanted[:1], positions=positions, quats=quats)

    def cut(self, start: float = 0.0, stop: float = np.inf) -> HeadPath:
        """Return the part from `start` to `stop` seconds, with interpolated poses at both ends; it begins at time 0.

        Args:
            start: Seconds, inside the path.
            stop: Seconds, after `start`; clipped to the end of the path.

        Raises:
            ValueError: If no time lies between the two.
        """
        if not 0.0 <= start < min(stop, self.duration):
            raise ValueError(
                f"start: expected 0 <= start < stop and a start before the end, got {start!r} to {stop!r}"
                f" of a path of {self.duration:g} s"
            )
        stop = min(stop, self.duration)
        between = self.times[(self.times > start) & (self.times < stop)]
        return self.resample(times=np.concatenate([[start], between, [stop]]))

    def transform(self, similarity: Similarity) -> HeadPath:
        """Return the path in the target frame of a similarity transform."""
        return HeadPath(
            self.times,
            similarity.apply(self.positions),
            similarity.rotate(self.quats),
            None if self.up is None else similarity.rotation @ self.up,
            None if self.meters_per_unit is None else self.meters_per_unit / similarity.scale,
        )

    def cameras(self, width: int = 256, height: int = 192, fov: float = 90.0) -> Cameras:
        """Return one camera for each pose, in the view direction of the head, named by its time.

        Args:
            width: Pixels.
            height: Pixels.
            fov: Horizontal field of view, degrees.
        """
        rotations = np.swapaxes(rotations_from_quats(self.quats), 1, 2)  # camera from world
        viewmats = np.tile(np.eye(4), (len(self), 1, 1))
        viewmats[:, :3, :3] = rotations
        viewmats[:, :3, 3] = -np.einsum("tij,tj->ti", rotations, self.positions)
        names = tuple(f"{time:.3f} s" for time in self.times)
        return Cameras(viewmats, np.tile(intrinsics(width, height, fov), (len(self), 1, 1)), width, height, names)


def _check_rising(name: str, times: F64) -> None:
    """Raise unless times rise strictly."""
    if len(times) == 0:
        raise ValueError(f"{name}: expected at least one time, got none")
    steps = np.diff(times)
    if len(steps) and steps.min() <= 0:
        index = int(steps.argmin()) + 1
        raise ValueError(
            f"{name}: expected strictly rising times, got {times[index]:g} after {times[index - 1]:g} at index {index};"
            " sort them and drop repeats"
        )


def _align_signs(quats: F64) -> F64:
    """Return unit quaternions, each with the sign nearest to the previous one; the first has w >= 0."""
    quats = quats / np.maximum(np.abs(quats).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    norms = np.linalg.norm(quats, axis=1)
    if norms.min() <= 0:
        raise ValueError(f"quats: expected rotations, got a zero quaternion at index {int(norms.argmin())}")
    quats = quats / norms[:, None]
    flips = np.where(np.sum(quats[1:] * quats[:-1], axis=1) < 0, -1.0, 1.0)
    first = -1.0 if quats[0, 0] < 0 else 1.0
    return np.asarray(quats * np.cumprod(np.concatenate([[first], flips]))[:, None])


def _slerp(a: F64, b: F64, part: F64) -> F64:
    """Return (S, 4) unit quaternions on the shorter arc from a (S, 4) to b (S, 4), at the share `part` (S, 1)."""
    dot = np.sum(a * b, axis=1, keepdims=True)
    b = np.where(dot < 0, -b, b)
    dot = np.clip(np.abs(dot), 0.0, 1.0)
    angle = np.arctan2(np.linalg.norm(b - dot * a, axis=1, keepdims=True), dot)
    sine = np.sin(angle)
    close = sine < 1e-9
    safe = np.where(close, 1.0, sine)
    left = np.where(close, 1.0 - part, np.sin((1.0 - part) * angle) / safe)
    right = np.where(close, part, np.sin(part * angle) / safe)
    mixed = left * a + right * b
    return np.asarray(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))
