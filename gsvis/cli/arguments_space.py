"""The arguments of `gsvis space`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from gsvis.cli.arguments_where import WhereSeen
from gsvis.cli.readers import COUNTED, DISTANCE, PLAIN, Flag, Lod, Scene, hint

__all__ = ["Space"]


@dataclass(frozen=True)
class Space(WhereSeen):
    """Write where a visitor can be, and what stops one, for other programs."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="(required)")]
    """OUT.glb: two meshes, navigable and surface. OUT.voxel.json, with OUT.voxel.bin: solid voxels as SuperSplat and
    PlayCanvas read them, in their frame."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers."""
    resolution: Annotated[int | None, COUNTED, hint("160")] = None
    """Voxels along the longest side of the scene, 8 to 384; not with --box, --around, --path."""
    frame: Annotated[Literal["upright", "scene"], PLAIN] = "upright"
    """Frame of the meshes. upright: +y points upwards; scene: the frame of SCENE. (default: upright)"""
    meters_per_unit: Annotated[float | None, DISTANCE, hint("that of SCENE, or 1")] = None
    """Length of a scene unit in meters: upright meshes are in meters then."""
    overwrite: Flag = False
    """Replace files that exist."""
    json: Flag = False
    """Print one JSON document instead of lines."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""
