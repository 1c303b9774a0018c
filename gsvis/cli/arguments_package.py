"""Arguments of the commands that make, check and undo packages; see `arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli.arguments_where import SHOW, WhereSeen
from gsvis.cli.readers import (
    BYTES,
    CELLS,
    CHANGE,
    COUNTED,
    DISTANCE,
    FACE_PIXELS,
    MEAN_TERMS,
    NAMES,
    PIXELS,
    PLAIN,
    PREVIEW_SHARE,
    SH_DEGREE,
    SHARE,
    SHARES,
    SHARES_OR_NONE,
    STEPS,
    TERMS,
    WHOLE,
    Flag,
    Lod,
    Scene,
    hint,
)

__all__ = ["Prepare", "Unpack", "Verify"]

_TABLES = arg(metavar="DIR OF KEPT TABLES", help_behavior_hint="(default: in GSVIS_CACHE, or in ~/.cache/gsvis)")


@dataclass(frozen=True)
class Prepare(WhereSeen):
    """Make a package of a scene that can be served: levels, visible sets, colors."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json, levels) or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder of the package, such as scene.gsvis; scene.gsvis.work beside it keeps work for the next run."""
    lod: Lod = None
    """Level of detail of a streamed scene to start from; 0 is the finest."""
    photos: Annotated[str | None, arg(metavar="DIR", help_behavior_hint="(default: renders of the scene)")] = None
    """Photographs to train levels on, with the COLMAP model or transforms.json that SCENE was trained from."""
    levels: Annotated[tuple[float, ...], SHARES_OR_NONE, hint("0.25 0.5")] = (0.25, 0.5)
    """Size of each lower level as a share of the scene's, lowest first; none for the scene alone."""
    reuse: Annotated[tuple[float, ...] | None, SHARES, hint("0.9 0.96")] = None
    """Least share of each lower level that stands unchanged in the next."""
    names: Annotated[tuple[str, ...] | None, NAMES, hint("low medium high")] = None
    """Names of these levels, that of the scene itself last."""
    preview: Annotated[float | None, PREVIEW_SHARE, hint("0.02; 0 below 50,000 Gaussians")] = None
    """Size of the first picture, merged Gaussians below all other levels, as a share of the scene's; 0 for none."""
    steps: Annotated[int, STEPS] = 400
    """Steps of training for each lower level, one view each."""
    views: Annotated[int | None, COUNTED, hint("400")] = None
    """Number of views to train on, sampled where viewers may stand; not with --photos, which trains on 7 of 8."""
    width: Annotated[int | None, PIXELS, hint("480; with --photos theirs")] = None
    """Pixels across views to measure on; those to train on are wider and smaller. Photographs are shrunk to it."""
    height: Annotated[int | None, PIXELS, hint("360; with --photos theirs")] = None
    """Pixels down these views."""
    cells: Annotated[int | None, CELLS, hint("256, or 64 around an object whose sets hardly grow then")] = None
    """Largest number of cells. They are as small as it allows."""
    cell_size: Annotated[float | None, DISTANCE, hint("the smallest that --cells allows")] = None
    """Side of a cell, scene units."""
    face_size: Annotated[int | None, FACE_PIXELS, hint("768")] = None
    """Pixels along a side of the six faces around a viewpoint of a cell."""
    limit: Annotated[float | None, SHARE, hint("0.0015")] = None
    """The set of a cell is finished when rays prove that it misses at most this share of the light."""
    max_inner: Annotated[int | None, WHOLE, hint("16")] = None
    """Largest number of times that a set is mended and certified again."""
    variant: Annotated[Literal["rgb", "hsl"], PLAIN] = "rgb"
    """How colors are split. (default: rgb)"""
    max_terms: Annotated[int | None, TERMS, hint("24")] = None
    """Most terms of each function of a Gaussian; 0 leaves base colors alone."""
    mean_terms: Annotated[float | None, MEAN_TERMS, hint("3")] = None
    """Terms a Gaussian on average; they go where they lower errors most. all: all that help (slow)."""
    epsilon: Annotated[float | None, CHANGE, hint("0.02")] = None
    """Smallest change of a color for which a term is sent; gsvis color --epsilon auto finds it for a scene."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers."""
    meters_per_unit: Annotated[float | None, DISTANCE, hint("that of SCENE, or not known")] = None
    """Length of a scene unit in meters, kept in the package."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same package."""
    workers: Annotated[int | None, COUNTED, hint("one for each core")] = None
    """Number of processes that find visible sets. The package is the same for any number."""
    max_memory: Annotated[int | None, BYTES, hint("no bound")] = None
    """Memory limit of all processes together, such as 4GB or 2GiB."""
    show: Annotated[str | None, SHOW] = None
    """Write a picture of where people stand: the first view, and a plan with eyes; a dry run in doubt does anyway."""
    dry_run: Flag = False
    """Print time, memory and disk of each stage, and write nothing."""
    discard: Flag = False
    """Delete what is kept for the next run, scene.gsvis.work, when the package is complete."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Verify:
    """Read, check and decode every part of a package, or of all packages of a world."""

    package: Annotated[Positional[str], arg(metavar="PACKAGE", help_behavior_hint="")]
    """Folder of a package, such as scene.gsvis, or of a world, such as city.gsworld."""
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: what gsvis prepare found)")] = None
    """The scene from which it was made: measure how near what a client gets comes to it."""
    lod: Annotated[int | None, WHOLE, hint("the finest that is there")] = None
    """Level of detail of a streamed --scene; 0 is the finest."""
    tables: Annotated[str | None, _TABLES] = None
    """Folder for tables that gsvis serve keeps; those of the package are read too."""
    json: Flag = False
    """Print one JSON document instead of a table."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Unpack:
    """Write a package back as one PLY for each level."""

    package: Annotated[Positional[str], arg(metavar="PACKAGE", help_behavior_hint="")]
    """Folder of a package, such as scene.gsvis."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder for low.ply, ... and levels.arrow, the map of reuse; made if missing."""
    sh_degree: Annotated[int | None, SH_DEGREE, hint("3, 0 where colors have no terms")] = None
    """Highest degree of spherical harmonics, which terms are fitted with; 0 keeps base colors alone."""
    json: Flag = False
    """Print one JSON document instead of lines."""
    debug: Flag = False
    """Show the traceback of an error."""
