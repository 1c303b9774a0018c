"""`gsvis convert`: write a scene in another format; cut, thin, simplify or rotate it."""

from __future__ import annotations

from gsvis.cli.arguments import Convert
from gsvis.cli.scene_out import check_scene_out
from gsvis.cli.source import check_source, load_source
from gsvis.cli.terminal import Status, print_json, show
from gsvis.io.convert import AXES, convert_scene
from gsvis.io.scenes import save_scene
from gsvis.io.spz import save_spz

__all__ = ["run_convert"]


def run_convert(command: Convert) -> None:
    """Convert a scene: read, convert, write, print the result.

    Raises:
        GsvisError: If the file cannot be read, or nothing is left of the scene.
        ValueError: If an argument is wrong.
        FileNotFoundError: If there is no such file.
        OSError: If the result cannot be written.
    """
    check_source(command.scene, command.lod)
    up = _axes(command.up)
    target = check_scene_out(command.output, command.scene, command.overwrite, name="OUT", source="IN")
    if command.compact and target.suffix.lower() != ".spz":
        raise ValueError(f"--compact: expected an OUT that ends in .spz with it, got {command.output!r}; leave it out")
    crop = None if command.crop is None else (command.crop[:3], command.crop[3:])
    with Status() as status:
        status("reading", 0, 1)
        source = load_source(command.scene, command.lod)
        status("reading", 1, 1)
        status("writing", 0, 1)
        before = source.gaussians
        after = convert_scene(
            before, crop=crop, min_opacity=command.min_opacity, max_sh_degree=command.max_sh_degree, up=up
        )
        if command.compact:
            save_spz(after, target, compact=True)
        else:
            save_scene(after, target)
        status("writing", 1, 1)
    size = target.stat().st_size
    if command.json:
        print_json(
            {
                "format": "gsvis-conversion",
                "version": 1,
                "in": command.scene,
                "lod": source.lod,
                "out": command.output,
                "bytes": size,
                "gaussians_in": len(before),
                "gaussians_out": len(after),
                "sh_degree_in": before.sh_degree,
                "sh_degree_out": after.sh_degree,
            }
        )
        return
    kept = f"{len(after):,} of {len(before):,} Gaussians" if len(after) < len(before) else f"{len(after):,} Gaussians"
    show(f"{command.output}: {kept}, SH degree {after.sh_degree}, {size / 1e6:.2f} MB")


def _axes(up: str | None) -> tuple[str, str] | None:
    """Return the two axes of --up: ('-y', '+z') for '-y:+z'; None without it."""
    if up is None:
        return None
    old, _, new = up.strip().partition(":")
    if old not in AXES or new not in AXES:
        raise ValueError(f"--up: expected FROM:TO with axes of {', '.join(AXES)}, such as -y:+z, got {up.strip()!r}")
    return old, new
