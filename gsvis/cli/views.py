"""Cameras for `gsvis render`: from a file, in an orbit, at a point, or sampled in the navigable space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis.cli.arguments import Render
from gsvis.cli.options import refuse, values_of
from gsvis.cli.source import Source, file_cameras, parse_up
from gsvis.cli.where import check_where, find_place
from gsvis.scene.axes import describe_direction
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.solid import buried
from gsvis.scene.source_frame import SourceFrame
from gsvis.scene.upright import SURE, find_up

__all__ = ["camera_count", "check_buried", "check_views", "given_cameras", "place_cameras"]

F64 = NDArray[np.float64]

_WIDTH = 640
_HEIGHT = 480
_FOV = 60.0
_ELEVATION = 20.0
_SHOWN = 0.9  # share of the centers that an orbit shows


def check_views(command: Render) -> HeadPath | None:
    """Return the walk of --path; raise if arguments about cameras contradict each other.

    Raises:
        ValueError: If they do; the message names them.
    """
    given = {name: value for name, value in values_of(command).items() if value is not None}
    ways = [way for way in ("cameras", "orbit", "eye") if way in given]
    if len(ways) > 1:
        raise ValueError(f"--{ways[1]}: expected none with --{ways[0]}, got both; leave one out")
    way = ways[0] if ways else ""
    needs = {"index": ("cameras",), "radius": ("orbit",), "elevation": ("orbit",), "target": ("orbit", "eye")}
    for name, wanted in needs.items():
        if name in given and way not in wanted:
            raise ValueError(f"--{name}: expected {' or '.join('--' + each for each in wanted)} with it, got it alone")
    if way == "cameras":
        refuse(command, ["fov", "up"], "with --cameras, whose file states it")
    if command.cast.eye is not None and command.cast.eye == command.cast.target:
        point = " ".join(f"{value:g}" for value in command.cast.eye)
        raise ValueError(f"--target: expected a point that is not --eye, got {point} for both")
    return check_where(command.where, f"--{way}" if way else "")


def given_cameras(command: Render) -> Cameras | None:
    """Return the cameras of --cameras, at the given size, only those of --index if given; None without --cameras.

    Raises:
        GsvisError: If the file cannot be read.
        FileNotFoundError: If there is no file.
        ValueError: If an index is too large.
    """
    if command.where.cameras is None:
        return None
    cameras = file_cameras(command.where.cameras, command.picture.width, command.picture.height)
    if command.cast.index is None:
        return cameras
    if max(command.cast.index) >= len(cameras):
        raise ValueError(
            f"--index: expected 0 to {len(cameras) - 1}, as {command.where.cameras} holds {len(cameras)} cameras,"
            f" got {max(command.cast.index)}"
        )
    return cameras[np.array(command.cast.index)]


def camera_count(command: Render, given: Cameras | None) -> int:
    """Return the number of cameras to render."""
    return len(given) if given is not None else command.cast.orbit or 1


def place_cameras(
    command: Render, source: Source, walk: HeadPath | None = None
) -> tuple[Cameras, NavigableSpace | None, list[str]]:
    """Return cameras placed in a scene without a file, the space that they were drawn in, and remarks for the user.

    Raises:
        SceneError: If there is no navigable space for a sampled camera.
    """
    size = {"width": command.picture.width or _WIDTH, "height": command.picture.height or _HEIGHT}
    fov = command.picture.fov or _FOV
    up, remarks = _up(command, source)
    g = source.gaussians
    if command.cast.eye is None and command.cast.orbit is None:
        place = find_place(source, command.where, walk)
        space = place.required("name a place with --eye X Y Z, --orbit N, --box or --around")
        if command.where.up is None:
            space = replace(space, up=up)
        cameras = space.sample_cameras(1, np.random.default_rng(command.seed), fov=fov, **size)
        more = check_buried(g, cameras.viewpoints, "the sampled eye")
        return cameras, space, [*remarks, *place.remarks, *more, f" Again: {_options_of(cameras)}"]
    middle, reach = _extent(g)
    frame = SourceFrame.from_scene(g)
    target = middle if command.cast.target is None else frame.points([command.cast.target])[0]
    if command.cast.eye is not None:
        eye = frame.points([command.cast.eye])
        remarks += check_buried(g, eye, "--eye")
        return Cameras.look_at(eye, target, up=up, fov=fov, **size), None, remarks
    half = np.tan(np.radians(fov) / 2.0) * min(1.0, size["height"] / size["width"])
    radius = command.cast.radius or reach / np.sin(np.arctan(half))
    elevation = _ELEVATION if command.cast.elevation is None else command.cast.elevation
    return (
        Cameras.orbit(target, radius, command.cast.orbit or 1, up=up, elevation=elevation, fov=fov, **size),
        None,
        remarks,
    )


def check_buried(g: Gaussians, eyes: F64, name: str) -> list[str]:
    """Return a remark if eyes (P, 3) lie inside something solid."""
    lost = int(np.count_nonzero(buried(g, np.asarray(eyes, np.float64))))
    if not lost:
        return []
    if len(eyes) > 1:
        return [
            f" Expected {name} in free space, got {lost:,} of {len(eyes):,} inside something solid, which fills their"
            " pictures; leave them out."
        ]
    return [f" Expected {name} in free space, got a point inside something solid, which fills the picture; move it."]


def _up(command: Render, source: Source) -> tuple[F64, list[str]]:
    """Return the up axis, and remarks: the user's, the known one, or a guess, with a remark if uncertain."""
    given = parse_up(command.where.up)
    known = source.known_up if given is None else given
    if known is not None:
        return known, []
    found = find_up(source.gaussians)
    doubt = f" The up axis is uncertain ({describe_direction(found.up)} with a confidence of {found.confidence:.0%});"
    return found.up, [f"{doubt} --up AXIS sets it."] if found.confidence < SURE else []


def _extent(g: Gaussians) -> tuple[F64, float]:
    """Return the (3,) middle of the scene without outliers, and the radius of a ball that holds this part."""
    low, high = g.bounds(_SHOWN)
    return 0.5 * (low + high), max(
        0.5 * float(np.linalg.norm(high - low)), 3.0 * float(np.median(g.scales.max(axis=1)))
    )


def _options_of(camera: Cameras) -> str:
    """Return the options --eye and --target that give a camera again."""
    eye = camera.viewpoints[0]
    return " ".join(
        f"{name} {' '.join(f'{value:.5g}' for value in point)}"
        for name, point in (("--eye", eye), ("--target", eye + camera.forwards[0]))
    )
