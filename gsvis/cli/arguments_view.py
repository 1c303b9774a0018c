"""The arguments of `gsvis view`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from gsvis.cli.arguments_where import SHOW, WhereSeen
from gsvis.cli.readers import PORT, Flag, Lod, hint

__all__ = ["View"]


@dataclass(frozen=True)
class View(WhereSeen):
    """Show a scene or a package in the browser, until Ctrl-C."""

    scene: Annotated[Positional[str], arg(metavar="SCENE", help_behavior_hint="")]
    """A package, a world or a static scene, or a scene as it is: a file or folder, or builtin:NAME."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in a scene as it is: an axis such as -y, or three numbers."""
    show: Annotated[str | None, SHOW] = None
    """Write a picture of where people stand: the first view, and a plan with eyes."""
    prepare: Annotated[str | None, arg(metavar="PACKAGE", help_behavior_hint="(default: show it as it is)")] = None
    """Also prepare the scene as this package meanwhile; it is served under the same name as soon as it is ready."""
    host: Annotated[str, arg(metavar="HOST", help_behavior_hint="(default: 127.0.0.1)")] = "127.0.0.1"
    """Address to listen on. 127.0.0.1 accepts this machine only, 0.0.0.0 every machine."""
    port: Annotated[int | None, PORT, hint("8765, or a free one")] = None
    """Port; 0 takes one that is free."""
    no_browser: Flag = False
    """Print the address and open no browser."""
    json: Flag = False
    """Print one JSON document with the address once it listens."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""
