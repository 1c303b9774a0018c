"""The arguments of `gsvis export`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli.readers import PLAIN, Flag, Lod

__all__ = ["Export"]


@dataclass(frozen=True)
class Export:
    """Write a scene or a package for players that need no gsvis: a site, or one file."""

    scene: Annotated[Positional[str], arg(metavar="SCENE", help_behavior_hint="")]
    """A package, or a scene as it is: a file or folder that gsvis reads, or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="(required)")]
    """Folder of the site, or the .html file."""
    format: Annotated[Literal["static", "html"], PLAIN] = "static"
    """static: a site that any file server or CDN serves; html: one file that opens from disk. (default: static)"""
    name: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: that of SCENE)")] = None
    """Name of the scene in the page."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    up: Annotated[str | None, arg(metavar="AXIS", help_behavior_hint="(default: the package's, or the likely one)")] = (
        None
    )
    """Axis that points upwards in the scene, such as -y."""
    overwrite: Flag = False
    """Replace a file that exists, or a page of something else; an earlier site is replaced without it."""
    json: Flag = False
    """Print one JSON document instead of lines."""
    debug: Flag = False
    """Show the traceback of an error."""
