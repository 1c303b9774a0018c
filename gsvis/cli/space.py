"""`gsvis space`: write where a visitor can be, and what stops one, as meshes or voxels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsvis._extras import require
from gsvis.cli.arguments import Space
from gsvis.cli.options import changed
from gsvis.cli.source import open_source
from gsvis.cli.targets import check_outputs
from gsvis.cli.terminal import Status, facts, print_json, show, size_of
from gsvis.cli.where import check_where, find_place, flyaway_remarks, kind_row, parse_up
from gsvis.errors import SceneError
from gsvis.files.atomic import atomic_path
from gsvis.io.sources import check_source
from gsvis.io.voxels import VOXELS, save_voxels
from gsvis.scene.lengths import spell_length, spell_point, spell_volume
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.source import Source

__all__ = ["run_space"]

_REMEDY = "say where eyes may be with --box or --around, or raise --resolution"


def run_space(command: Space) -> None:
    """Find the navigable space of a scene and write it."""
    files = _files(command)
    walk = check_where(command.where)
    check_source(command.scene, command.lod)
    with Status() as status:
        source = open_source(command.scene, command.lod, status)
        with status.stage("space"):
            space, remarks = _find(command, source, walk)
        meters = command.meters_per_unit or source.gaussians.facts.meters_per_unit
        with status.stage("writing"):
            found = (
                _write_voxels(space, files)
                if len(files) == 2
                else _write_meshes(command, space, files[0], meters, source.gaussians.facts.origin)
            )
    origin = source.gaussians.facts.origin
    nbytes = sum(file.stat().st_size for file in files)
    low = space.origin
    high = space.origin + np.array(space.free.shape) * space.voxel_size
    said: dict[str, Any] = {
        "format": "gsvis-space",
        "version": 1,
        "in": command.scene,
        "files": [str(file) for file in files],
        "bytes": nbytes,
        "kind": space.kind.as_dict(),
        **({"origin": list(origin)} if any(origin) else {}),
        "voxel": space.voxel_size,
        "box": [low.tolist(), high.tolist()],
        "navigable_volume": float(np.count_nonzero(space.free)) * space.voxel_size**3,
        **found,
    }
    if command.output.json:
        print_json({**said, "remarks": [each.strip() for each in remarks]})
        return
    rows = [
        kind_row(space),
        *([("origin", f"{spell_point(origin)}; positions are relative to it")] if any(origin) else []),
        ("voxels", f"{' x '.join(map(str, space.free.shape))} of {spell_length(space.voxel_size, meters)}"),
        ("navigable", spell_volume(said["navigable_volume"], meters)),
        *((name.replace("_", " "), f"{value:,}") for name, value in found.items() if isinstance(value, int)),
    ]
    show(facts(source.name, rows), *remarks, f" {' and '.join(map(str, files))}, {size_of(nbytes)}")


def _find(command: Space, source: Source, walk: HeadPath | None) -> tuple[NavigableSpace, list[str]]:
    """Return the navigable space, and remarks for the user."""
    if command.resolution is None:
        place = find_place(source, command.where, walk)
        return place.required(_REMEDY), place.remarks
    up = source.known_up if command.where.up is None else parse_up(command.where.up)
    try:
        space = NavigableSpace.from_scene(source.gaussians, resolution=command.resolution, up=up)
    except SceneError as error:
        raise SceneError(f"{command.scene}: {error.problem}; {_REMEDY}") from None
    return space, flyaway_remarks(source.gaussians)


def _files(command: Space) -> list[Path]:
    """Return the files to write.

    Raises:
        ValueError: If an argument is wrong, before the scene is read.
    """
    out = Path(command.out)
    if out.name.endswith(VOXELS):
        files = [out, out.with_name(out.name.removesuffix(VOXELS) + ".voxel.bin")]
        for option, value in (("--meters-per-unit", command.meters_per_unit), ("--frame", command.frame)):
            if value not in (None, "upright"):
                raise ValueError(f"{option}: expected none with {VOXELS}, whose frame is the viewer's; leave it out")
    elif out.suffix.lower() == ".glb":
        files = [out]
        require("gsvis space", "skimage")
    else:
        raise ValueError(f"--out: expected a file that ends in .glb or {VOXELS}, got {command.out}; name one")
    if command.frame == "scene" and command.meters_per_unit is not None:
        raise ValueError("--meters-per-unit: expected none with --frame scene, whose unit is that of SCENE")
    if command.resolution is not None:
        if not 8 <= command.resolution <= 384:
            raise ValueError(f"--resolution: expected 8 to 384 voxels, got {command.resolution}")
        if changed(command, command.where.WORDS):
            raise ValueError("--resolution: expected no --box, --around or --path with it; leave one of them out")
    check_outputs({f"--out ({file.name})": file for file in files}, {"SCENE": command.scene}, command.overwrite)
    return files


def _write_voxels(space: NavigableSpace, files: list[Path]) -> dict[str, Any]:
    """Write solid voxels; return their number, for JSON."""
    from gsvis.edit import solid_voxels

    voxels = solid_voxels(space)
    save_voxels(voxels, files[0])
    return {"solid_voxels": int(np.count_nonzero(voxels.solid))}


def _write_meshes(
    command: Space, space: NavigableSpace, file: Path, meters: float | None, origin: Sequence[float]
) -> dict[str, Any]:
    """Write the meshes; return what they hold, for JSON."""
    from gsvis.edit import mesh_space

    scale = 1.0 if command.frame == "scene" else meters or 1.0
    meshes = mesh_space(space, frame=command.frame, meters_per_unit=scale)
    with atomic_path(file) as partial:
        partial.write_bytes(meshes.to_glb(origin))
    return {
        "navigable_triangles": len(meshes.navigable.faces),
        "surface_triangles": len(meshes.surface.faces),
        "scene_to_mesh": meshes.matrix.tolist(),
    }
