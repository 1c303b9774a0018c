"""The arguments of commands that edit a scene; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from gsvis.cli.arguments_where import Where, WhereSeen
from gsvis.cli.readers import (
    BYTES,
    COUNTED,
    DECIBELS,
    DEGREES,
    FACE_PIXELS,
    NAMES,
    PLAIN,
    SHARE,
    STRENGTH,
    TAU,
    WHOLE,
    Flag,
    Lod,
    Scene,
    hint,
)

__all__ = ["Clean", "Cut", "Paint"]


@dataclass(frozen=True)
class Clean(Where):
    """Remove what no eye sees, fog, floaters and flyaways; without -o only report."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="(default: only report)")] = None
    """File to write, .ply, .spz, .sog or .ksplat."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    report: Annotated[str | None, arg(metavar="DIR", help_behavior_hint="(default: no report)")] = None
    """Folder for report.html (all in one file), report.json and pictures of what goes, by class; made if missing."""
    select: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """Write the class of each Gaussian: 0 stays, 1 flyaways, 2 interior, 3 unseen, 4 fog, 5 floaters."""
    apply: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: look for what can go)")] = None
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
    most_changed: Annotated[float, SHARE] = 0.1
    """Share of their pixels that fog or floaters that go may mostly make; else the class is given back."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of eyes and views: the same seed gives the same result."""
    max_memory: Annotated[int | None, BYTES, hint("no bound")] = None
    """Memory limit, such as 2GB. A scene that needs more is cleaned in tiles, to a .ply; a killed run resumes."""
    overwrite: Flag = False
    """Replace OUT and the file of --select if they exist."""
    json: Flag = False
    """Print one JSON document instead of a table."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Cut(Where):
    """Keep only what eyes along a path, of cameras or in a box can see."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """The scene to write, .ply, .spz, .sog or .ksplat. An existing file needs --overwrite."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no cameras)")] = None
    """Keep what these cameras show: a COLMAP model, transforms.json, cameras.json, or report.json of gsvis analyze.
    With --margin eyes may lie so far beside them."""
    fov: Annotated[float | None, DEGREES, hint("eyes look all around")] = None
    """With --path: keep only what the frames of the walk show, at this horizontal field of view."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers."""
    tau: Annotated[float, TAU, hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian is kept."""
    limit: Annotated[float, SHARE, hint("0.0015")] = 0.0015
    """Rays go on until they prove that at most this share of the light is missing."""
    size: Annotated[int | None, FACE_PIXELS, hint("512")] = None
    """Pixels along a side of the six faces around an eye."""
    views: Annotated[int, WHOLE] = 16
    """Views in one round that are drawn before and after; 0 for none."""
    min_psnr: Annotated[float, DECIBELS, hint("45")] = 45.0
    """A drawn view below this gets what it lacks, and others are drawn."""
    select: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Write what is kept as a NumPy file too: one true or false for each Gaussian of SCENE."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same file."""
    overwrite: Flag = False
    """Replace files that exist."""
    json: Flag = False
    """Print one JSON document instead of lines."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Paint(WhereSeen):
    """Color a scene by how its Gaussians are seen, for any viewer."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """The scene to write, .ply, .spz, .sog or .ksplat. Its legend goes beside it: scene.legend.png. Existing files need
    --overwrite."""
    by: Annotated[Literal["visibility", "directions", "weight", "importance", "cell"], PLAIN] = "visibility"
    """visibility: share of the eyes that see it; directions: of 80, from how many; weight: largest share of a pixel;
    importance: change of views without it; cell: the cell that sees it best. (default: visibility)"""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    pvs: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: eyes are drawn)")] = None
    """Take the quantity from visible sets of this scene (gsvis pvs); not for importance."""
    eyes: Annotated[int | None, COUNTED, hint("64; for importance 96")] = None
    """Number of eyes that are drawn: places, cells or views."""
    size: Annotated[int | None, FACE_PIXELS, hint("512")] = None
    """Pixels along a side of the six faces around an eye."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers; not with --pvs."""
    values: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Write the quantity as a NumPy file too: one number for each Gaussian."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same file."""
    overwrite: Flag = False
    """Replace files that exist."""
    json: Flag = False
    """Print one JSON document instead of lines."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""
