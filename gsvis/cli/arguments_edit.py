"""The arguments of commands that edit a scene; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from gsvis.cli.arguments_where import SHOW, Where, WhereSeen
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
    """Report to write: a folder for report.html (all in one file), report.json and pictures of what goes, by class."""
    select: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """Write the class of each Gaussian: 0 stays, 1 flyaways, 2 interior, 3 unseen, 4 fog, 5 floaters."""
    apply: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: look for what can go)")] = None
    """Remove what an earlier --select, perhaps edited since, says; nothing is looked for."""
    classes: Annotated[tuple[str, ...] | None, NAMES, hint("all")] = None
    """Classes that go: flyaways, interior, unseen, fog, floaters."""
    strength: Annotated[float, STRENGTH] = 1.0
    """How readily fog and floaters are found, above 0 to 2."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Cameras of the capture, in the frame of SCENE: a COLMAP model, transforms.json or cameras.json. They are eyes,
    too."""
    eyes: Annotated[int, COUNTED] = 40
    """Number of eyes in navigable space that look all around."""
    held_out: Annotated[int, WHOLE] = 8
    """Number of further views to measure on: the guard draws them before and after; 0 for none."""
    min_psnr: Annotated[float, DECIBELS] = 45.0
    """Least PSNR of such a view when flyaways, interior and unseen go; else a class is given back."""
    max_changed: Annotated[float, SHARE] = 0.1
    """Largest share of the pixels of these views that fog or floaters may have made; else the class is given back."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers."""
    show: Annotated[str | None, SHOW] = None
    """Write a picture of where people stand: the first view, and a plan with eyes."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same file."""
    max_memory: Annotated[int | None, BYTES, hint("no bound")] = None
    """Memory limit, such as 2GB. A scene that needs more is cleaned in tiles, to a .ply; a killed run resumes."""
    overwrite: Flag = False
    """Replace files that exist."""
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
    """Cameras whose views are kept: a COLMAP model, transforms.json, cameras.json, or report.json of gsvis analyze.
    With --margin eyes may lie so far beside them."""
    fov: Annotated[float | None, DEGREES, hint("eyes look all around")] = None
    """Horizontal field of view of the frames of --path: only what they show is kept."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers."""
    tau: Annotated[float, TAU, hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian counts as visible."""
    limit: Annotated[float, SHARE, hint("0.0015")] = 0.0015
    """The set that is kept is finished when rays prove that it misses at most this share of the light."""
    face_size: Annotated[int | None, FACE_PIXELS, hint("512")] = None
    """Pixels along a side of the six faces around an eye."""
    held_out: Annotated[int, WHOLE] = 16
    """Number of further views to measure on in one round; 0 for none."""
    min_psnr: Annotated[float, DECIBELS, hint("45")] = 45.0
    """Least PSNR of such a view; one below it gets what it lacks, and others are drawn."""
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
    """Visible sets of SCENE (gsvis pvs), to take the quantity from; not for importance."""
    eyes: Annotated[int | None, COUNTED, hint("64; for importance 96")] = None
    """Number of eyes that look all around; for importance, of views."""
    face_size: Annotated[int | None, FACE_PIXELS, hint("512")] = None
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
