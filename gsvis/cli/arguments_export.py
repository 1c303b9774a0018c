"""The arguments of `gsvis export`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli.arguments_where import SHOW, WhereSeen
from gsvis.cli.readers import DISTANCE, LEAF, ORIGINS, PLAIN, Flag, Lod, hint

__all__ = ["Export"]


@dataclass(frozen=True)
class Export(WhereSeen):
    """Write a scene for players that need no gsvis: sites, streamed SOG, 3D Tiles."""

    scene: Annotated[Positional[str], arg(metavar="SCENE", help_behavior_hint="")]
    """A package, or a scene as it is: a file or folder that gsvis reads, or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="(required)")]
    """Folder of the site, the streamed SOG or the tileset, or the .html or .glb file."""
    format: Annotated[Literal["static", "html", "streamed-sog", "3dtiles", "glb"], PLAIN] = "static"
    """static: a site that any file server or CDN serves; html: one file that opens from disk; streamed-sog: leaves for
    PlayCanvas' engine, and which of them each cell needs; 3dtiles: a tileset for CesiumJS; glb: one file of glTF.
    (default: static)"""
    pvs: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: those of a package)")] = None
    """Visible sets of SCENE (gsvis pvs), where it is no package; for streamed-sog and 3dtiles."""
    never_seen: Annotated[Literal["keep", "drop"], PLAIN] = "keep"
    """What streamed-sog and 3dtiles do with Gaussians that no cell sees; from outside, holes show. (default: keep)"""
    leaf: Annotated[int | None, LEAF, hint("8192")] = None
    """Most Gaussians of a leaf of streamed-sog or 3dtiles; leaves have half of it at least."""
    compression: Annotated[Literal["auto", "none", "spz"], PLAIN] = "auto"
    """How 3dtiles and glb hold Gaussians. none: every value as it is; spz: a fifth of the size, and what CesiumJS
    reads; auto: spz for 3dtiles, none for glb. (default: auto)"""
    request_volumes: Flag = False
    """Have viewers of 3dtiles request a tile only in the box of the cells that need it. From outside of all cells
    little is drawn then. Needs visible sets."""
    meters_per_unit: Annotated[float | None, DISTANCE, hint("the package's, or 1")] = None
    """Length of a scene unit in meters, for 3dtiles and glb."""
    name: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: that of SCENE)")] = None
    """Name of the scene in the page."""
    page_origins: Annotated[tuple[str, ...], ORIGINS, hint("its own address")] = ()
    """Other origins that a site may open scenes of, by ?content=, such as https://cdn.example.org; for static."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the package's, or the likely one)")] = (
        None
    )
    """Up in the scene: an axis such as -y, or three numbers."""
    show: Annotated[str | None, SHOW] = None
    """Write a picture of where people stand: the first view, and a plan with eyes; for static and html."""
    overwrite: Flag = False
    """Replace files that exist: a file, an earlier streamed SOG or tileset, or a page of something else. An earlier
    site is replaced without it."""
    json: Flag = False
    """Print one JSON document instead of lines."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""
