"""Predict where the head will be, from its poses so far, to send records ahead.

Positions in any frame and unit, quaternions wxyz, world from camera; seconds. All predictors share one protocol:
`observe` each pose, `predict` the pose at a time. Angular velocities are in the axes of the head.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = ["PREDICTORS", "KalmanPose", "LastPose", "LinearPose", "Pose", "PosePredictor", "predictor"]

F64 = NDArray[np.float64]
Vector = tuple[float, float, float]
Quat = tuple[float, float, float, float]

_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Pose:
    """A position (3,) and an orientation (4,), a unit quaternion wxyz, world from camera."""

    position: F64
    quat: F64

    @classmethod
    def from_arrays(cls, position: ArrayLike, quat: ArrayLike) -> Pose:
        """Return a checked pose; the quaternion may have any length but 0.

        Raises:
            ValueError: If a shape is wrong, a value is not finite, or the quaternion is 0.
        """
        place = finite_vector("position", position, 3)
        turn = finite_vector("quat", quat, 4)
        return cls(place, np.array(_normalized(turn.tolist())))

    def distance_to(self, other: Pose) -> float:
        """Return the distance between the positions."""
        return math.dist(self.position.tolist(), other.position.tolist())

    def turn_to(self, other: Pose) -> float:
        """Return the angle between the orientations, in [0, pi] radians."""
        a = self.quat.tolist()
        b = other.quat.tolist()
        chord = min(math.dist(a, b), math.dist(a, [-value for value in b]))
        return 4.0 * math.asin(min(1.0, 0.5 * chord))


class PosePredictor(Protocol):
    """Interface of a predictor."""

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike, /) -> None:
        """Record the pose at time t, in seconds; ignore a pose that is not later than the last."""
        ...

    def predict(self, t: float, /) -> Pose:
        """Return the pose at time t."""
        ...


class LastPose:
    """Predict that the head stays where it is."""

    def __init__(self) -> None:
        self._time = -np.inf
        self._pose = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Record a pose; see `PosePredictor.observe`."""
        pose = Pose.from_arrays(position, quat)
        if _finite_time(t) > self._time:
            self._time = t
            self._pose = pose

    def predict(self, t: float) -> Pose:
        """Return the pose at time t."""
        return self._pose


