"""Find start poses for viewers of a static scene: in its cells, in its navigable space, or outside of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.prepare.start_views import describe_start_views, shows_object
from gsvis.pvs.cells import CellGrid
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.place import Place, find_place
from gsvis.scene.poses import describe_poses
from gsvis.scene.source import Source

__all__ = ["Mode", "Start", "Visit", "find_starts", "plan_visit", "rich_poses", "start_poses"]

F64 = NDArray[np.float64]
Mode = Literal["orbit", "fly"]

# cells that are tried, and directions in each
_CELLS = 12
_TURNS = 4
_DRAWN = 12  # views that those to begin with are chosen from
_SEEN = 0.25  # least summed weight, pixels, of a Gaussian that counts


@dataclass(frozen=True)
class Start:
    """A start pose.

    Attributes:
        position: (3,) scene frame.
        rotation: (4,) wxyz, world from camera, OpenCV axes.
        mode: Kind of movement from there: "orbit" around a thing, "fly" within a place; None if unknown.
        reach: Distance ahead of what is looked at, the pivot of orbits, scene units; None if unknown.
    """

    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    mode: Mode | None = None
    reach: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return all known values, ready for JSON."""
        found: dict[str, Any] = {"position": list(self.position), "rotation": list(self.rotation)}
        known = {"mode": self.mode, "reach": None if self.reach is None else float(f"{self.reach:.6g}")}
        return found | {name: value for name, value in known.items() if value is not None}

    @classmethod
    def from_dict(cls, view: dict[str, Any], mode: Mode | None = None) -> Start:
        """Return a view of a package; see `Manifest.views`."""
        x, y, z = view["position"]
        a, b, c, d = view["rotation"]
        return cls((x, y, z), (a, b, c, d), mode, view.get("reach"))

    @classmethod
    def looking(cls, eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> Start:
        """Return the pose of an eye that looks at a target; the image stands upright."""
        at, ahead, above = (np.asarray(each, np.float64) for each in (eye, target, up))
        (view,) = describe_poses(Cameras.look_at([at], [ahead], up=above))
        return replace(cls.from_dict(view), reach=float(np.linalg.norm(ahead - at)))


def start_poses(bounds: F64, grid: CellGrid | None, up: ArrayLike) -> tuple[Start, ...]:
    """Return start poses.

    Args:
        bounds: (2, 3) corners of a box around the middle of the scene.
        grid: Its cells; the eye is in their middle and looks along the longest way. None puts the eye outside.
        up: (3,) unit axis that points upwards.
    """
    above = np.asarray(up, np.float64) / np.linalg.norm(up)
    if grid is None:
        middle = bounds.mean(axis=0)
        size = float(np.linalg.norm(bounds[1] - bounds[0]))
        if size == 0.0:  # a single point
            size = 1e-3 * float(np.linalg.norm(middle)) or 1e-3
        first = _perpendicular_axis(above)
        corner = (first - np.cross(above, first)) / np.sqrt(2.0)
        return (Start.looking(middle + (0.9 * corner + 0.3 * above) * size, middle, above),)
    centers = grid.centers
    eye = centers[np.linalg.norm(centers - centers.mean(axis=0), axis=1).argmin()]
    away = centers - eye
    away = away - np.outer(away @ above, above)
    far = away[np.linalg.norm(away, axis=1).argmax()]
    if not np.linalg.norm(far) > 1e-9 * grid.cell_size:
        far = _perpendicular_axis(above)
    return (Start.looking(eye, eye + far, above), Start.looking(eye, eye - far, above))


def rich_poses(g: Gaussians, grid: CellGrid, up: ArrayLike, count: int = 3) -> tuple[Start, ...]:
    """Return level views from centers of cells that show most Gaussians, the best first; none looks at a near wall.

    Args:
        g: The scene.
        grid: Its cells; some of them, evenly spaced in their order, are tried.
        up: (3,) unit axis that points upwards.
        count: Largest number of views, each from a different cell.
    """
    above = np.asarray(up, np.float64) / np.linalg.norm(up)
    ahead = _perpendicular_axis(above)
    aside = np.cross(above, ahead)
    best = []
    for cell in np.unique(np.linspace(0, len(grid) - 1, _CELLS).round().astype(int)).tolist():
        eye = grid.centers[cell]
        turns = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
        targets = [eye + np.cos(turn) * ahead + np.sin(turn) * aside for turn in turns]
        cameras = Cameras.look_at([eye] * _TURNS, targets, up=above, width=96, height=72, fov=80.0)
        worth = (view_weights(g, cameras).summed >= _SEEN).sum(axis=1)
        best.append((-int(worth.max()), cell, Start.looking(eye, targets[int(worth.argmax())], above)))
    return tuple(start for _, _, start in sorted(best, key=lambda each: each[:2])[:count])


@dataclass(frozen=True, eq=False)
class Visit:
    """How a visit of a scene begins.

    Attributes:
        starts: Upright views that show much of the scene, the best first; None if no eye finds room.
        up: (3,) unit up axis.
        remarks: Remarks for the user, such as what is uncertain.
        space: Where eyes may be; None if no eye finds room.
    """

    starts: tuple[Start, ...] | None
    up: NDArray[np.float64]
    remarks: list[str]
    space: NavigableSpace | None = None


def plan_visit(source: Source, place: Place | None = None, up: ArrayLike | None = None) -> Visit:
    """Return how a visit of a scene begins that is not prepared.

    Where the place is uncertain, a remark says so, and views are drawn from where either reading has eyes.

    Args:
        source: The scene, which is thinned.
        place: Where eyes may be; found by default.
        up: (3,) up axis of a scene in which no eye finds room; the known or likely one by default.
    """
    some = source.thin()
    place = place or find_place(some)
    axis = some.up if up is None else np.asarray(up, np.float64)
    starts = None if place.space is None else _starts_in(some, place.space)
    return Visit(starts, axis if place.upright is None else place.upright.up, place.remarks, place.space)


def find_starts(source: Source, up: ArrayLike) -> tuple[Start, ...] | None:
    """Return upright views that show much of a scene, the best first; None if no eye finds room.

    They are found among a part of the Gaussians: about two seconds for any scene, and not the views that `gsvis
    prepare` would choose.

    Args:
        source: The scene.
        up: (3,) unit axis that points upwards.
    """
    some = source.thin()
    space, _ = some.navigable(up=up)
    return None if space is None else _starts_in(some, space)


def _starts_in(some: Source, space: NavigableSpace) -> tuple[Start, ...] | None:
    """Return upright views of a thin scene from a navigable space, the best first; None if no eye finds room."""
    mode: Mode = "orbit" if shows_object(some.gaussians, space) else "fly"
    found = describe_start_views(some.gaussians, space, drawn=_DRAWN)
    return tuple(Start.from_dict(view, mode) for view in found) or None


def _perpendicular_axis(above: F64) -> F64:
    """Return a unit axis perpendicular to an axis, one of the scene's own axes if possible."""
    side = np.eye(3)[int(np.abs(above).argmin())]
    side -= above * (side @ above)
    return np.asarray(side / np.linalg.norm(side), np.float64)
