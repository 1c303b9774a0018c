"""`gsvis convert`: merge scenes, write them in another format; cut, thin, simplify or place them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.cli.arguments import Convert
from gsvis.cli.memory import check_memory
from gsvis.cli.spelling import is_number
from gsvis.cli.targets import check_scene_out
from gsvis.cli.terminal import Status, print_json, show
from gsvis.io.batches import Batch, list_batches
from gsvis.io.convert import AXES, convert_scene, merge_scenes, rotation_about_axes
from gsvis.io.convert_batches import convert_batches
from gsvis.io.ksplat import save_ksplat
from gsvis.io.scenes import check_scene, save_scene, suffix_of
from gsvis.io.sources import check_source, is_builtin, is_levels, load_source, title_of
from gsvis.io.spz import save_spz
from gsvis.scene.axes import axis_vector
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.source import Source

__all__ = ["run_convert"]

_PAGE = ".html"
_KSPLAT_DEGREE = 2


def run_convert(command: Convert) -> None:
    """Convert scenes: read, merge, convert, write, print the result."""
    scenes, out = _split_paths(command)
    lods = _check_inputs(scenes, command.lod)
    up = _axes(command.placement.change_up)
    given = scenes[0] if len(scenes) == 1 else scenes
    target = check_scene_out(out, given, command.overwrite, name="OUT", source="IN", others=(_PAGE,))
    _check_options(command, target)
    convert = partial(
        convert_scene,
        crop=None if command.crop is None else (command.crop[:3], command.crop[3:]),
        min_opacity=command.min_opacity,
        up=up,
        scale=command.placement.scale,
        rotate=command.placement.rotate or (0.0, 0.0, 0.0),
        translate=command.placement.translate or (0.0, 0.0, 0.0),
    )
    batches = _batches(command, scenes, lods, target)
    if batches:
        with Status() as status:
            found = _convert_batches(command, batches, convert, target, status)
        _print_result(command, out, target, *found)
        return
    with Status() as status:
        inputs, before, known_up = _read(scenes, lods, status)
        after = convert(before, max_sh_degree=_degree(command, target, before, status))
        if target.suffix.lower() == _PAGE:
            as_read = up is None and command.placement.rotate is None and len(inputs) == 1
            upright = known_up if up is None else axis_vector(up[1])
            turned = rotation_about_axes(command.placement.rotate or (0.0, 0.0, 0.0)) @ upright
            name = " + ".join(each.name for each in inputs)
            _write_page(target, name, after, None if as_read else turned, status)
        else:
            status("writing", 0, 1)
            _write(command, target, after)
            status("writing", 1, 1)
    _print_result(command, out, target, inputs, len(after), after.sh_degree)


@dataclass(frozen=True)
class _Input:
    """Facts of a scene that was read."""

    path: str
    name: str
    lod: int | None
    gaussians: int
    sh_degree: int


def _batches(command: Convert, scenes: tuple[str, ...], lods: list[int | None], target: Path) -> list[list[Batch]]:
    """Return the batches of each scene if they are converted one by one; else an empty list, and the memory suffices.

    Files become a PLY that way, if there is more than one batch: its bytes are those of the whole.

    Raises:
        ValueError: If they do not fit `--max-memory` otherwise.
    """
    found = (
        [] if any(is_builtin(scene) or is_levels(scene) for scene in scenes) else list(map(list_batches, scenes, lods))
    )
    if suffix_of(target) == ".ply" and sum(map(len, found)) > 1:
        whole = [batch for scene in found for batch in scene if batch.kind == "whole"]
        check_memory("convert", [(batch.path, batch.lod) for batch in whole], command.max_memory, together=False)
        return found
    remedy = "a .ply is written batch by batch from a PLY or a streamed SOG, whatever its size"
    kind = "page" if target.suffix.lower() == _PAGE else "convert"
    check_memory(kind, list(zip(scenes, lods, strict=True)), command.max_memory, remedy)
    return []


def _convert_batches(
    command: Convert, batches: list[list[Batch]], convert: partial[Gaussians], target: Path, status: Status
) -> tuple[list[_Input], int, int]:
    """Write the PLY batch by batch; return what was read, and Gaussians and SH degree of what was written."""
    drops = command.crop is not None or command.min_opacity > 0.0
    convert = partial(convert, max_sh_degree=command.sh_degree)
    made = convert_batches(batches, target, convert, drops=drops, max_sh_degree=command.sh_degree, progress=status)
    inputs = [
        _Input(scene[0].path, title_of(scene[0].path, scene[0].lod), scene[0].lod, count, degree)
        for scene, count, degree in zip(batches, made.counts, made.sh_degrees, strict=True)
    ]
    return inputs, made.gaussians, made.sh_degree


def _print_result(
    command: Convert, out: str, target: Path, inputs: list[_Input], gaussians: int, sh_degree: int
) -> None:
    """Print what was written, as a line or as JSON."""
    size = target.stat().st_size
    before = sum(each.gaussians for each in inputs)
    if command.output.json:
        print_json(_document(command, out, inputs, gaussians, sh_degree) | {"bytes": size})
        return
    kept = f"{gaussians:,} of {before:,} Gaussians" if gaussians < before else f"{gaussians:,} Gaussians"
    of = f" of {len(inputs)} scenes" if len(inputs) > 1 else ""
    show(f"{out}: {kept}{of}, SH degree {sh_degree}, {size / 1e6:.2f} MB")


def _split_paths(command: Convert) -> tuple[tuple[str, ...], str]:
    """Return the scenes to read and the file to write."""
    paths = command.paths
    for path in paths:
        if is_number(path) and not Path(path).exists():
            raise ValueError(
                f"IN: expected a scene, got {path}; --translate and --rotate take three numbers, --scale one"
            )
    if command.out is not None:
        if not paths:
            raise ValueError("IN: expected a scene to read, got none; gsvis convert IN -o OUT")
        return paths, command.out
    if len(paths) > 2:
        raise ValueError(f"OUT: expected -o OUT with several scenes, got {len(paths)} paths; say which is OUT")
    if len(paths) < 2:
        got = f"only {paths[0]}" if paths else "nothing"
        raise ValueError(f"OUT: expected a file to write, got {got}; gsvis convert IN OUT")
    return paths[:1], paths[1]


def _check_inputs(scenes: tuple[str, ...], lods: tuple[int, ...] | None) -> list[int | None]:
    """Raise unless each scene is there and of a known format; return the LOD of each, None for the finest."""
    found: list[int | None] = [None] * len(scenes)
    streamed = []
    for k, scene in enumerate(scenes):
        check_source(scene, None)
        if not is_builtin(scene) and not is_levels(scene) and check_scene(scene):
            streamed.append(k)
    if lods is None:
        return found
    if not streamed:
        check_source(scenes[0], lods[0])  # says why it has none
        raise ValueError(f"--lod: expected none for a scene with one level of detail, got {lods[0]}; leave it out")
    if len(lods) not in (1, len(streamed)):
        raise ValueError(
            f"--lod: expected one number, or one for each streamed scene, which are {len(streamed)}, got {len(lods)}"
        )
    for place, k in enumerate(streamed):
        found[k] = lods[place if len(lods) > 1 else 0]
        check_source(scenes[k], found[k])
    return found


def _check_options(command: Convert, target: Path) -> None:
    """Raise if an option is given that the format of OUT does not know, or the viewer of a page is not built."""
    suffix = target.suffix.lower()
    if command.compact and suffix != ".spz":
        raise ValueError(f"--compact: expected an OUT that ends in .spz with it, got {str(target)!r}; leave it out")
    if command.ksplat_compression is not None and suffix != ".ksplat":
        raise ValueError(
            f"--ksplat-compression: expected an OUT that ends in .ksplat with it, got {str(target)!r}; leave it out"
        )
    if suffix == _PAGE:
        from gsvis.export.page import check_viewer

        check_viewer()


def _read(
    scenes: tuple[str, ...], lods: list[int | None], status: Status
) -> tuple[list[_Input], Gaussians, NDArray[np.float64]]:
    """Return what was read, the scenes merged to one, and the axis that points upwards in it."""
    inputs = []
    parts = []
    axes = []
    status("reading", 0, len(scenes))
    for k, (scene, lod) in enumerate(zip(scenes, lods, strict=True)):
        source = load_source(scene, lod)
        g = source.gaussians
        inputs.append(_Input(scene, source.name, source.lod, len(g), g.sh_degree))
        parts.append(g)
        axes.append(source.known_up)
        status("reading", k + 1, len(scenes))
    merged = merge_scenes(parts)
    known = [axis for axis in axes if axis is not None]
    agree = len(known) == len(axes) and all(np.array_equal(axis, known[0]) for axis in known)
    return inputs, merged, Source("", merged, known_up=known[0] if agree else None).up


def _degree(command: Convert, target: Path, scene: Gaussians, status: Status) -> int:
    """Return the highest SH degree to write; say so where the format of OUT lowers it."""
    degree = command.sh_degree
    if target.suffix.lower() != ".ksplat" or min(degree, scene.sh_degree) <= _KSPLAT_DEGREE:
        return degree
    status.line(f"{target}: SH degree {scene.sh_degree} is reduced to {_KSPLAT_DEGREE}, the highest of .ksplat")
    return _KSPLAT_DEGREE


def _write(command: Convert, target: Path, scene: Gaussians) -> None:
    """Write the scene in the format of OUT."""
    if command.compact:
        save_spz(scene, target, compact=True)
    elif command.ksplat_compression is not None:
        save_ksplat(scene, target, compression=command.ksplat_compression)
    else:
        save_scene(scene, target)


def _write_page(target: Path, name: str, scene: Gaussians, up: NDArray[np.float64] | None, status: Status) -> None:
    """Write the page that `gsvis export --format html` writes of the same scene.

    Args:
        target: The page.
        name: Name of the scene.
        scene: The scene.
        up: (3,) up axis of a scene that was turned or merged; None for one as it was read, of which export finds it.
        status: Shows the progress.
    """
    from gsvis.export import StaticOptions, write_html
    from gsvis.export.start import Visit, find_starts, plan_visit

    status("start", 0, 1)
    if up is None:
        known = None if scene.facts.up is None else np.asarray(scene.facts.up, np.float64)
        visit = plan_visit(Source(name, scene, known_up=known))
        for remark in visit.remarks:
            status.line(remark.strip())
    else:
        visit = Visit(find_starts(Source(name, scene), up), up, [])
    status("start", 1, 1)
    x, y, z = visit.up.tolist()
    options = StaticOptions(name, (x, y, z), poses=visit.starts, space=visit.space)
    write_html(target, scene, options, progress=status)


def _document(command: Convert, out: str, inputs: list[_Input], gaussians: int, sh_degree: int) -> dict[str, Any]:
    """Return the result as JSON."""
    alone = inputs[0] if len(inputs) == 1 else None
    return {
        "format": "gsvis-conversion",
        "version": 1,
        "in": alone.path if alone else None,
        "lod": alone.lod if alone else None,
        "inputs": [
            {"in": each.path, "lod": each.lod, "gaussians": each.gaussians, "sh_degree": each.sh_degree}
            for each in inputs
        ],
        "out": out,
        "gaussians_in": sum(each.gaussians for each in inputs),
        "gaussians_out": gaussians,
        "sh_degree_in": max(each.sh_degree for each in inputs),
        "sh_degree_out": sh_degree,
        "placement": {
            "up": None if command.placement.change_up is None else command.placement.change_up.strip(),
            "scale": command.placement.scale,
            "rotate": list(command.placement.rotate or (0.0, 0.0, 0.0)),
            "translate": list(command.placement.translate or (0.0, 0.0, 0.0)),
        },
    }


def _axes(up: str | None) -> tuple[str, str] | None:
    """Return the two axes of --change-up: ('-y', '+z') for '-y:+z'; None without it."""
    if up is None:
        return None
    old, _, new = up.strip().partition(":")
    if old not in AXES or new not in AXES:
        raise ValueError(
            f"--change-up: expected FROM:TO with axes of {', '.join(AXES)}, such as -y:+z, got {up.strip()!r}"
        )
    return old, new
