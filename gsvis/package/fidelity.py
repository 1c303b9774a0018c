"""The final quality at a client against the source scene, in held-out views.

PSNR in dB over images clipped to [0, 1], 100 for equal images. This module holds the figures; `gsvis.package.compare`
measures them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsvis.errors import FormatError
from gsvis.files.fields import Fields
from gsvis.scene.cameras import Cameras
from gsvis.scene.poses import cameras_from_poses, describe_poses

__all__ = ["STEPS", "Fidelity", "Spread"]

STEPS = ("levels", "terms", "rounding", "cells")
"""Steps from the source scene to a client: the highest level instead of the scene, terms instead of SH, records instead
of exact values, and only what the cell of an eye needs instead of all records."""

_MOST_POSES = 10_000


@dataclass(frozen=True)
class Spread:
    """PSNR over views.

    Attributes:
        psnr: Mean, dB.
        worst: Least PSNR of a view, dB.
    """

    psnr: float
    worst: float

    @classmethod
    def from_values(cls, values: Sequence[float]) -> Spread:
        """Return the spread of one PSNR for each of C > 0 views."""
        return cls(float(np.mean(values)), float(np.min(values)))

    @classmethod
    def from_fields(cls, fields: Fields) -> Spread:
        """Return the figures from the JSON of a manifest.

        Raises:
            FormatError: If a number is missing or not finite.
        """
        return cls(fields.number("psnr"), fields.number("worst"))

    def as_dict(self) -> dict[str, float]:
        """Return the figures, ready for JSON."""
        return {"psnr": self.psnr, "worst": self.worst}


@dataclass(frozen=True)
class Fidelity:
    """PSNR at a client against the source scene, and the loss of each step.

    Attributes:
        records: All records of the highest level, which a client holds at the end, against the source scene.
        cell: The visible set and active terms of the cell of each eye, which a client holds before the link is idle,
            against the source scene. None for a package without visible sets.
        steps: By name in `STEPS`, images after a step against images before it; only steps that were measured.
        width: Width of the views, pixels.
        height: Height of the views, pixels.
        fov: Horizontal field of view, degrees.
        poses: Poses of the views, as `describe_poses` returns them.
    """

    records: Spread
    cell: Spread | None
    steps: Mapping[str, Spread]
    width: int
    height: int
    fov: float
    poses: tuple[dict[str, Any], ...] = field(repr=False)

    @property
    def cameras(self) -> Cameras:
        """The views."""
        return cameras_from_poses(self.poses, self.width, self.height, self.fov)

    @classmethod
    def from_values(cls, values: Mapping[str, Sequence[float]], cameras: Cameras) -> Fidelity:
        """Return the figures from PSNRs over views.

        Args:
            values: PSNRs of the C views under "records", and if known under "cell" and the names of `STEPS`.
            cameras: C > 0 views with one field of view.
        """
        found = {name: Spread.from_values(each) for name, each in values.items()}
        fov = 2.0 * np.degrees(np.arctan(0.5 * cameras.width / cameras.Ks[0, 0, 0]))
        return cls(
            records=found["records"],
            cell=found.get("cell"),
            steps={name: found[name] for name in STEPS if name in found},
            width=cameras.width,
            height=cameras.height,
            fov=round(float(fov), 6),
            poses=tuple(describe_poses(cameras, decimals=None)),
        )

    @classmethod
    def from_fields(cls, fields: Fields) -> Fidelity:
        """Return the figures from the JSON of a manifest.

        Raises:
            FormatError: If a value is missing or out of its range.
        """
        steps = fields.child("steps")
        poses = fields.items("poses")
        if not 1 <= len(poses) <= _MOST_POSES:
            raise FormatError(fields.path, fields.where("poses"), f"1 to {_MOST_POSES:,} poses", f"{len(poses):,}")
        rows = [Fields(fields.path, f"{fields.where('poses')}[{k}]", row) for k, row in enumerate(poses)]
        fov = fields.number("fov")
        if not 1.0 <= fov <= 179.0:
            raise FormatError(fields.path, fields.where("fov"), "degrees in [1, 179]", f"{fov:g}")
        return cls(
            records=Spread.from_fields(fields.child("records")),
            cell=Spread.from_fields(fields.child("cell")) if "cell" in fields else None,
            steps={name: Spread.from_fields(steps.child(name)) for name in STEPS if name in steps},
            width=fields.integer("width", 1, 1 << 14),
            height=fields.integer("height", 1, 1 << 14),
            fov=fov,
            poses=tuple(_parse_pose(row) for row in rows),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        return {**self.summary(), "poses": [dict(pose) for pose in self.poses]}

    def summary(self) -> dict[str, Any]:
        """Return the figures without the poses, ready for JSON."""
        return {
            "records": self.records.as_dict(),
            "cell": None if self.cell is None else self.cell.as_dict(),
            "steps": {name: spread.as_dict() for name, spread in self.steps.items()},
            "views": len(self.poses),
            "width": self.width,
            "height": self.height,
            "fov": self.fov,
        }


def _parse_pose(row: Fields) -> dict[str, Any]:
    """Return the position (3,) and rotation (4,) of a pose as lists; raise FormatError if they are invalid."""
    position = row.numbers("position", 3)
    rotation = row.numbers("rotation", 4)
    if not 0.99 < float(np.linalg.norm(rotation)) < 1.01:
        raise FormatError(row.path, row.where("rotation"), "a unit quaternion", f"{rotation.tolist()}")
    return {"position": position.tolist(), "rotation": rotation.tolist()}
