"""Read cameras of common formats: COLMAP models, `transforms.json`, INRIA's `cameras.json`, a report of gsvis.

The content decides the format; each format has its own module. Results are in the frame of the file, OpenCV axes,
camera from world.
"""

from __future__ import annotations

import errno
from os import PathLike
from pathlib import Path

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.limits import open_regular
from gsvis.io.colmap import find_colmap, read_colmap
from gsvis.io.folders import cameras_remedy
from gsvis.io.foreign_cameras import foreign_cameras, foreign_cameras_in, foreign_json
from gsvis.io.inria_cameras import read_inria_cameras
from gsvis.io.report_cameras import holds_own_cameras, read_own_cameras
from gsvis.io.transforms_json import read_transforms
from gsvis.io.views import Views, read_json
from gsvis.scene.cameras import Cameras

__all__ = ["holds_repeated_views", "load_cameras", "load_cameras_at"]

_KNOWN = "a COLMAP model (cameras and images, .bin or .txt), transforms.json, cameras.json or report.json"


def load_cameras(path: str | PathLike[str], *, size: tuple[int, int] | None = None) -> Cameras:
    """Read the posed cameras of a reconstruction.

    Args:
        path: A COLMAP model: its folder, one above it (`sparse/0`, `sparse` and `0` are tried), or one of its files.
            Or a `transforms.json` of nerfstudio or instant-ngp, an INRIA `cameras.json`, or a folder with one of them.
            Or, to repeat views, the `report.json` of `gsvis analyze` or the output of `gsvis render --json`.
        size: (width, height) in pixels to rescale all cameras to; needed when a file mixes sizes or states none.

    Returns:
        The cameras, sorted by image name.

    Raises:
        FileNotFoundError: If there is nothing at `path`.
        FormatError: If the file is none of these, is truncated or malformed, or has distorted cameras or mixed sizes.
        ValueError: If `size` is not two positive integers.
    """
    if size is not None:
        if not isinstance(size, tuple | list) or len(size) != 2:
            raise ValueError(f"size: expected (width, height), got {size!r}")
        size = (_check.positive_int("size[0]", size[0]), _check.positive_int("size[1]", size[1]))
    return _views(_check.path("path", path), size).cameras(size)


def load_cameras_at(
    path: str | PathLike[str], width: int | None, height: int | None, *, at_most: int | None = None
) -> Cameras:
    """Read at least one posed camera, at a size of which one side may follow from the other.

    Args:
        path: As in `load_cameras`.
        width: Pixels; None follows from `height` and the aspect of the file.
        height: Pixels; None follows from the width and the aspect of the file.
        at_most: Largest width in pixels if neither side is given; None keeps the size of the file.

    Raises:
        FileNotFoundError: If there is nothing at `path`.
        FormatError: If the file cannot be read.
        ValueError: If the file holds no camera.
    """
    both = (width, height) if width and height else None
    cameras = load_cameras(path, size=both)
    if len(cameras) == 0:
        raise ValueError(f"{path}: expected at least one camera, got none")
    if both is None:
        aspect = cameras.width / cameras.height
        across = width or (round(height * aspect) if height else min(at_most or cameras.width, cameras.width))
        if across != cameras.width or height:
            cameras = cameras.resize(max(1, across), max(1, height or round(across / aspect)))
    return cameras


def holds_repeated_views(path: str | PathLike[str]) -> bool:
    """Return whether gsvis wrote the cameras at a path, so that they are not captured views.

    Args:
        path: As in `load_cameras`.

    Raises:
        FileNotFoundError: If there is nothing at `path`.
        FormatError: If there are no cameras.
    """
    found = _file_of(_check.path("path", path))
    return not found.is_dir() and holds_own_cameras(read_json(found))


def _file_of(path: Path) -> Path:
    """Return the JSON file that a path refers to, or the folder of a COLMAP model."""
    if path.is_dir():
        folder = find_colmap(path)
        if folder is not None:
            return folder
        for name in ("transforms.json", "cameras.json"):
            if (path / name).is_file():
                return _file_of(path / name)
        near = cameras_remedy(path)
        kind, remedy = (None if near else foreign_cameras_in(path)) or ("a folder without any of them", near)
        raise FormatError(path, "", _KNOWN, kind, remedy)
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no camera file or folder here", str(path))
    with open_regular(path) as stream:
        start = stream.read(2048).removeprefix(b"\xef\xbb\xbf").lstrip()
    other = foreign_cameras(path, start)
    if other is not None:
        raise FormatError(path, "", _KNOWN, *other)
    if path.suffix in (".bin", ".txt"):
        return path.parent
    if path.suffix.lower() != ".json" and start[:1] not in (b"{", b"["):
        raise FormatError(path, "", _KNOWN, f"a file beginning {start[:8]!r} named {path.name!r}")
    return path


def _views(path: Path, size: tuple[int, int] | None) -> Views:
    """Return the posed images at a path."""
    path = _file_of(path)
    if path.is_dir():
        return read_colmap(path)
    content = read_json(path)
    other = foreign_json(content)
    if other is not None:
        raise FormatError(path, "", _KNOWN, *other)
    if holds_own_cameras(content):
        return read_own_cameras(path, content)
    if isinstance(content, dict):
        return read_transforms(path, content, size)
    if isinstance(content, list):
        return read_inria_cameras(path, content)
    raise FormatError(path, "", _KNOWN, f"JSON of {type(content).__name__}")
