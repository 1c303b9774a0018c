"""Define facts about a scene besides its Gaussians: origin, up axis, units, antialiasing, box of viewpoints.

Readers take them from a file, writers store them in the next file, and commands use them before they guess. This module
knows no file format and guesses nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["SceneFacts"]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]
Quad = tuple[float, float, float, float]

_ORIGIN: Triple = (0.0, 0.0, 0.0)
_LEVEL: Quad = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """Facts about a scene that a file or a user states. Facts that are not stated keep their defaults.

    Args:
        origin: Position of the scene's (0, 0, 0) in the coordinates of its source, in double precision. A center in the
            source is `origin + mean`.
        up: Unit up axis in the scene's frame; None if nothing states it.
        up_source: Source of the up axis, such as "comment Vertical Axis"; empty without one.
        antialiased: Whether the scene was trained with the opacity compensation of antialiased splatting.
        meters_per_unit: Meters in a scene unit; None if nothing states it.
        box: Lowest and highest corner of the box for viewpoints, in the frame of its sides, relative to the scene's
            (0, 0, 0); None if nothing states it.
        box_turn: Unit quaternion wxyz, scene frame from the frame of the box's sides; the identity by default.
        eye: A point in the scene's frame where an eye may be; parts of the box that cannot be reached from it do not
            count. None if nothing states it.
        clearance: Least distance of eyes in the box from surfaces, scene units; None if nothing states it.
    """

    origin: Triple = _ORIGIN
    up: Triple | None = None
    up_source: str = ""
    antialiased: bool = False
    meters_per_unit: float | None = None
    box: tuple[Triple, Triple] | None = None
    box_turn: Quad = _LEVEL
    eye: Triple | None = None
    clearance: float | None = None

    @classmethod
    def merge(cls, parts: Sequence[SceneFacts]) -> SceneFacts:
        """Return the facts that all parts of a scene share, relative to the origin of the first part.

        A fact that differs between parts, or that only some of them state, keeps its default.

        Args:
            parts: At least one; their origins may differ.
        """
        first = parts[0]
        rest = [part.shift(first.origin) for part in parts[1:]]
        if all(part == first for part in rest):
            return first
        up = all(part.up == first.up for part in rest)
        box = all(part.where == first.where for part in rest)
        return cls(
            origin=first.origin,
            up=first.up if up else None,
            up_source=first.up_source if up else "",
            antialiased=all(part.antialiased for part in (first, *rest)),
            meters_per_unit=first.meters_per_unit
            if all(p.meters_per_unit == first.meters_per_unit for p in rest)
            else None,
            box=first.box if box else None,
            box_turn=first.box_turn if box else _LEVEL,
            eye=first.eye if box else None,
            clearance=first.clearance if box else None,
        )

    def to_source(self, points: ArrayLike) -> F64:
        """Return (..., 3) points in the coordinates of the source, float64, from points in the scene's frame."""
        return np.asarray(np.asarray(points, np.float64) + np.asarray(self.origin))

    def to_scene(self, points: ArrayLike) -> F64:
        """Return (..., 3) points in the scene's frame, float64, from points in the coordinates of the source."""
        return np.asarray(np.asarray(points, np.float64) - np.asarray(self.origin))

    def shift(self, origin: ArrayLike) -> SceneFacts:
        """Return the facts of the same scene with centers relative to a new origin.

        Args:
            origin: (3,) the new origin, in the coordinates of the source.
        """
        wanted = _triple(np.asarray(origin, np.float64))
        if wanted == self.origin:
            return self
        away = self.to_source((0.0, 0.0, 0.0)) - np.asarray(wanted)
        box, box_turn = _place_box(self.box, self.box_axes, 1.0, away)
        eye = None if self.eye is None else _triple(self.eye + away)
        return replace(self, origin=wanted, box=box, box_turn=box_turn, eye=eye)

    def transform(self, rotation: ArrayLike, scale: float, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SceneFacts:
        """Return the facts after the scene is rotated and scaled about its own (0, 0, 0), then moved.

        Origin and box are rotated and scaled too, so that `origin + mean` is transformed as a whole. The translation
        moves the centers, not the origin.

        Args:
            rotation: (3, 3) rotation, new frame from old frame.
            scale: New units per old unit, > 0.
            translation: (3,) in new units.
        """
        turn = np.asarray(rotation, np.float64)
        shift = np.asarray(translation, np.float64)
        meters = self.meters_per_unit
        box, box_turn = _place_box(self.box, turn @ self.box_axes, scale, shift)
        return replace(
            self,
            origin=_triple(scale * (turn @ np.asarray(self.origin))),
            up=None if self.up is None else _triple(turn @ np.asarray(self.up)),
            meters_per_unit=None if meters is None else meters / scale,
            box=box,
            box_turn=box_turn,
            eye=None if self.eye is None else _triple(scale * (turn @ np.asarray(self.eye)) + shift),
            clearance=None if self.clearance is None else scale * self.clearance,
        )

    @property
    def where(self) -> tuple[Any, ...]:
        """All facts about where eyes may be."""
        return self.box, self.box_turn, self.eye, self.clearance

    @property
    def box_axes(self) -> F64:
        """(3, 3) rotation, scene frame from the frame of the box's sides."""
        return _rotation(self.box_turn)


def _place_box(box: tuple[Triple, Triple] | None, axes: F64, scale: float, shift: F64) -> tuple[Any, Quad]:
    """Return a box after a similarity, and its rotation; the identity if its sides lie along the axes of the scene.

    Args:
        box: Lowest and highest corner along its sides; None without one.
        axes: (3, 3) new scene frame from the frame of its sides.
        scale: New units per old unit.
        shift: (3,) in new units.
    """
    if box is None:
        return None, _LEVEL
    if not np.allclose(np.abs(axes), np.rint(np.abs(axes)), atol=1e-9):
        moved = axes.T @ shift
        return tuple(_triple(scale * np.asarray(corner) + moved) for corner in box), _quaternion(axes)
    corners = scale * (np.array(list(product(*zip(*box, strict=True)))) @ np.rint(axes).T) + shift
    return (_triple(corners.min(axis=0)), _triple(corners.max(axis=0))), _LEVEL


def _rotation(quat: Quad) -> F64:
    """Return the (3, 3) rotation of a unit quaternion wxyz."""
    w, x, y, z = quat
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows)


def _quaternion(rotation: F64) -> Quad:
    """Return the unit quaternion wxyz of a (3, 3) rotation."""
    from scipy.spatial.transform import Rotation  # slow to import, seldom needed

    x, y, z, w = (float(value) for value in Rotation.from_matrix(rotation).as_quat())
    return w, x, y, z


def _triple(values: F64) -> Triple:
    """Return three numbers as a tuple."""
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z
