"""Classify Gaussians as FoV, Peripheral or Adjacent (section 6.3) for a pose and the cells around it.

A Gaussian visible from the cell of the eye is FoV if its bounding sphere touches the frustum, widened by a margin, and
Peripheral if not. It is Adjacent if only a neighboring cell sees it. Scene frame and units; cameras in OpenCV axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr._kernels import units as kernels
from gsvis.abr._kernels.frusta import frusta_of
from gsvis.abr.index import SceneIndex
from gsvis.abr.predict import Pose
from gsvis.abr.rings import RINGS
from gsvis.pvs.codec import ids_in

__all__ = ["ADJACENT", "FOV", "NONE", "PERIPHERAL", "Classes", "FieldOfView", "classify"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

FOV = 0
PERIPHERAL = 1
ADJACENT = 2
NONE = 255

_WIDEST = np.radians(89.0)
_NEAREST = 1.0 / 16.0  # most of the side of a cell at which a frustum begins


@dataclass(frozen=True)
class FieldOfView:
    """A client's field of view: tangents of the angles between the camera axis and the borders of the image.

    Attributes:
        left: Tangent of the angle to the left border, > 0 if the axis is inside the image.
        right: Tangent of the angle to the right border.
        top: Tangent of the angle to the upper border.
        bottom: Tangent of the angle to the lower border.
        margin: Radians by which each border is moved outward, to cover head motion until records arrive.
        near: Distance in front of the eye at which the frustum begins, scene units.
    """

    left: float
    right: float
    top: float
    bottom: float
    margin: float = 0.0
    near: float = 0.01

    def __post_init__(self) -> None:
        for name in ("left", "right", "top", "bottom", "margin", "near"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name}: expected a finite number, got {getattr(self, name)!r}")
        if self.left + self.right <= 0 or self.top + self.bottom <= 0:
            got = f"{self.left!r}, {self.right!r}, {self.top!r}, {self.bottom!r}"
            raise ValueError(f"left, right, top, bottom: expected left + right > 0 and top + bottom > 0, got {got}")
        if self.margin < 0 or self.near < 0:
            raise ValueError(f"margin, near: expected numbers of at least 0, got {self.margin!r}, {self.near!r}")

    @classmethod
    def from_degrees(
        cls, horizontal: float, vertical: float, *, margin: float = 0.0, near: float = 0.01
    ) -> FieldOfView:
        """Return a field of view around the axis; all angles in degrees."""
        for name, angle in (("horizontal", horizontal), ("vertical", vertical)):
            if not 0.0 < angle < 180.0:
                raise ValueError(f"{name}: expected degrees in (0, 180), got {angle!r}")
        x = np.tan(np.radians(horizontal) / 2)
        y = np.tan(np.radians(vertical) / 2)
        return cls(float(x), float(x), float(y), float(y), float(np.radians(margin)), near)

    def in_cells(self, cell_size: float) -> FieldOfView:
        """Return the field of view with its near plane at most 1/16 of a cell away.

        Viewers use one near distance for all scenes. In a scene with small units it would hide all that is near.
        """
        return replace(self, near=min(self.near, _NEAREST * cell_size))

    def frusta(self, poses: Sequence[Pose]) -> F32:
        """Return (F, 5, 4) float32, the planes of F poses; see `planes`."""
        quats = np.array([pose.quat for pose in poses]).reshape(-1, 4)
        eyes = np.array([pose.position for pose in poses]).reshape(-1, 3)
        out = np.empty((len(poses), 5, 4), np.float32)
        frusta_of(self._normals, quats, eyes, self.near, out)
        return out

    def planes(self, position: ArrayLike, quat: ArrayLike) -> F32:
        """Return the left, right, top, bottom and near plane, (5, 4) float32: a unit normal pointing inward, an offset.

        Args:
            position: (3,) eye, scene frame.
            quat: (4,) wxyz, world from camera, any length but 0.
        """
        return np.asarray(self.frusta([Pose.from_arrays(position, quat)])[0])

    @cached_property
    def _normals(self) -> F64:
        """(5, 3) unit normals of the planes, in the frame of the camera."""
        angles = np.arctan([self.left, self.right, self.top, self.bottom]) + self.margin
        sines = np.sin(np.minimum(angles, _WIDEST))
        cosines = np.cos(np.minimum(angles, _WIDEST))
        local = np.zeros((5, 3))
        local[[0, 1], 0], local[[2, 3], 1] = [cosines[0], -cosines[1]], [cosines[2], -cosines[3]]
        local[:4, 2] = sines
        local[4, 2] = 1.0
        return local


@dataclass(frozen=True, eq=False)
class Classes:
    """Classes of N Gaussians.

    Attributes:
        classes: (N,) uint8: FOV, PERIPHERAL, ADJACENT, or NONE if neither the cell nor a neighbor sees the Gaussian.
        distances: (N,) float32, scene units, between centers of cells: from the cell of the eye to the nearest one that
            sees the Gaussian; 0 for FoV and Peripheral, inf for NONE.
    """

    classes: U8
    distances: F32

    @property
    def counts(self) -> dict[str, int]:
        """Number of Gaussians of each class."""
        names = {"fov": FOV, "peripheral": PERIPHERAL, "adjacent": ADJACENT, "none": NONE}
        return {name: int(np.count_nonzero(self.classes == code)) for name, code in names.items()}


def classify(index: SceneIndex, cell: int, planes: ArrayLike) -> Classes:
    """Return the class of every Gaussian.

    Args:
        index: The scene.
        cell: The cell of the eye.
        planes: (F, 5, 4) frusta, or (5, 4) for one. A Gaussian in any of them is in view.

    References:
        SRBF-Gaussian, section 6.3.
    """
    frusta = np.asarray(planes, np.float32)
    frusta = _check.floats("planes", frusta[None] if frusta.ndim == 2 else frusta, ("F", 5, 4))
    classes = np.full(len(index), NONE, np.uint8)
    distances = np.full(len(index), np.inf, np.float32)
    rings = index.grid.rings(cell)
    for ring in range(RINGS - 1, 0, -1):
        for other in rings[ring]:
            ids = ids_in(*index.sets.visible_masks(other))
            classes[ids], distances[ids] = ADJACENT, index.grid.cell_size * np.sqrt(ring)
    ids = ids_in(*index.sets.visible_masks(cell))
    inside = np.zeros(len(ids), np.bool_)
    kernels.in_view(frusta, index.means[ids], index.radii[ids], inside)
    classes[ids] = np.where(inside, FOV, PERIPHERAL)
    distances[ids] = 0.0
    return Classes(classes, distances)
