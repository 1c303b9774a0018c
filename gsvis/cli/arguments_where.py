"""Arguments by which a user says where eyes may be, shared by every command that samples eyes; see `arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from gsvis.cli.readers import AROUND, BOX, DISTANCE, KIND, PLAIN, Flag, hint

__all__ = ["SHOW", "Framed", "Where", "WhereSeen"]

SHOW = arg(metavar="FILE", help_behavior_hint="(default: none)")


@dataclass(frozen=True, kw_only=True)
class Framed:
    """The frame of --cameras; every command that takes cameras has it."""

    cameras_frame: Annotated[Literal["auto", "scene", "capture"], PLAIN] = "auto"
    """Frame of --cameras. scene: that of SCENE, as they are; capture: that of the photographs, moved by nerfstudio's
    dataparser_transforms.json; auto: moved where more of them see the scene then. (default: auto)"""


@dataclass(frozen=True, kw_only=True)
class Where(Framed):
    """Where eyes may be; by default where the kind of the scene puts them."""

    box: Annotated[tuple[float, ...] | None, BOX, hint("the navigable space of the scene")] = None
    """Restrict viewpoints to this box, in the frame of SCENE."""
    around: Annotated[tuple[float, ...] | None, AROUND, hint("where the scene is an object")] = None
    """Put viewpoints around an object, auto for the whole scene, or its center and radius, in the frame of SCENE."""
    path: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no path)")] = None
    """Walk that viewpoints are restricted to, in the frame of SCENE: a CSV of poses (t,x,y,z,qw,qx,qy,qz) or an
    EyeNavGS recording."""
    margin: Annotated[float | None, DISTANCE, hint("3 voxels of the navigable space")] = None
    """Distance of viewpoints from --path, at most, in scene units."""
    retarget: Flag = False
    """Move --path into the scene by a similarity transform, if it was recorded in another frame."""
    kind: Annotated[str | None, KIND, hint("auto, and a question on a terminal where that is unsure")] = None
    """What the scene is, which says where people stand: object, rooms, open-place; or auto, which asks nothing."""


@dataclass(frozen=True, kw_only=True)
class WhereSeen(Where):
    """Where eyes may be, by the cameras that took the photos of the scene too."""

    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no cameras)")] = None
    """Cameras of the capture, in the frame of SCENE: a COLMAP model, transforms.json or cameras.json. They say where
    people stand and which way is up."""
