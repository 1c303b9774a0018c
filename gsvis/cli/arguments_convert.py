"""The arguments of `gsvis convert`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from gsvis.cli.readers import (
    ANGLES,
    BOX,
    BYTES,
    COMPRESSION,
    LODS,
    OPACITY,
    PATHS,
    POINT,
    SCALE,
    SH_DEGREE,
    Flag,
    hint,
)

__all__ = ["Convert"]


@dataclass(frozen=True)
class Convert:
    """Merge, crop, thin or move scenes, or change their format.

    gsvis convert IN OUT, or gsvis convert IN [IN ...] -o OUT.

    Steps come in the order of this list, whatever order you write them in.
    """

    paths: Annotated[Positional[tuple[str, ...]], PATHS, arg(help_behavior_hint="")]
    """Files or folders (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME. Several
    scenes become one, in their order. Without -o there is one scene, and OUT stands behind it."""
    out: Annotated[str | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="(default: the last path)")] = None
    """File to write: .ply, .spz, .sog, .ksplat, or a page, .html. An existing one needs --overwrite."""
    lod: Annotated[tuple[int, ...] | None, LODS, hint("the finest that is there")] = None
    """Level of detail of a streamed scene; 0 is the finest. One number for all, or one for each, as in 3,2."""
    crop: Annotated[tuple[float, ...] | None, BOX, hint("no crop")] = None
    """Keep the Gaussians whose center lies in this box, in the frame of the scenes as they are."""
    min_opacity: Annotated[float, OPACITY] = 0.0
    """Drop Gaussians fainter than this."""
    sh_degree: Annotated[int, SH_DEGREE] = 3
    """Highest degree of spherical harmonics that is kept."""
    change_up: Annotated[str | None, arg(metavar="FROM:TO", help_behavior_hint="(default: left as it is)")] = None
    """Turn the scene so that axis FROM becomes TO, as in -y:+z."""
    scale: Annotated[float, SCALE] = 1.0
    """Enlarge the scene by this factor, about the origin."""
    rotate: Annotated[tuple[float, ...] | None, ANGLES, hint("no turn")] = None
    """Turn the scene about the origin: degrees about x, then y, then z, axes that stay fixed."""
    translate: Annotated[tuple[float, ...] | None, POINT, hint("not moved")] = None
    """Move the scene, all of it. To place one scene beside another, convert it alone first."""
    compact: Flag = False
    """Round an SPZ as other encoders do: a quarter to two fifths smaller, several dB worse."""
    ksplat_compression: Annotated[int | None, COMPRESSION, hint("1")] = None
    """Compression of a .ksplat: 0 whole floats, 1 half floats, 2 also a byte for each SH coefficient."""
    max_memory: Annotated[int | None, BYTES, hint("no bound")] = None
    """Memory limit, such as 4GB: work that needs more is refused. A .ply is written batch by batch and fits."""
    overwrite: Flag = False
    """Replace files that exist."""
    json: Flag = False
    """Print one JSON document instead of a line."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""
