"""Store what is known of a scene besides its Gaussians: its origin, its up axis, its units, how it was filtered.

Readers fill the facts from what a file states, writers put them into the next file, commands read them before they
guess. This module knows no file format and guesses nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["SceneFacts"]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]

_ORIGIN: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """State what a file or a user says of a scene. Facts that are not stated keep their defaults.

    Args:
        origin: Where the scene's (0, 0, 0) lies in the coordinates of its source, source units, in double precision.
            A center in the source is `origin + mean`.
        up: Unit up axis in the scene's frame; None if nothing states it.
        up_source: What states the up axis, such as "comment Vertical Axis"; empty if nothing does.
        antialiased: Whether the scene was trained with the opacity compensation of antialiased splatting.
        meters_per_unit: Meters in a scene unit; None if nothing states it.
        box: Lowest and highest corner of the box where eyes may be, scene frame; None if nothing states it.
    """

    origin: Triple = _ORIGIN
    up: Triple | None = None
    up_source: str = ""
    antialiased: bool = False
    meters_per_unit: float | None = None
    box: tuple[Triple, Triple] | None = None

    @classmethod
    def merge(cls, parts: Sequence[SceneFacts]) -> SceneFacts:
        """Return what all parts of a scene agree on, relative to the origin of the first.

        A fact that the parts state differently, or that only some of them state, keeps its default.

        Args:
            parts: At least one; their origins may differ.
        """
        first = parts[0]
        rest = [part.shift(first.origin) for part in parts[1:]]
        if all(part == first for part in rest):
            return first
        up = all(part.up == first.up for part in rest)
        return cls(
            origin=first.origin,
            up=first.up if up else None,
            up_source=first.up_source if up else "",
            antialiased=all(part.antialiased for part in (first, *rest)),
            meters_per_unit=first.meters_per_unit
            if all(p.meters_per_unit == first.meters_per_unit for p in rest)
            else None,
            box=first.box if all(part.box == first.box for part in rest) else None,
        )

    def to_source(self, points: ArrayLike) -> F64:
        """Return (..., 3) points of the scene's frame in the coordinates of its source, float64."""
        return np.asarray(np.asarray(points, np.float64) + np.asarray(self.origin))

    def to_scene(self, points: ArrayLike) -> F64:
        """Return (..., 3) points in the coordinates of the source in the scene's frame, float64."""
        return np.asarray(np.asarray(points, np.float64) - np.asarray(self.origin))

    def shift(self, origin: ArrayLike) -> SceneFacts:
        """Return the facts of the same scene whose centers are given relative to another origin.

        Args:
            origin: (3,) the other origin, in the coordinates of the source.
        """
        wanted = _triple(np.asarray(origin, np.float64))
        if wanted == self.origin:
            return self
        away = self.to_source((0.0, 0.0, 0.0)) - np.asarray(wanted)
        box = None if self.box is None else (_triple(self.box[0] + away), _triple(self.box[1] + away))
        return replace(self, origin=wanted, box=box)

    def transform(self, rotation: ArrayLike, scale: float, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SceneFacts:
        """Return the facts after the scene is turned and scaled about its own (0, 0, 0), then moved.

        The origin is turned and scaled too, so that `origin + mean` moves as one. The translation moves the centers
        and not the origin. A box is kept where its sides stay along the axes.

        Args:
            rotation: (3, 3) rotation, new frame from old frame.
            scale: New units per old unit, > 0.
            translation: (3,) in new units.
        """
        turn = np.asarray(rotation, np.float64)
        meters = self.meters_per_unit
        return replace(
            self,
            origin=_triple(scale * (turn @ np.asarray(self.origin))),
            up=None if self.up is None else _triple(turn @ np.asarray(self.up)),
            meters_per_unit=None if meters is None else meters / scale,
            box=_placed_box(self.box, turn, scale, np.asarray(translation, np.float64)),
        )


def _placed_box(box: tuple[Triple, Triple] | None, turn: F64, scale: float, shift: F64) -> tuple[Triple, Triple] | None:
    """Return a box after a similarity; None if its sides no longer lie along the axes."""
    if box is None or not np.allclose(np.abs(turn), np.rint(np.abs(turn)), atol=1e-9):
        return None
    corners = scale * (np.array(list(product(*zip(*box, strict=True)))) @ np.rint(turn).T) + shift
    return _triple(corners.min(axis=0)), _triple(corners.max(axis=0))


def _triple(values: F64) -> Triple:
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z
