"""Rotate a scene upright to find its space where +z is up, and transfer voxels back to the scene's frame.

An axis within a degree of x, y or z is kept. Rotations are about the middle of the scene, so that far coordinates
lose no precision. This module does not decide where eyes belong.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians

__all__ = ["Pose", "TurnedParts", "bring_back", "is_level", "is_square", "level_frame", "on_lattice", "turn"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEVEL = float(np.cos(np.radians(1.0)))  # of the angle to an axis up to which it is that axis
_YAWS = 90  # degrees in which the narrowest plan is looked for
_PLAN = 0.02  # of the centers left out at each end of a side of the plan
_SAMPLE = 5_000  # centers that are asked
_SQUARE = 0.8  # area of the best box in that of the one along the axes from which it is as good
_MOST = 1.5  # times as many voxels along a side as before the turn


@dataclass(frozen=True, eq=False)
class Pose:
    """The rotation of a scene to its upright frame: `rotation @ (x - middle)`.

    Attributes:
        rotation: (3, 3) upright frame from scene frame; its last row is the up axis.
        middle: (3,) point that stays in place, scene frame.
    """

    rotation: F64
    middle: F64

    def points(self, points: F64) -> F64:
        """Return the points (P, 3) in the upright frame."""
        return np.asarray((points - self.middle) @ self.rotation.T)

    def gaussians(self, g: Gaussians) -> Gaussians:
        """Return a scene in the upright frame, with base colors only."""
        plain = Gaussians(g.means.astype(np.float64) - self.middle, g.quats, g.scales, g.opacities, g.sh0)
        return plain.transform(self.rotation)

    def back(self, points: F64) -> F64:
        """Return points (P, 3) of the upright frame in the frame of the scene."""
        return np.asarray(points @ self.rotation + self.middle)


@dataclass(frozen=True, eq=False)
class TurnedParts:
    """A scene in parts that are rotated whenever they are read.

    Attributes:
        parts: The scene, part by part.
        pose: The rotation.
    """

    parts: Iterable[Gaussians]
    pose: Pose

    def __iter__(self) -> Iterator[Gaussians]:
        """Yield the rotated parts."""
        for part in self.parts:
            yield self.pose.gaussians(part)


def is_level(up: F64) -> bool:
    """Return whether an up axis (3,) lies within a degree of x, y or z."""
    return bool(np.abs(up).max() >= _LEVEL)


def turn(up: F64, seen: Gaussians, middle: F64) -> Pose:
    """Return the rotation in which `up` is +z and the floor plan of a scene fills its box best.

    Args:
        up: (3,) unit up axis.
        seen: The Gaussians, without outliers.
        middle: (3,) point that stays in place.
    """
    frame, areas = _plan_areas(up, seen, middle)
    return Pose(_yaw(int(np.argmin(areas))) @ frame, middle)


def is_square(up: F64, seen: Gaussians, middle: F64) -> bool:
    """Return whether the floor plan of a scene fills a box along x, y and z about as well as a rotated box.

    False for rooms whose walls lie along no axis. True for captures without walls, in any direction.

    Args:
        up: (3,) unit up axis, x, y or z to a degree.
        seen: The Gaussians that count.
        middle: (3,) a middle of the scene.
    """
    _, areas = _plan_areas(up, seen, middle)
    return areas[0] * _SQUARE <= min(areas)


def _plan_areas(up: F64, seen: Gaussians, middle: F64) -> tuple[F64, list[float]]:
    """Return a level frame (3, 3), and the areas of the boxes around the floor plan, rotated by whole degrees."""
    frame = level_frame(up)
    plan = (seen.means.astype(np.float64) - middle) @ frame[:2].T
    ordered = np.argsort(plan[:, 0], kind="stable")  # so that the order of the Gaussians does not count
    plan = plan[ordered[np.linspace(0, len(plan) - 1, min(len(plan), _SAMPLE)).astype(np.int64)]]
    areas = list[float]()
    for degrees in range(_YAWS):
        sides = np.diff(np.quantile(plan @ _yaw(degrees)[:2, :2].T, [_PLAN, 1.0 - _PLAN], axis=0), axis=0)[0]
        areas.append(float(sides.prod()))
    return frame, areas


def level_frame(up: F64) -> F64:
    """Return a (3, 3) rotation whose last row is the unit vector `up`."""
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def bring_back(origin: F64, voxel_size: float, masks: list[Mask], pose: Pose) -> tuple[F64, float, list[Mask]]:
    """Return masks of an upright grid on a grid along the axes of the scene, sampled at the middles of voxels.

    Args:
        origin: (3,) lowest corner of the upright grid, upright frame.
        voxel_size: Side of its voxels.
        masks: Each (X, Y, Z).
        pose: The rotation of the scene.

    Returns:
        The lowest corner in the scene's frame, the side of the voxels, and the masks.
    """
    shape = np.array(masks[0].shape)
    ends = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = pose.back(origin + voxel_size * shape * ends)
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    size = max(voxel_size, float((high - low).max()) / (_MOST * float(shape.max())))
    counts = np.ceil((high - low) / size).astype(int)
    start = 0.5 * (low + high) - 0.5 * size * counts
    first = (pose.points((start + 0.5 * size)[None])[0] - origin) / voxel_size - 0.5
    turned = [on_lattice(mask, pose.rotation * (size / voxel_size), first, counts) for mask in masks]
    return start, size, turned


def on_lattice(
    grid: NDArray[Any], step: F64, first: F64, counts: NDArray[np.int64], *, beyond: float = 0.0
) -> NDArray[Any]:
    """Return (X, Y, Z) values of a grid at the points `step @ index + first`, in units of its voxels.

    Args:
        grid: Values of any type, on voxels whose middles lie at integers.
        step: (3, 3) matrix from an index to its offset.
        first: (3,) point of index (0, 0, 0).
        counts: (3,) number of points along each axis.
        beyond: Value outside of the grid.
    """
    from scipy import ndimage  # here: it takes long to import, and few need it

    values = grid.view(np.uint8) if grid.dtype == bool else grid
    shape = tuple(int(n) for n in counts)
    found = ndimage.affine_transform(values, step, first, shape, values.dtype, order=0, cval=beyond)
    return np.asarray(found.view(bool) if grid.dtype == bool else found)


def _yaw(degrees: float) -> F64:
    """Return the rotation about z by an angle."""
    turned = np.radians(degrees)
    return np.array([[np.cos(turned), np.sin(turned), 0.0], [-np.sin(turned), np.cos(turned), 0.0], [0.0, 0.0, 1.0]])
