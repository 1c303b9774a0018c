"""`gsvis render`: render cameras as pictures, depth or an animation, or list the contributors to a pixel."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsvis._check import plain
from gsvis._extras import has, require
from gsvis.cli.arguments import Render
from gsvis.cli.shown import check_shown, load_shown
from gsvis.cli.source import Source, framed_cameras, open_source
from gsvis.cli.terminal import Status, facts, print_json, show
from gsvis.cli.views import camera_count, check_buried, check_views, given_cameras, place_cameras
from gsvis.cli.where import space_document
from gsvis.errors import BackendError
from gsvis.io.report_cameras import describe_cameras
from gsvis.render import PixelContributors, contributors, rasterize
from gsvis.render.cuda import is_available
from gsvis.report.frames import Frame, Target, target_of, write_frames
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath

__all__ = ["run_render"]

_FPS = 12.0
_ROWS = 40  # most rows of the table of contributors


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
    backend = _backend(command.backend)
    given = given_cameras(command)
    target = _target(command, camera_count(command, given))
    older = target.older() if target else 0
    with Status() as status:
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
    with status.stage("kernels"):
        _warm_up(backend)
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
    scene: Any = g
    if backend == "cuda":  # once, not for every frame
        from gsvis.render import GaussianTensors

        scene = GaussianTensors.from_gaussians(g, device="cuda")
    status("rendering", 0, len(cameras))
    for i in range(len(cameras)):
        seen = rasterize(
            scene,
            cameras[i],
            backend=backend,
            background=command.picture.background,
            sh_degree=command.picture.sh_degree,
            antialiased=command.picture.antialiased or g.facts.antialiased,
        )
        yield Frame(*(plain(part[0]) for part in (seen.images, seen.alphas, seen.depths)))
        status("rendering", i + 1, len(cameras))


def _backend(asked: str) -> str:
    """Return the backend to use: the one asked for; for "auto", cuda if it can run here, else cpu.

    Raises:
        BackendError: If cuda is asked for and cannot run here.
    """
    if asked == "auto" and not has("gsplat"):  # is_available imports torch, which takes longer than a render
        return "cpu"
    missing = is_available() if asked in ("auto", "cuda") else ""
    if asked == "cuda" and missing:
        raise BackendError(missing)
    return ("cpu" if missing else "cuda") if asked == "auto" else asked


def _warm_up(backend: str) -> None:
    """Compile or load the kernels on a scene of one Gaussian, so that progress shows this time as a stage."""
    if backend == "cpu":
        one = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], np.zeros((1, 1, 3)))
        rasterize(one, Cameras.look_at([[4.0, 0.0, 0.0]], (0.0, 0.0, 0.0), width=1, height=1), backend="cpu")


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
