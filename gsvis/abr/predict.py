"""Where the head will be: predictors of position and orientation from the poses so far, for what is sent ahead.

Positions in any frame and unit, quaternions wxyz, world from camera; seconds. All share one protocol: `observe` poses
as time goes on, `predict` one for a time. Angular velocities are in the axes of the head.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = ["PREDICTORS", "KalmanPose", "LastPose", "LinearPose", "Pose", "PosePredictor", "predictor"]

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pose:
    """A position (3,) and an orientation (4,), a unit quaternion wxyz, world from camera."""

    position: F64
    quat: F64

    @classmethod
    def of(cls, position: ArrayLike, quat: ArrayLike) -> Pose:
        """A checked pose; the quaternion may have any length but 0.

        Raises:
            ValueError: If a shape is wrong, a value is not finite, or the quaternion is 0.
        """
        place = _check.floats("position", position, (3,), np.float64)
        turn = _check.floats("quat", quat, (4,), np.float64)
        most = np.abs(turn).max()
        if not most > 0:
            raise ValueError("quat: expected a rotation, got a zero quaternion")
        turn = turn / most
        return cls(place, turn / np.linalg.norm(turn))


class PosePredictor(Protocol):
    """What a predictor can do."""

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike, /) -> None:
        """Take in the pose at time t, seconds; times must rise, one that does not is passed over."""
        ...

    def predict(self, t: float, /) -> Pose:
        """The pose at time t."""
        ...


class LastPose:
    """The head stays where it is."""

    def __init__(self) -> None:
        self._time, self._pose = -np.inf, Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Take in a pose; see `PosePredictor`."""
        pose = Pose.of(position, quat)
        if _time(t) > self._time:
            self._time, self._pose = t, pose

    def predict(self, t: float) -> Pose:
        """The pose at time t."""
        return self._pose


class LinearPose:
    """The head goes on as it went over the last moments.

    Args:
        window: Seconds over which velocity and angular velocity are taken.
        longest: Seconds ahead for which they are believed; beyond it the head stands still.
    """

    def __init__(self, window: float = 0.1, longest: float = 1.0) -> None:
        if not (window > 0 and longest >= 0):
            raise ValueError(f"window, longest: expected seconds > 0 and >= 0, got {window!r}, {longest!r}")
        self._window, self._longest = window, longest
        self._seen: list[tuple[float, Pose]] = []

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Take in a pose; see `PosePredictor`."""
        pose = Pose.of(position, quat)
        if self._seen and _time(t) <= self._seen[-1][0]:
            return
        self._seen.append((t, pose))
        while len(self._seen) > 2 and self._seen[1][0] <= t - self._window:
            self._seen.pop(0)

    def predict(self, t: float) -> Pose:
        """The pose at time t."""
        if not self._seen:
            return LastPose().predict(t)
        now, pose = self._seen[-1]
        then, before = self._seen[0]
        if now <= then:
            return pose
        ahead = float(np.clip(t - now, 0.0, self._longest)) / (now - then)
        turn = rotation_vector(product(conjugate(before.quat), pose.quat))
        position = pose.position + ahead * (pose.position - before.position)
        return Pose(position, product(pose.quat, exponential(ahead * turn)))


class KalmanPose:
    """Two Kalman filters with constant velocity: of the position, and of the rotation by its error state.

    The error of the orientation is a rotation vector in the head's axes, its velocity the angular velocity; a measured
    orientation is compared with the predicted one, and the orientation itself takes in the error. Axes are independent
    and alike, so each filter has one covariance of 2 x 2.

    Args:
        acceleration: Density of the random acceleration of the head, units a second^2 for each root of hertz.
        noise: Standard deviation of measured positions, units.
        turning: Density of the random angular acceleration, radians a second^2 for each root of hertz.
        turn_noise: Standard deviation of measured orientations, radians.
        longest: Seconds ahead for which velocities are believed.
    """

    def __init__(
        self,
        acceleration: float = 3.0,
        noise: float = 2e-3,
        turning: float = 15.0,
        turn_noise: float = 5e-3,
        longest: float = 1.0,
    ) -> None:
        for name, value in (
            ("acceleration", acceleration), ("noise", noise), ("turning", turning), ("turn_noise", turn_noise),
        ):  # fmt: skip
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {value!r}")
        self._place, self._turn = _Filter(acceleration**2, noise**2), _Filter(turning**2, turn_noise**2)
        self._longest = longest
        self._time, self._pose = -np.inf, LastPose().predict(0.0)

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Take in a pose; see `PosePredictor`."""
        pose = Pose.of(position, quat)
        if _time(t) <= self._time:
            return
        if self._time == -np.inf:
            self._time, self._pose = t, pose
            return
        step = t - self._time
        there = self._ahead(step)
        gain = self._place.update(step, pose.position - there.position)
        turned = self._turn.update(step, rotation_vector(product(conjugate(there.quat), pose.quat)))
        self._pose = Pose(there.position + gain, product(there.quat, exponential(turned)))
        self._time = t

    def predict(self, t: float) -> Pose:
        """The pose at time t."""
        if self._time == -np.inf:
            return self._pose
        return self._ahead(float(np.clip(t - self._time, 0.0, self._longest)))

    def _ahead(self, step: float) -> Pose:
        turn = exponential(step * self._turn.velocity)
        return Pose(self._pose.position + step * self._place.velocity, product(self._pose.quat, turn))


