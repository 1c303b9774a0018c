"""`gsvis render`: render cameras as pictures, depth or an animation, or list the contributors to a pixel.

Cameras come from a file, an orbit or a point, or are sampled in the navigable space.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis._extras import require
from gsvis.cli.arguments import Render
from gsvis.cli.device import say_device
from gsvis.cli.options import refuse, values_of
from gsvis.cli.source import open_source
from gsvis.cli.terminal import Status, facts, print_json, show
from gsvis.cli.where import check_where, find_place, framed_cameras, parse_up, space_document
from gsvis.io.cameras import load_cameras_at
from gsvis.io.report_cameras import describe_cameras
from gsvis.package.shown import check_shown, load_shown
from gsvis.prepare.warm import warm_rendering
from gsvis.render import PixelContributors, contributors, rasterize
from gsvis.render.device import choose_device
from gsvis.render.device_scene import DeviceScene
from gsvis.report.frames import Frame, Target, target_of, write_frames
from gsvis.scene.axes import describe_direction
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.link import parse_link
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.solid import buried
from gsvis.scene.source import Source
from gsvis.scene.source_frame import SourceFrame
from gsvis.scene.upright import SURE, find_up

__all__ = ["run_render"]

_FPS = 12.0
_ROWS = 40  # most rows of the table of contributors
F64 = NDArray[np.float64]
_WIDTH = 640
_HEIGHT = 480
_FOV = 60.0
_ELEVATION = 20.0
_SHOWN = 0.9  # share of the centers that an orbit shows


@dataclass(frozen=True, eq=False)
class _Done:
    """The result of a run."""

    source: Source
    cameras: Cameras
    space: NavigableSpace | None
    remarks: list[str]
    backend: str
    seconds: float
    depth_range: tuple[float, float] | None
    found: PixelContributors | None


def run_render(command: Render) -> None:
    """Render a scene: read, place cameras, draw, write, print the result."""
    if command.picture.depth:
        require("gsvis render --depth", "matplotlib")
    check_shown(command.scene, command.lod)
    walk = check_views(command)
    if command.reference and command.device == "cuda":
        raise ValueError("--reference: expected the CPU, got --device cuda; leave out either")
    device = choose_device("cpu" if command.reference else command.device)
    backend = "reference" if command.reference else device.name
    given = given_cameras(command)
    target = _target(command, camera_count(command, given))
    older = target.older() if target else 0
    with Status() as status:
        say_device(device, status)
        done = _render(command, given, walk, target, backend, status)
    if command.output.json:
        print_json(_document(command, target, done))
        return
    parts: list[Any] = []
    if target:
        parts += _lines(command, target, done)
        if older:
            parts.append(f" {target.path} also holds {older:,} later frames of an earlier run.")
    if done.space is not None:
        parts.append(f" Taken for {done.space.kind}.")
    show(*parts, *done.remarks, *(_table(command, done.found) if done.found is not None else []))


def _render(
    command: Render, given: Cameras | None, walk: HeadPath | None, target: Target | None, backend: str, status: Status
) -> _Done:
    """Read the scene, render it and write the pictures; return the result."""
    source = open_source(command.scene, command.lod, status, "see", load_shown)
    with status.stage("space"):
        if given is None:
            cameras, space, remarks = place_cameras(command, source, walk)
        else:
            cameras, framed = framed_cameras(source, given, command.where)
            space = None
            remarks = framed + check_buried(source.gaussians, cameras.viewpoints, "the cameras of --cameras")
            for each in framed:
                status.line(each.strip())
    if command.contributors is not None:
        _check_pixel(command.contributors, cameras)
    warm_rendering(backend, status)
    start = time.perf_counter()
    depth_range = None
    if target:
        frames = _frames(command, source.gaussians, cameras, backend, status)
        depth_range = write_frames(target, frames, depth=command.picture.depth, fps=command.picture.fps or _FPS)
    seconds = time.perf_counter() - start
    found = None
    if command.contributors is not None:
        found = contributors(
            source.gaussians, cameras, command.contributors, antialiased=command.picture.antialiased or None
        )
    return _Done(source, cameras, space, remarks, backend, seconds, depth_range, found)


def _frames(command: Render, g: Gaussians, cameras: Cameras, backend: str, status: Status) -> Iterator[Frame]:
    """Yield the render of each camera, one at a time."""
    draw: Callable[..., Any] = DeviceScene(g, backend).draw
    if command.reference:
        draw = partial(rasterize, g, backend=backend)
    status("rendering", 0, len(cameras))
    for i in range(len(cameras)):
        seen = draw(
            cameras[i],
            background=command.picture.background,
            sh_degree=command.picture.sh_degree,
            antialiased=command.picture.antialiased or g.facts.antialiased,
        )
        yield Frame(*(part[0] for part in (seen.images, seen.alphas, seen.depths)))
        status("rendering", i + 1, len(cameras))


def _target(command: Render, count: int) -> Target | None:
    """Return where to write pictures, checked; None if only contributors are asked for."""
    if command.contributors is not None and count > 1:
        raise ValueError(f"--contributors: expected one camera, got {count}; choose one, as with --index 0")
    if command.out is None:
        if command.contributors is None or command.picture.depth or command.picture.fps is not None:
            raise ValueError("-o: expected where to write, such as image.png, orbit.gif or frames/, got nothing")
        return None
    target = target_of(command.out, count)
    if not command.overwrite and (others := target.foreign(command.picture.depth)):
        raise ValueError(
            f"-o: expected a new file, or a picture of gsvis to replace, got {others[0]}, which something else wrote;"
            " name another, or say --overwrite"
        )
    if command.picture.fps is not None and target.kind != "gif":
        raise ValueError(f"--fps: expected OUT to be a .gif with it, got {command.out!r}; leave it out")
    return target


def _check_pixel(pixel: tuple[int, int], cameras: Cameras) -> None:
    """Raise if the pixel of --contributors lies outside of the image."""
    if pixel[0] >= cameras.width or pixel[1] >= cameras.height:
        raise ValueError(
            f"--contributors: expected a pixel of {cameras.width} x {cameras.height}, counted from 0,0 at the top left,"
            f" got {pixel[0]},{pixel[1]}"
        )


def _lines(command: Render, target: Target, done: _Done) -> list[str]:
    """Return lines that say what was written."""
    count = target.count
    size = f"{done.cameras.width} x {done.cameras.height}"
    took = f"{len(done.source.gaussians):,} Gaussians, {done.seconds / count:.2f} s"
    if count == 1:
        lines = [f"{target.files[0]}: {size}, {took}"]
    else:
        where = f"{target.files[0]} to {target.files[-1].name}" if target.kind == "folder" else str(target.path)
        lines = [f"{where}: {count} frames of {size}, {took} a frame"]
    if command.picture.depth:
        more = " and on" if target.kind == "folder" and count > 1 else ""
        text = "nothing is seen"
        if done.depth_range:
            text = "violet {:.4g} to yellow {:.4g}, black where empty".format(*done.depth_range)
        lines.append(f"{target.depth_files[0]}{more}: {text}")
    return lines


def _table(command: Render, found: PixelContributors) -> list[Any]:
    """Return a table of the contributors to a pixel, front to back; those of largest weight if there are too many."""
    x, y = command.contributors or (0, 0)
    total = float(found.weights.sum(dtype=np.float64))
    if len(found) == 0:
        return [f" No Gaussian contributes to pixel {x},{y}."]
    shown = np.sort(np.argsort(-found.weights, kind="stable")[:_ROWS])
    rows = [
        (
            str(i + 1),
            str(found.gaussian_ids[i]),
            f"{found.alphas[i]:.4f}",
            f"{found.weights[i]:.5f}",
            f"{found.depths[i]:.4f}",
        )
        for i in shown
    ]
    parts: list[Any] = [
        facts(f"Contributors to pixel {x},{y}, front to back", rows, ("rank", "Gaussian", "alpha", "weight", "depth"))
    ]
    if len(found) > len(shown):
        rest = total - float(found.weights[shown].sum(dtype=np.float64))
        parts.append(
            f" These are the {_ROWS} that weigh most; the other {len(found) - _ROWS:,} weigh {rest:.5f} together."
        )
    return [*parts, f" Sum of the weights of all {len(found):,}: {total:.5f}"]


def _document(command: Render, target: Target | None, done: _Done) -> dict[str, Any]:
    """Return the result as JSON."""
    cameras = done.cameras
    found = done.found
    files = target.files if target else []
    document: dict[str, Any] = {
        "format": "gsvis-rendering",
        "version": 1,
        "scene": done.source.name,
        "lod": done.source.lod,
        "gaussians": len(done.source.gaussians),
        "backend": done.backend,
        "width": cameras.width,
        "height": cameras.height,
        "seconds": round(done.seconds, 3),
        "files": [str(path) for path in files],
        "depth": None,
        "cameras": describe_cameras(cameras),
        "space": None if done.space is None else space_document(done.space),
        "remarks": [each.strip() for each in done.remarks],
        "contributors": None,
    }
    if target and command.picture.depth:
        near, far = done.depth_range or (None, None)
        document["depth"] = {"files": [str(path) for path in target.depth_files], "near": near, "far": far}
    if found is not None:
        document["contributors"] = {
            "pixel": command.contributors,
            "sum_of_weights": float(found.weights.sum(dtype=np.float64)),
            "gaussian_ids": found.gaussian_ids.tolist(),
            "alphas": found.alphas.tolist(),
            "weights": found.weights.tolist(),
            "depths": found.depths.tolist(),
        }
    return document


def check_views(command: Render) -> HeadPath | None:
    """Return the walk of --path; raise if arguments about cameras contradict each other.

    Raises:
        ValueError: If they do; the message names them.
    """
    given = {name: value for name, value in values_of(command).items() if value is not None}
    ways = [way for way in ("cameras", "orbit", "eye", "view") if way in given]
    if len(ways) > 1:
        raise ValueError(f"--{ways[1]}: expected none with --{ways[0]}, got both; leave one out")
    way = ways[0] if ways else ""
    needs = {"index": ("cameras",), "radius": ("orbit",), "elevation": ("orbit",), "target": ("orbit", "eye")}
    for name, wanted in needs.items():
        if name in given and way not in wanted:
            raise ValueError(f"--{name}: expected {' or '.join('--' + each for each in wanted)} with it, got it alone")
    if way == "cameras":
        refuse(command, ["fov", "up"], "with --cameras, whose file states it")
    if way == "view":
        refuse(command, ["fov"], "with --view, which states it")
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
    cameras = load_cameras_at(command.where.cameras, command.picture.width, command.picture.height)
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
    if command.cast.view is not None:
        camera = parse_link(command.cast.view).camera(up, **size)
        return camera, None, [*remarks, *check_buried(g, camera.viewpoints, "--view")]
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