class LinearPose:
    """Predict that the head keeps the mean velocity and angular velocity of the last moments.

    Args:
        window: Seconds over which velocities are averaged.
        longest: Most seconds ahead to extrapolate; after that the head stands still.
    """

    def __init__(self, window: float = 0.1, longest: float = 1.0) -> None:
        if not (window > 0 and longest >= 0):
            raise ValueError(f"window, longest: expected seconds > 0 and >= 0, got {window!r}, {longest!r}")
        self._window = window
        self._longest = longest
        self._seen: list[tuple[float, Pose]] = []

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Record a pose; see `PosePredictor.observe`."""
        pose = Pose.from_arrays(position, quat)
        if self._seen and _finite_time(t) <= self._seen[-1][0]:
            return
        self._seen.append((t, pose))
        while len(self._seen) > 2 and self._seen[1][0] <= t - self._window:
            self._seen.pop(0)

    def predict(self, t: float) -> Pose:
        """Return the pose at time t."""
        if not self._seen:
            return LastPose().predict(t)
        now, pose = self._seen[-1]
        then, before = self._seen[0]
        if now <= then:
            return pose
        ahead = min(max(t - now, 0.0), self._longest) / (now - then)
        turn = rotation_vector(product(conjugate(before.quat), pose.quat))
        position = pose.position + ahead * (pose.position - before.position)
        return Pose(position, product(pose.quat, exponential(ahead * turn)))


class KalmanPose:
    """Predict with two Kalman filters of constant velocity: one for the position, one for the orientation.

    The second filters the error of the predicted orientation, a rotation vector in the head's axes; its velocity is the
    angular velocity. The three axes are independent and equal, so each filter has one 2 x 2 covariance.

    Args:
        acceleration: Density of the random acceleration of the head, units a second^2 for each root of hertz.
        noise: Standard deviation of measured positions, units.
        turning: Density of the random angular acceleration, radians a second^2 for each root of hertz.
        turn_noise: Standard deviation of measured orientations, radians.
        longest: Most seconds ahead to extrapolate; after that the head stands still.
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
            ("acceleration", acceleration),
            ("noise", noise),
            ("turning", turning),
            ("turn_noise", turn_noise),
        ):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {value!r}")
        self._place = _Filter(acceleration**2, noise**2)
        self._turn = _Filter(turning**2, turn_noise**2)
        self._longest = longest
        self._time = -math.inf
        self._at = (0.0, 0.0, 0.0)
        self._quat = (1.0, 0.0, 0.0, 0.0)

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Record a pose; see `PosePredictor.observe`."""
        x, y, z = finite_vector("position", position, 3).tolist()
        measured = _normalized(finite_vector("quat", quat, 4).tolist())
        if _finite_time(t) <= self._time:
            return
        if self._time == -math.inf:
            self._time = t
            self._at = (x, y, z)
            self._quat = measured
            return
        step = t - self._time
        (a, b, c), predicted = self._extrapolate(step)
        da, db, dc = self._place.update(step, (x - a, y - b, z - c))
        w, i, j, k = predicted
        error = _rotation_vector(*_product((w, -i, -j, -k), measured))
        self._at = (a + da, b + db, c + dc)
        self._quat = _product(predicted, _exponential(*self._turn.update(step, error)))
        self._time = t

    def predict(self, t: float) -> Pose:
        """Return the pose at time t."""
        place = self._at
        quat = self._quat
        if self._time > -math.inf:
            place, quat = self._extrapolate(min(max(t - self._time, 0.0), self._longest))
        return Pose(np.array(place), np.array(quat))

    def _extrapolate(self, step: float) -> tuple[Vector, Quat]:
        """Return the position and the orientation `step` seconds after the last pose."""
        x, y, z = self._at
        u, v, w = self._place.velocity
        p, q, r = self._turn.velocity
        turn = _exponential(step * p, step * q, step * r)
        return (x + step * u, y + step * v, z + step * w), _product(self._quat, turn)


class _Filter:
    """A Kalman filter of constant velocity for three independent, equal axes.

    Args:
        density: Spectral density of the squared random acceleration.
        noise: Variance of measured values.
    """

    def __init__(self, density: float, noise: float) -> None:
        self.density = density
        self.noise = noise
        self.velocity: Vector = (0.0, 0.0, 0.0)
        self.covariance = noise, 0.0, 1e3  # of value, of both, of velocity, which is unknown at first

    def update(self, step: float, innovation: Vector) -> Vector:
        """Update the velocity with a measurement, and return the correction of the predicted values.

        Args:
            step: Seconds since the last measurement.
            innovation: Measured minus predicted value of each axis.
        """
        value, both, speed = self.covariance
        value += step * (2.0 * both + step * speed) + self.density * step**3 / 3.0
        both += step * speed + self.density * step**2 / 2.0
        speed += self.density * step
        gain = value / (value + self.noise)
        push = both / (value + self.noise)
        (u, v, w), (x, y, z) = self.velocity, innovation
        self.velocity = u + push * x, v + push * y, w + push * z
        self.covariance = value - gain * value, both - gain * both, speed - push * both
        return gain * x, gain * y, gain * z


PREDICTORS = ("last", "linear", "kalman")


def predictor(name: str) -> PosePredictor:
    """Return a predictor by name, one of `PREDICTORS`."""
    _check.one_of("name", name, PREDICTORS)
    return LastPose() if name == "last" else LinearPose() if name == "linear" else KalmanPose()


def product(a: F64, b: F64) -> F64:
    """Return the product of two unit quaternions wxyz, normalized."""
    return np.array(_product(a.tolist(), b.tolist()))


def conjugate(quat: F64) -> F64:
    """Return the inverse of a unit quaternion."""
    return np.asarray(quat * _CONJUGATE)


def exponential(vector: F64) -> F64:
    """Return the unit quaternion of a rotation vector (3,), radians."""
    return np.array(_exponential(*vector.tolist()))


def rotation_vector(quat: F64) -> F64:
    """Return the rotation vector (3,) of a unit quaternion, of at most pi radians."""
    return np.array(_rotation_vector(*quat.tolist()))


def _product(a: Sequence[float], b: Sequence[float]) -> Quat:
    """Return the product of two unit quaternions wxyz, normalized."""
    p, q, r, s = a
    w, x, y, z = b
    return _unit(
        p * w - q * x - r * y - s * z,
        p * x + q * w + r * z - s * y,
        p * y - q * z + r * w + s * x,
        p * z + q * y - r * x + s * w,
    )


def _exponential(x: float, y: float, z: float) -> Quat:
    """Return the unit quaternion wxyz of a rotation vector, radians."""
    angle = math.hypot(x, y, z)
    scale = math.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    return math.cos(0.5 * angle), scale * x, scale * y, scale * z


def _rotation_vector(w: float, x: float, y: float, z: float) -> Vector:
    """Return the rotation vector of a unit quaternion wxyz, of at most pi radians."""
    sine = math.hypot(x, y, z)
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, abs(w)) / sine
    scale = scale if w >= 0 else -scale
    return scale * x, scale * y, scale * z


def _normalized(quat: Sequence[float]) -> Quat:
    """Return a quaternion wxyz at length 1; values are scaled first, so that no square overflows."""
    most = max(map(abs, quat))
    if not most > 0:
        raise ValueError("quat: expected a rotation, got a zero quaternion")
    w, x, y, z = quat
    return _unit(w / most, x / most, y / most, z / most)


def _unit(w: float, x: float, y: float, z: float) -> Quat:
    """Return a quaternion wxyz scaled to length 1."""
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length


def finite_vector(name: str, value: ArrayLike, length: int) -> F64:
    """Return a checked float64 vector; skip `_check.floats` if the value already fits."""
    if isinstance(value, tuple) and len(value) == length and all(type(one) is float for one in value):
        value = np.array(value)
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == (length,):
        given: F64 = value
        if all(map(math.isfinite, given.tolist())):
            return given
    return np.asarray(_check.floats(name, value, (length,), np.float64))


def _finite_time(t: float) -> float:
    """Return a time in seconds; raise ValueError unless it is finite."""
    if not math.isfinite(t):
        raise ValueError(f"t: expected finite seconds, got {t!r}")
    return float(t)
