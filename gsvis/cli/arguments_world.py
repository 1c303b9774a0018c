"""The arguments of `gsvis world`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli.arguments_where import Framed
from gsvis.cli.readers import (
    BYTES,
    CELLS,
    COUNTED,
    DISTANCE,
    FACE_PIXELS,
    LODS,
    PLAIN,
    RADIANS,
    SCENES,
    SHARE,
    SHARES_OR_NONE,
    STEPS,
    WHOLE,
    Flag,
    hint,
)

__all__ = ["World"]


@dataclass(frozen=True)
class World(Framed):
    """Make a world of scenes of any size: tiles, each a package, and districts."""

    scenes: Annotated[Positional[tuple[str, ...]], SCENES, arg(help_behavior_hint="")]
    """Files or folders, as for gsvis convert, all in one frame; PLY or streamed SOG if they do not fit the memory."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder of the world, such as city.gsworld; city.gsworld.work beside it keeps work for the next run."""
    lod: Annotated[tuple[int, ...] | None, LODS, hint("the finest that is there")] = None
    """Level of detail of a streamed scene; 0 is the finest. One number for all, or one for each, as in 3,2."""
    tile: Annotated[int, COUNTED] = 250_000
    """Most Gaussians of a tile, about."""
    far: Annotated[int, COUNTED] = 8_192
    """Most Gaussians of a district, which stands for one or several tiles from afar."""
    angle: Annotated[float, RADIANS] = 0.006
    """Lower levels and districts stand in from where their spacing is below this angle."""
    levels: Annotated[tuple[float, ...], SHARES_OR_NONE, hint("0.25 0.5")] = (0.25, 0.5)
    """Size of each lower level as a share of a tile's, lowest first; none for the tiles alone."""
    steps: Annotated[int, STEPS] = 250
    """Steps of training for each lower level, one view each."""
    cells: Annotated[int, CELLS] = 32
    """Largest number of cells of a tile."""
    cell_size: Annotated[float | None, DISTANCE, hint("the smallest that --cells allows")] = None
    """Side of a cell, scene units."""
    face_size: Annotated[int | None, FACE_PIXELS, hint("768")] = None
    """Pixels along a side of the six faces around a viewpoint of a cell."""
    limit: Annotated[float | None, SHARE, hint("0.0015")] = None
    """The set of a cell is finished when rays prove that it misses at most this share of the light."""
    path: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no path)")] = None
    """Walk that viewpoints are restricted to, in the frame of the scenes: a CSV of poses (t,x,y,z,qw,qx,qy,qz) or an
    EyeNavGS recording. Tiles that it does not come near have no cells."""
    margin: Annotated[float | None, DISTANCE, hint("1")] = None
    """Distance of viewpoints from --path, at most, in scene units."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers. Tiles are cut along the axes that are nearest to level."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no cameras)")] = None
    """Cameras of the capture, in the frame of the scenes: a COLMAP model, transforms.json or cameras.json. They say
    which way is up, eyes are around half of them too, and the others judge the sets of tiles."""
    meters_per_unit: Annotated[float | None, DISTANCE, hint("that of the scenes, or not known")] = None
    """Length of a scene unit in meters, kept in the world."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same world."""
    workers: Annotated[int | None, COUNTED, hint("one for each core")] = None
    """Number of processes of this machine. The world is the same for any number."""
    max_memory: Annotated[int | None, BYTES, hint("no bound")] = None
    """Memory limit of all processes together, such as 4GB or 2GiB."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: this machine)")] = None
    """Dask scheduler whose workers do the work, such as tcp://10.0.0.5:8786. They must reach the scenes and --work."""
    work: Annotated[str | None, arg(metavar="DIR or URL", help_behavior_hint="(default: beside DIR)")] = None
    """Where results of tasks lie: a shared folder or a URL of fsspec, such as s3://bucket/city."""
    until: Annotated[Literal["tiles", "levels", "world"], PLAIN] = "world"
    """Stop early: tiles writes a PLY for each into DIR, levels a folder of levels, with tiles.json. (default: world)"""
    dry_run: Flag = False
    """Print time, memory and disk, tiles and core hours, and write nothing."""
    discard: Flag = False
    """Delete what is kept for the next run, city.gsworld.work, when the world is complete, but not what lies in
    --work."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""
