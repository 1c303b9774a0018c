"""Load photos with a reconstruction for training: check all files first, then read and shrink them.

The result is `PosedImages` sorted by name, 8 bits per channel, sRGB as stored. Intrinsics fit the final size of the
images, with pixel centers at +0.5. Poses, and the points beside them, stay in the frame of the model.
"""

from __future__ import annotations

import io
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsvis import _check
from gsvis.errors import FormatError, SceneError
from gsvis.files.limits import read_whole
from gsvis.io.points import find_points, load_points
from gsvis.io.views import Views
from gsvis.progress import Progress, silent
from gsvis.scene.cameras import Cameras, intrinsics
from gsvis.scene.points import PointCloud
from gsvis.train._photo_files import FAULTS, find_files, find_views, join_names, quiet_pillow, read_sizes, whole_factor
from gsvis.train.images import PosedImages

__all__ = ["FEWEST_VIEWS", "Photos", "load_photo_cameras", "load_photos", "photo_bytes"]

Size = tuple[int, int]

FEWEST_VIEWS = 8
"""Least number of photos for a scene."""

_LEAST_SIDE = 16  # pixels; SSIM needs 11
_THREADS = 2
_MEMORY_SHARE = 0.5  # largest share of memory for images


@dataclass(frozen=True, eq=False, repr=False)
class Photos:
    """Photos and the points of their reconstruction.

    Attributes:
        views: Images and cameras, sorted by name.
        points: Points of the reconstruction; None if there are none.
        remarks: Changes to the images that the user may not expect, one sentence each.
    """

    views: PosedImages
    points: PointCloud | None = None
    remarks: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images in the model."""
        return self.views.cameras.names

    def __repr__(self) -> str:
        points = "no points" if self.points is None else f"{len(self.points):,} points"
        return f"Photos({self.views!r}, {points})"


def load_photo_cameras(folder: str | PathLike[str]) -> Cameras:
    """Return cameras at the poses of the photos of a folder, with one nominal size; reads no photo.

    Sizes of photos may differ, so all cameras are 640 x 480 with a field of view of 60 degrees.

    Args:
        folder: As in `load_photos`.

    Raises:
        FileNotFoundError: If there is no such folder.
        FormatError: If there is no model, or it is malformed or distorted.
    """
    poses = np.reshape(find_views(_check.path("folder", folder), None)[0].viewmats, (-1, 4, 4))
    return Cameras(poses, np.tile(intrinsics(640, 480, 60.0), (len(poses), 1, 1)), 640, 480)


def photo_bytes(folder: str | PathLike[str], size: Size | None = None) -> int:
    """Return the bytes of the photos of a folder in memory, from their headers; decodes none.

    Args:
        folder: As in `load_photos`.
        size: (width, height) in pixels to shrink them to; None keeps their size.

    Raises:
        The errors of `load_photos`, except those that only decoding finds.
    """
    _, files, _, (width, height) = _find(_check.path("folder", folder), None, None, size)
    return 3 * len(files) * width * height


def load_photos(
    folder: str | PathLike[str],
    *,
    images: str | PathLike[str] | None = None,
    downscale: float | None = None,
    size: Size | None = None,
    progress: Progress = silent,
) -> Photos:
    """Read photos and the model that posed them.

    All headers are checked before the first image is decoded. Images are used as stored: an EXIF orientation is
    ignored, as in COLMAP. Transparency is blended over black. Pillow's Lanczos filter, which weights all pixels under
    it, shrinks the images.

    Args:
        folder: A COLMAP model (its folder, or one above it), a `transforms.json`, or the folder with one.
        images: Folder of the photos, as given or inside `folder`; None looks in `images` beside the model. If all
            are smaller than in the model by one whole factor, as in `images_4`, intrinsics are rescaled.
        downscale: Factor to shrink the images by, at least 1.
        size: (width, height) in pixels to shrink them to instead; required if their sizes differ.
        progress: Called for every image; stage "photos".

    Returns:
        The photos, sorted by name.

    Raises:
        FileNotFoundError: If there is no such folder.
        FormatError: If there is no model, it is malformed or distorted, or images are missing, unreadable,
            truncated or of a size that does not fit the model.
        SceneError: If there are fewer than 8 of them.
        ValueError: If a size or factor is out of range.

    Examples:
        >>> load_photos("../shared/data/photos/bonsai", size=(400, 266))  # doctest: +SKIP
        Photos(PosedImages(292 of 400 x 266), 51,939 points)
    """
    path = _check.path("folder", folder)
    views, files, remarks, (width, height) = _find(path, images, downscale, size)
    _check_memory(len(files), width, height)
    cameras = views.cameras((width, height))
    found = find_points(path)
    points = None if found is None else load_points(found)
    order = sorted(range(len(files)), key=views.names.__getitem__)
    pixels, transparent = _read([files[i] for i in order], (width, height), progress)
    if transparent:
        remarks.append(f"Transparency was blended over black in {transparent:,} of {len(files):,} images.")
    return Photos(PosedImages(cameras, pixels), points if points is not None and len(points) else None, tuple(remarks))


def _find(
    path: Path, images: str | PathLike[str] | None, downscale: float | None, size: Size | None
) -> tuple[Views, list[Path], list[str], Size]:
    """Return the views, the file of each, remarks, and the size to shrink to; arguments are those of `load_photos`."""
    _check_target(downscale, size)
    views, folders = find_views(path, None if images is None else _check.path("images", images))
    if len(views.names) < FEWEST_VIEWS:
        raise SceneError(
            f"{views.path}: expected at least {FEWEST_VIEWS} posed images, got {len(views.names)};"
            " add photographs, or check why COLMAP dropped them"
        )
    files = find_files(views, folders)
    sizes = read_sizes(files)
    factor = whole_factor(views, sizes)
    remarks: list[str] = []
    if factor > 1:
        remarks.append(f"The images are 1/{factor} of the size in the model; its intrinsics were rescaled to them.")
    views = _resize(views, sizes)
    return views, files, remarks, _target(views, downscale, size)


def _check_target(downscale: float | None, size: Size | None) -> None:
    """Raise unless at most one of size and factor is given, and it is in range."""
    if size is not None:
        if downscale is not None:
            raise ValueError("size / downscale: expected one of them, got both; omit one")
        if not isinstance(size, tuple | list) or len(size) != 2:
            raise ValueError(f"size: expected (width, height), got {size!r}")
        for name, side in zip(("width", "height"), size, strict=True):
            _check.positive_int(f"size: {name}", side, at_least=_LEAST_SIDE)
    if downscale is not None and not 1.0 <= downscale < np.inf:
        raise ValueError(f"downscale: expected a factor of at least 1, got {downscale!r}")


def _resize(views: Views, sizes: list[Size]) -> Views:
    """Return the same views with intrinsics for images of these sizes; pixel centers lie at +0.5, so they scale."""
    ratios = [
        np.array([have[0] / stated[0], have[1] / stated[1], 1.0])
        for stated, have in zip(views.sizes, sizes, strict=True)
    ]
    ks = [k * ratio[:, None] for k, ratio in zip(views.Ks, ratios, strict=True)]
    return Views(views.path, views.names, views.viewmats, ks, sizes)


def _target(views: Views, downscale: float | None, size: Size | None) -> Size:
    """Return the size to shrink to."""
    found = sorted(set(views.sizes))
    least = min(width for width, _ in found), min(height for _, height in found)
    if size is None:
        if len(found) > 1:
            got = ", ".join(f"{w} x {h}" for w, h in found[:4]) + (", ..." if len(found) > 4 else "")
            remedy = f"give one to shrink all to, such as --width {least[0]} --height {least[1]}"
            raise FormatError(views.path, "", "images of one size", f"{len(found)} sizes: {got}", remedy)
        size = max(1, round(least[0] / (downscale or 1.0))), max(1, round(least[1] / (downscale or 1.0)))
        if min(size) < _LEAST_SIDE:
            got = f"{size[0]} x {size[1]}"
            if min(least) < _LEAST_SIDE:
                raise FormatError(views.path, "", f"images of at least {_LEAST_SIDE} pixels a side", got)
            raise ValueError(f"downscale: expected images of at least {_LEAST_SIDE} pixels a side, got {got}")
    if size[0] > least[0] or size[1] > least[1]:
        name = next(
            n for n, have in zip(views.names, views.sizes, strict=True) if size[0] > have[0] or size[1] > have[1]
        )
        got = f"{size[0]} x {size[1]}, which is more than {name!r} has"
        raise ValueError(f"size: expected at most {least[0]} x {least[1]}, got {got}")
    return size[0], size[1]


def _check_memory(count: int, width: int, height: int) -> None:
    """Raise if the images would not fit into memory beside everything else."""
    needed = 3 * count * width * height
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not on this system
        return
    if needed > _MEMORY_SHARE * memory:
        raise ValueError(
            f"size: expected images that fit into half of the memory ({memory / 1e9:.1f} GB), got {count:,} of"
            f" {width} x {height}, {needed / 1e9:.1f} GB; shrink them with --downscale, or --width and --height"
        )


def _read(files: list[Path], size: Size, progress: Progress) -> tuple[NDArray[np.uint8], int]:
    """Return (C, H, W, 3) uint8 images, and the number of images with transparency."""
    pixels = np.empty((len(files), size[1], size[0], 3), np.uint8)

    def read(index: int) -> tuple[bool, FormatError | None]:
        """Read one image into its row; return whether it has transparency, and its error."""
        try:
            pixels[index], transparent = _shrunk(files[index], size)
        except FormatError as error:
            return False, error
        return transparent, None

    progress("photos", 0, len(files))
    count = 0
    broken = []
    with quiet_pillow(), ThreadPoolExecutor(_THREADS) as pool:
        try:
            for done, (transparent, error) in enumerate(pool.map(read, range(len(files))), 1):
                count += transparent
                if error is not None:
                    broken.append(error)
                progress("photos", done, len(files))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    if len(broken) > 1:
        names = join_names([Path(error.path).name for error in broken])
        got = f"{len(broken):,} that cannot be read: {names}"
        raise FormatError(files[0].parent, "", "complete images", got, broken[0].got)
    if broken:
        raise broken[0]
    return pixels, count


def _shrunk(path: Path, size: Size) -> tuple[NDArray[np.uint8], bool]:
    """Return one image (H, W, 3) at a size, and whether it had transparency."""
    transparent = False
    try:
        # Decode from memory: for a file, Pillow would allocate as much as a chunk claims to hold.
        with io.BytesIO(read_whole(path)) as file, Image.open(file) as image:
            if image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info:
                with_alpha = image.convert("RGBA")
                alpha = with_alpha.getchannel("A")
                transparent = alpha.getextrema()[0] < 255
                rgb = Image.new("RGB", image.size)
                rgb.paste(with_alpha.convert("RGB"), mask=alpha)
            else:
                rgb = image.convert("RGB")
    except FAULTS as error:
        got = str(error) or type(error).__name__
        raise FormatError(path, "", "a complete image", got, "is it damaged? copy it again") from error
    if rgb.size != size:
        rgb = rgb.resize(size, Image.Resampling.LANCZOS)
    return np.asarray(rgb), transparent
