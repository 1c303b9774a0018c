"""Find the photos of a reconstruction, and check their format and size.

Only headers are read here. Images are used as stored: an EXIF orientation is ignored, as in COLMAP, so that pixels are
those of the model.
"""

from __future__ import annotations

import errno
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

from gsvis.errors import FormatError
from gsvis.files.limits import Budget, open_regular, safe_name
from gsvis.io.colmap import find_colmap, read_colmap
from gsvis.io.folders import cameras_remedy
from gsvis.io.transforms_json import read_transforms
from gsvis.io.views import Views, read_json

__all__ = ["FAULTS", "MODES", "find_files", "find_views", "join_names", "quiet_pillow", "read_sizes", "whole_factor"]

Size = tuple[int, int]

MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX")
"""Modes of Pillow that can be read: up to 8 bits per channel, gray or RGB, with or without alpha."""

FAULTS = (OSError, SyntaxError, ValueError, EOFError, LookupError, ArithmeticError, Image.DecompressionBombError)
"""Errors that Pillow raises for a damaged file."""

_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp")
_KNOWN = "a COLMAP model (cameras and images, .bin or .txt) or a transforms.json"
_MOST_SHRUNK = 64
_SHOWN = 5


@contextmanager
def quiet_pillow() -> Iterator[None]:
    """Silence Pillow's warnings about unusual images, for the whole process; invalid ones are rejected here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def find_views(path: Path, images: Path | None) -> tuple[Views, list[Path]]:
    """Return the posed images of a folder of photos, and the folders that may hold its images.

    Args:
        path: The folder of a COLMAP model or one above it, a `transforms.json`, or the folder with one.
        images: Folder of the photos, as given or inside `path`; None looks in the usual places.

    Raises:
        FileNotFoundError: If there is nothing at `path`, or no folder `images`.
        FormatError: If there is no model, or it is malformed or distorted.
    """
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no file or folder here", str(path))
    given = [] if images is None else [folder for folder in (images, path / images) if folder.is_dir()][:1]
    if images is not None and not given:
        raise FileNotFoundError(errno.ENOENT, "no folder of images here", str(images))
    root = path if path.is_dir() else path.parent
    model = find_colmap(root) if path.is_dir() or path.suffix in (".bin", ".txt") else None
    if model is not None:
        above = dict.fromkeys((root, model, model.parent, model.parent.parent))
        return read_colmap(model), given or [place for folder in above for place in (folder / "images", folder)]
    file = path / "transforms.json" if path.is_dir() else path
    if not file.is_file() or file.suffix.lower() != ".json":
        got = "a folder without either" if path.is_dir() else f"the file {path.name}"
        remedy = cameras_remedy(path) if path.is_dir() else ""
        raise FormatError(path, "", _KNOWN, got, remedy or "make one with COLMAP, and name its folder")
    content = read_json(file)
    if not isinstance(content, dict):
        raise FormatError(file, "", "a transforms.json", f"JSON of {type(content).__name__}")
    folders = given or [root, root / "images"]
    return read_transforms(file, content, _size_of_first(file, content, folders)), folders


def _size_of_first(file: Path, content: dict[str, Any], folders: Sequence[Path]) -> Size | None:
    """Return the size of the first image, for a `transforms.json` without sizes; None if the image is missing."""
    frames = content.get("frames")
    first = frames[0] if isinstance(frames, list) and frames else None
    if not isinstance(first, dict) or {"w", "h"} <= {*content, *first}:
        return None
    name = first.get("file_path")
    if not isinstance(name, str):
        return None
    found = [place for folder in folders if (place := _place(file, folder, name.removeprefix("./"))) is not None]
    return read_sizes(found[:1])[0] if found else None


def find_files(views: Views, folders: Sequence[Path]) -> list[Path]:
    """Return the file of each view, all from the folder that holds most of them.

    Raises:
        FormatError: If one is missing; the message names up to five.
    """
    held = [[_place(views.path, folder, name) for name in views.names] for folder in folders]
    counts = [sum(place is not None for place in places) for places in held]
    if not counts or max(counts) == 0:
        looked = ", ".join(dict.fromkeys(str(folder) for folder in folders))
        text = f"none of them in {looked}"
        raise FormatError(
            views.path, "", f"the {len(views.names):,} images it names", text, "name the folder with --images"
        )
    best = counts.index(max(counts))
    missing = [name for name, place in zip(views.names, held[best], strict=True) if place is None]
    if missing:
        text = f"{len(missing):,} of {len(views.names):,} missing: {join_names(missing)}"
        raise FormatError(folders[best], "", f"the images that {Path(views.path).name} names", text)
    return [place for place in held[best] if place is not None]


def _place(file: Any, folder: Path, name: str) -> Path | None:
    """Return the image of that name in a folder; the folder or the suffix in the name may differ."""
    inner = name if ".." not in name and not name.startswith("/") else Path(name).name
    path = folder / safe_name(file, f"image {name!r}", inner)
    for place in (path, folder / path.name):
        if place.is_file():
            return place
        if place.suffix.lower() not in (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"):
            for suffix in _SUFFIXES:
                if (longer := place.with_name(place.name + suffix)).is_file():
                    return longer
    return None


def read_sizes(files: Sequence[Path]) -> list[Size]:
    """Return the width and height of each image, from its header.

    Raises:
        FormatError: If a file is not an image, has an unsupported mode, or unpacks to far more than its size.
    """
    sizes = []
    for path in files:
        try:
            with quiet_pillow(), open_regular(path) as file, Image.open(file) as image:
                mode = image.mode
                size = image.size
                held = os.fstat(file.fileno()).st_size
        except FAULTS as error:
            text = "something else" if isinstance(error, UnidentifiedImageError) else str(error) or type(error).__name__
            raise FormatError(path, "", "an image (JPEG, PNG, WebP, ...)", text, "is it damaged?") from error
        if mode not in MODES:
            remedy = "convert the images to 8-bit RGB"
            raise FormatError(path, "", "gray or RGB with 8 bits a channel", f"Pillow's mode {mode}", remedy)
        Budget(path, held).claim(4 * size[0] * size[1], f"an image of {size[0]} x {size[1]}")
        sizes.append(size)
    return sizes


def whole_factor(views: Views, sizes: Sequence[Size]) -> int:
    """Return the factor by which all images are smaller than in the model: usually 1, 4 for `images_4`.

    Args:
        views: Posed images of the model.
        sizes: (width, height) of each image.

    Raises:
        FormatError: If the sizes differ from the model's by no single whole factor; the message names up to five.
    """
    pairs = list(zip(views.sizes, sizes, strict=True))
    factors = {max(1, round(stated[0] / have[0])) for stated, have in pairs}
    best = max(sorted(factors), key=lambda k: sum(_fits(stated, have, k) for stated, have in pairs))
    wrong = [i for i, (stated, have) in enumerate(pairs) if not _fits(stated, have, best)]
    if not wrong:
        return best
    (width, height), have = pairs[wrong[0]]
    expected = f"{width} x {height} as in the model, or all images smaller by the same whole factor"
    got = f"{have[0]} x {have[1]}" + (f" in {len(wrong):,} of {len(pairs):,}" if len(wrong) > 1 else "")
    remedy = "use the images of the model, undistorted with it, or evenly shrunk"
    if have == (height, width):
        remedy = "the model was made from rotated images: apply their EXIF orientation to the pixels"
    raise FormatError(views.path, f"images {join_names([views.names[i] for i in wrong])}", expected, got, remedy)


def _fits(stated: Size, have: Size, factor: int) -> bool:
    """Return whether an image has the model's size divided by the factor, rounded up or down."""
    if not 1 <= factor <= _MOST_SHRUNK:
        return False
    return all(t == h if factor == 1 else abs(t / factor - h) < 1.0 for t, h in zip(stated, have, strict=True))


def join_names(names: Sequence[str]) -> str:
    """Return the first five names, and the number of the others."""
    more = f" and {len(names) - _SHOWN:,} more" if len(names) > _SHOWN else ""
    return ", ".join(map(repr, names[:_SHOWN])) + more
