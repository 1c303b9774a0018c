"""Define similarity transforms: one scale, one rotation, one translation.

A transform maps points of one frame to another: `x -> scale * R(quat) x + translation`. It keeps angles and ratios of
lengths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene.gaussians import quats_from_rotations, rotations_from_quats

__all__ = ["Similarity", "upright_matrix"]

F64 = NDArray[np.float64]


def _identity_quaternion() -> F64:
    """Return the quaternion of no rotation."""
    return np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False, repr=False)
class Similarity:
    """Map points x of one frame to `scale * R(quat) x + translation` in another.

    Args:
        scale: New units per old unit, > 0.
        quat: (4,) wxyz rotation, new frame from old frame; normalized.
        translation: (3,) in the new frame and its units.

    Raises:
        ValueError: If the scale is not a finite number > 0, or the quaternion is zero.

    Examples:
        >>> Similarity(2.0, translation=(0, 0, 1)).apply([[1, 2, 3]]).tolist()
        [[2.0, 4.0, 7.0]]
    """

    scale: float = 1.0
    quat: F64 = field(default_factory=_identity_quaternion)
    translation: F64 = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale: expected a finite number > 0, got {self.scale!r}")
        quat = _check.floats("quat", self.quat, (4,), np.float64)
        norm = float(np.linalg.norm(quat))
        if not 1e-150 < norm < 1e150:
            raise ValueError(f"quat: expected a rotation, got a quaternion of length {norm:g}")
        arrays = {"quat": quat / norm, "translation": _check.floats("translation", self.translation, (3,), np.float64)}
        for name, array in arrays.items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)
        object.__setattr__(self, "scale", float(self.scale))

    @classmethod
    def from_rotation(cls, scale: float, rotation: ArrayLike, translation: ArrayLike) -> Similarity:
        """Return the similarity with a rotation given as a (3, 3) matrix."""
        matrix = _check.floats("rotation", rotation, (3, 3), np.float64)
        shift = _check.floats("translation", translation, (3,), np.float64)
        return cls(scale, quats_from_rotations(matrix[None])[0], shift)

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Similarity:
        """Return the similarity of a mapping from `as_dict`."""
        return cls(float(value["scale"]), np.array(value["quat"]), np.array(value["translation"]))

    def __repr__(self) -> str:
        quat, shift = (" ".join(f"{v:.4g}" for v in array) for array in (self.quat, self.translation))
        return f"Similarity(scale {self.scale:.4g}, quat {quat}, translation {shift})"

    @property
    def rotation(self) -> F64:
        """(3, 3) rotation matrix."""
        return np.asarray(rotations_from_quats(self.quat[None])[0])

    def apply(self, points: ArrayLike) -> F64:
        """Return (M, 3) points in the new frame, from (M, 3) points in the old one."""
        array = _check.floats("points", points, ("M", 3), np.float64)
        return np.asarray(self.scale * array @ self.rotation.T + self.translation)

    def rotate(self, quats: ArrayLike) -> F64:
        """Return (M, 4) orientations wxyz, new frame from body, from those of the old frame."""
        array = _check.floats("quats", quats, ("M", 4), np.float64)
        return quats_from_rotations(self.rotation @ rotations_from_quats(array))

    def inverse(self) -> Similarity:
        """Return the inverse transform."""
        back = self.quat * np.array([1.0, -1.0, -1.0, -1.0])
        return Similarity(1.0 / self.scale, back, -(self.rotation.T @ self.translation) / self.scale)

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, ready for JSON."""
        return {"scale": self.scale, "quat": self.quat.tolist(), "translation": self.translation.tolist()}


def upright_matrix(up: F64, meters_per_unit: float = 1.0) -> F64:
    """Return the (4, 4) matrix that rotates an up axis (3,) to +y by the shortest way, then scales."""
    a = np.asarray(up, np.float64) / np.linalg.norm(up)
    b = np.array([0.0, 1.0, 0.0])
    turn = np.diag([1.0, -1.0, -1.0])  # half a turn about x, if the axis is -y
    if a @ b > -1.0 + 1e-12:
        v = np.cross(a, b)
        cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
        turn = np.eye(3) + cross + cross @ cross / (1.0 + a @ b)
    matrix = np.eye(4)
    matrix[:3, :3] = meters_per_unit * turn
    return matrix
