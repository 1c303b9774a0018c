"""The arguments of commands that edit a scene; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from gsvis.cli.arguments_where import Where
from gsvis.cli.readers import COUNTED, DECIBELS, NAMES, SHARE, STRENGTH, WHOLE, Flag, Lod, Scene, hint

__all__ = ["Clean"]


@dataclass(frozen=True)
class Clean(Where):
    """Remove what no eye sees, fog, floaters and flyaways; without -o only tell."""

    scene: Scene
    """File or folder (.ply, .compressed.ply, .splat, .spz, .sog, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="(default: none; only tell)")] = (
        None
    )
    """File to write, .ply, .spz or .sog."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    report: Annotated[str | None, arg(metavar="DIR", help_behavior_hint="(default: no report)")] = None
    """Folder for report.html (all in one file), report.json and pictures of what goes, by class; made if missing."""
    select: Annotated[str | None, arg(metavar="FILE.npy", help_behavior_hint="(default: no file)")] = None
    """Write the class of each Gaussian: 0 stays, 1 flyaways, 2 interior, 3 unseen, 4 fog, 5 floaters."""
    apply: Annotated[str | None, arg(metavar="FILE.npy", help_behavior_hint="(default: look for what can go)")] = None
    """Remove what an earlier --select, perhaps edited since, says; nothing is looked for."""
    classes: Annotated[tuple[str, ...] | None, NAMES, hint("all")] = None
    """Classes that go: flyaways, interior, unseen, fog, floaters."""
    strength: Annotated[float, STRENGTH] = 1.0
    """How readily fog and floaters are found, above 0 to 2."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """COLMAP model, transforms.json or cameras.json of photographs, which are eyes too."""
    eyes: Annotated[int, COUNTED] = 40
    """Viewpoints in navigable space that look around."""
    held_out: Annotated[int, WHOLE] = 8
    """Views that the guard draws before and after; 0 for no guard."""
    least_db: Annotated[float, DECIBELS] = 45.0
    """PSNR that each of them keeps when flyaways, interior and unseen go; else a class is given back."""
    most_changed: Annotated[float, SHARE] = 0.3
    """Share of their pixels that may end elsewhere when fog or floaters go; else the class is given back."""
    up: Annotated[str | None, arg(metavar="AXIS", help_behavior_hint="(default: the likely one)")] = None
    """Axis that points upwards in the scene, such as -y."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of eyes and views: the same seed gives the same result."""
    overwrite: Flag = False
    """Replace OUT and FILE.npy if they exist."""
    json: Flag = False
    """Print one JSON document instead of a table."""
    debug: Flag = False
    """Show the traceback of an error."""
