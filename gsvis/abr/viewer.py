"""Where a client is and where it will be: its last pose, and a predictor that observes all poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.abr.predict import Pose, PosePredictor

__all__ = ["Viewer"]


class Viewer:
    """The poses of one client.

    Args:
        poses: Predictor of poses.

    Attributes:
        pose: The last pose; None before the first.
        has_moved: Whether a pose came after the last batch; the planner resets it.
    """

    def __init__(self, poses: PosePredictor) -> None:
        self.pose: Pose | None = None
        self.has_moved = False
        self._time = -np.inf
        self._poses = poses

    def observe(self, t: float, position: ArrayLike, quat: ArrayLike) -> bool:
        """Record the pose at time t, and return True; ignore a pose that is not later than the last, and return False.

        Raises:
            ValueError: If a value is not finite, or the quaternion is 0. Nothing changes then.
        """
        pose = Pose.from_arrays(position, quat)
        if not np.isfinite(t):
            raise ValueError(f"t: expected finite seconds, got {t!r}")
        if t <= self._time:
            return False
        self._poses.observe(t, pose.position, pose.quat)
        self._time = t
        self.pose = pose
        self.has_moved = True
        return True

    def predict_pose(self, pose: Pose, t: float, seconds: float) -> Pose:
        """Return the pose predicted for `seconds` after time t, or after the last pose if that is later.

        Args:
            pose: The last pose, which is returned for 0 seconds.
            t: Seconds.
            seconds: How far to predict.
        """
        return self._poses.predict(max(t, self._time) + seconds) if seconds > 0 else pose

    def position_in(self, seconds: float) -> NDArray[np.float64] | None:
        """Return the position (3,) extrapolated `seconds` after the last pose, scene frame; None before the first pose.

        The velocity is that of the predicted second after the pose: predictors look no farther.
        """
        if self.pose is None:
            return None
        step: NDArray[np.float64] = self._poses.predict(self._time + 1.0).position - self.pose.position
        return self.pose.position + seconds * step