class _Filter:
    """Velocity of three alike axes, and the covariance of value and velocity of each."""

    def __init__(self, density: float, noise: float) -> None:
        self.density, self.noise = density, noise
        self.velocity = np.zeros(3)
        self.covariance = np.array([[noise, 0.0], [0.0, 1e3]])  # nothing is known of the velocity

    def update(self, step: float, innovation: F64) -> F64:
        """What is to be added to the predicted values; the velocity is changed here."""
        f = np.array([[1.0, step], [0.0, 1.0]])
        q = self.density * np.array([[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]])
        p = f @ self.covariance @ f.T + q
        gain = p[:, 0] / (p[0, 0] + self.noise)
        self.velocity = self.velocity + gain[1] * innovation
        p = p - np.outer(gain, p[0])
        self.covariance = 0.5 * (p + p.T)
        return np.asarray(gain[0] * innovation)


PREDICTORS = ("last", "linear", "kalman")


def predictor(name: str) -> PosePredictor:
    """A predictor by name, one of `PREDICTORS`."""
    _check.one_of("name", name, PREDICTORS)
    return LastPose() if name == "last" else LinearPose() if name == "linear" else KalmanPose()


def product(a: F64, b: F64) -> F64:
    """Product of two unit quaternions wxyz, at unit length."""
    out = np.array(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )
    return np.asarray(out / np.sqrt(out @ out))


def conjugate(quat: F64) -> F64:
    """The inverse of a unit quaternion."""
    return np.asarray(quat * np.array([1.0, -1.0, -1.0, -1.0]))


def exponential(vector: F64) -> F64:
    """The unit quaternion of a rotation vector (3,), radians."""
    half = 0.5 * float(np.sqrt(vector @ vector))
    scale = 0.5 * float(np.sinc(half / np.pi))
    return np.array([np.cos(half), *(scale * vector)])


def rotation_vector(quat: F64) -> F64:
    """The rotation vector (3,) of a unit quaternion, of at most pi radians."""
    quat = quat if quat[0] >= 0 else -quat
    sine = float(np.sqrt(quat[1:] @ quat[1:]))
    if sine < 1e-12:
        return np.asarray(2.0 * quat[1:])
    return np.asarray(2.0 * np.arctan2(sine, quat[0]) / sine * quat[1:])


def _time(t: float) -> float:
    if not np.isfinite(t):
        raise ValueError(f"t: expected finite seconds, got {t!r}")
    return float(t)
