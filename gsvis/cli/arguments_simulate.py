"""The arguments of `gsvis simulate`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli.readers import BYTES, COUNTED, DEGREES, PACKAGES, PIXELS, PLAIN, SECONDS, WHOLE, hint
from gsvis.cli.readers import _number as number
from gsvis.cli.readers import _spec as spec

__all__ = ["Simulate"]

Flag = Annotated[bool, PLAIN]

_FILES = spec("*", "FILE [FILE ...]", tuple)
_MBIT = number("MBIT", float, 0.001, 100_000.0, "Mbit/s in [0.001, 100000]")
_MILLISECONDS = number("MS", float, 0.0, 10_000.0, "milliseconds in [0, 10000]")


@dataclass(frozen=True)
class Simulate:
    """Simulate what a viewer sees while a scene arrives over a link; write a report."""

    package: Annotated[Positional[tuple[str, ...]], PACKAGES, arg(help_behavior_hint="")]
    """Folders of packages or worlds, such as scene.gsvis; several are visited one after the other."""
    path: Annotated[str, arg(metavar="FILE", help_behavior_hint="(required)")]
    """Walk of the viewer: a CSV of poses (t,x,y,z,qw,qx,qy,qz) or an EyeNavGS recording. Moved into the
    scene if it lies outside."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder for report.html (all in one file), report.json and the pictures; made if missing."""
    trace: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: --mbit)")] = None
    """Bandwidth over time: a recorded 5G log (.csv), or lines of seconds and Mbit/s."""
    mbit: Annotated[float | None, _MBIT, hint("10, without --trace")] = None
    """A link of one rate instead, Mbit/s."""
    round_trip: Annotated[float, _MILLISECONDS, hint("40")] = 40.0
    """Round-trip time of the link, milliseconds."""
    seconds: Annotated[float, SECONDS] = 30.0
    """How long the viewer stays in each scene."""
    visits: Annotated[int | None, COUNTED, hint("one for each package")] = None
    """Number of visits, in the order of the packages, in turns; each begins with nothing."""
    policy: Annotated[Literal["utility", "fov-first", "low-first"], PLAIN] = "utility"
    """What is sent first. (default: utility)"""
    no_fill: Flag = False
    """Send only what a view needs: an idle link does not bring the rest of the scene."""
    scene: Annotated[tuple[str, ...], _FILES, hint("found beside each package")] = ()
    """The scene that each package was made from, or all scenes of one world, to compare with."""
    lod: Annotated[int | None, WHOLE, hint("the finest that is there")] = None
    """Level of detail of a streamed --scene; 0 is the finest."""
    whole_file: Annotated[tuple[str, ...], _FILES, hint("the best of SOG and SPZ")] = ()
    """A file or folder of each scene; its size is used for the whole file."""
    width: Annotated[int, PIXELS] = 320
    """Pixels across the views that are compared."""
    height: Annotated[int, PIXELS] = 240
    """Pixels down these views."""
    fov: Annotated[float, DEGREES] = 90.0
    """Horizontal field of view of the viewer."""
    every: Annotated[float, SECONDS] = 0.5
    """Seconds between comparisons after the first three seconds; 0.1 before."""
    as_is: Flag = False
    """Leave the path where it is, even outside of the scene."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same report."""
    max_memory: Annotated[int | None, BYTES, hint("no bound; worlds must fit this machine")] = None
    """Memory limit, such as 4GB: what needs more is refused. All records are read."""
    json: Flag = False
    """Print one JSON document, report.json, instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""
