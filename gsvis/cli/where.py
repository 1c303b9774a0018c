"""Where eyes may be, by the options of a command: check them, read their files, and find the place."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.cli.options import Framed, Placed, Shown, Where, config_of, naming, refuse
from gsvis.cli.targets import check_exists, check_show
from gsvis.errors import ArgumentError, FormatError, SceneError
from gsvis.io.cameras import load_cameras_at
from gsvis.io.frames import fit_cameras
from gsvis.io.poses import load_path
from gsvis.scene.axes import AXES, axis_vector
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.place import Place, PlaceConfig, remark_on_flyaways
from gsvis.scene.place import find_place as find_place_in
from gsvis.scene.source import Source

__all__ = [
    "check_cameras",
    "check_where",
    "evidence_cameras",
    "find_place",
    "flyaway_remarks",
    "framed_cameras",
    "kind_row",
    "parse_up",
    "space_document",
    "suspect_views",
]

_NOMINAL = (640, 480)  # pixels of cameras whose sizes differ
_DECIDED_BY = "--kind, --up, --cameras, --box, --around or --path"


def check_where(where: Where, other: str = "") -> HeadPath | None:
    """Check the options before work begins; return the walk of --path.

    Args:
        where: The options.
        other: An option that was given and says itself where eyes are, such as "--cameras".

    Raises:
        ValueError: If they contradict each other.
        FormatError: If the walk cannot be read.
    """
    if isinstance(where, Placed):
        parse_up(where.up)
    if isinstance(where, Shown):
        check_show(where.show)
    for name in ("margin", "retarget"):
        if getattr(where, name) and where.path is None:
            raise ValueError(f"--{name}: expected --path with it, got none; add it or leave this out")
    names = where.given
    if names and other:
        raise ValueError(f"--{names[0]}: expected none with {other}, which says where eyes are; leave one out")
    if where.kind not in (None, "auto") and (other or names):
        refuse(where, ["kind"], f"with {other or f'--{names[0]}'}, which says where eyes are")
    refuse(where, names[1:], f"with --{names[0] if names else ''}")
    check_cameras(where)
    return None if where.path is None else load_path(where.path)


def check_cameras(where: Framed) -> None:
    """Check --cameras and --cameras-frame before work begins.

    Raises:
        ValueError: If a frame is given without cameras.
        FileNotFoundError: If there is no file of cameras.
    """
    if where.cameras is None and where.cameras_frame != "auto":
        got = where.cameras_frame
        raise ValueError(f"--cameras-frame: expected --cameras with it, got {got} alone; leave it out")
    check_exists(where.cameras)


def parse_up(axis: str | None) -> NDArray[np.float64] | None:
    """Return the (3,) unit up axis of --up; None without --up.

    Args:
        axis: The name of an axis, such as "+z", or three numbers of any length but zero, such as "0.1 -0.98 0.17".

    Raises:
        ValueError: If the value is neither.
    """
    if axis is None:
        return None
    text = axis.strip()
    if text in AXES:
        return axis_vector(text)
    try:
        vector = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        vector = np.zeros(0)
    largest = float(np.abs(vector).max()) if vector.shape == (3,) else 0.0
    if not (np.isfinite(largest) and largest > 0.0):
        known = ", ".join(AXES)
        raise ValueError(f"--up: expected one of {known}, or three numbers such as '0.1 -0.98 0.17', got {text!r}")
    return np.asarray(vector / largest / np.linalg.norm(vector / largest))


def find_place(source: Source, where: Where, walk: HeadPath | None = None, cameras: Cameras | None = None) -> Place:
    """Find where eyes may be, by the options and the scene; see `gsvis.scene.place`.

    Args:
        source: The scene.
        where: What the user said. Without --up it is the known one, else that of cameras, else the likely one.
        walk: The walk of --path.
        cameras: Cameras that took photographs of the scene; those of --cameras by default.

    Raises:
        SceneError: If eyes given by hand lie inside something solid.
        ValueError: If the walk lies elsewhere.
    """
    framed: list[str] = []
    if cameras is None and (cameras := evidence_cameras(where)) is not None:
        cameras, framed = framed_cameras(source, cameras, where)
    config = config_of(PlaceConfig, where, walk_name=where.path, cameras_name=where.cameras, decided_by=_DECIDED_BY)
    up = parse_up(where.up) if isinstance(where, Placed) else None
    try:
        place = find_place_in(source, config, up=up, walk=walk, cameras=cameras)
    except ArgumentError as error:
        raise error.renamed(f"--path {where.path}", error.remedy and f"--{error.remedy}") from None
    except SceneError as error:
        named = error.problem.startswith(("box: ", "around: "))
        raise SceneError(f"--{error.problem}", error.remedy) if named else error from None
    return replace(place, remarks=[*framed, *(f" {each}" for each in place.remarks)])


def evidence_cameras(where: Framed) -> Cameras | None:
    """Return the cameras of --cameras; None without.

    Raises:
        FormatError: If the file cannot be read.
        FileNotFoundError: If there is no file.
        ValueError: If it holds no camera.
    """
    if where.cameras is None:
        return None
    try:
        return load_cameras_at(where.cameras, None, None)
    except FormatError:
        return load_cameras_at(where.cameras, *_NOMINAL)  # of several sizes, which do not matter; else it fails again


def framed_cameras(source: Source, cameras: Cameras, where: Framed) -> tuple[Cameras, list[str]]:
    """Return cameras of a file in the frame of a scene, and remarks for the user: moved, or most see nothing.

    Every command that takes cameras calls this once the scene is read.

    Args:
        source: The scene.
        cameras: Of `load_cameras_at`.
        where: The file that they are of, and their frame.

    Raises:
        ValueError: If they are to be moved, and no file says how.
    """
    with naming(frame="--cameras-frame"):
        found = fit_cameras(source.gaussians, cameras, where.cameras, source.path, frame=where.cameras_frame)
    return found.cameras, [f" {each}" for each in found.remarks]


def flyaway_remarks(g: Gaussians) -> list[str]:
    """Return a remark on Gaussians that lie too far outside to count, if there are some."""
    return [f" {each}" for each in remark_on_flyaways(g)]


def suspect_views(g: Gaussians, space: NavigableSpace) -> list[str]:
    """Return a remark for each way in which what eyes see is implausible; empty if nothing is.

    Args:
        g: The scene.
        space: Where eyes may be; a few views are drawn in it.
    """
    from gsvis.render.implausible import find_implausible

    try:
        found = find_implausible(g, space)
    except SceneError as error:
        return [f" What eyes see is implausible: {error}."]
    return [f" Implausible: {each}; say where eyes belong with --box, --around or --path." for each in found]


def kind_row(space: NavigableSpace) -> tuple[str, str]:
    """Return a row of a table: what the scene is, and why."""
    return "taken for", str(space.kind)


def space_document(space: NavigableSpace) -> dict[str, Any]:
    """Return where eyes may be, for JSON."""
    return {
        "rule": space.rule,
        "voxel_size": space.voxel_size,
        "volume": space.volume,
        "kind": space.kind.as_dict(),
    }
