"""Targets: what training reads: photographs with their model, and the subsets that were chosen for levels."""

from __future__ import annotations

import io
import struct
import zlib
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsvis.errors import FormatError, SceneError
from gsvis.progress import silent
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from gsvis.train._photo_files import FAULTS, quiet_pillow
from gsvis.train.images import PosedImages, render_views
from gsvis.train.levels import LevelsConfig, _subsets
from gsvis.train.photos import load_photos
from tests.fuzz.cameras import files_in
from tests.fuzz.mutators import KINDS, change_bytes
from tests.fuzz.targets import Case, Target
from tests.train.photo_files import cloud, write_photos, write_transforms

__all__ = ["TARGETS"]

PHOTOS = 8
_PNG = b"\x89PNG\r\n\x1a\n"
_MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "I", "CMYK", "F")
_KEPT_BY = {"PNG": ("1", "L", "LA", "P", "RGB", "RGBA", "I"), "JPEG": ("1", "L", "RGB", "CMYK"), "TIFF": _MODES}
_KEPT_BY |= {"GIF": ("1", "L", "P"), "BMP": ("1", "L", "P", "RGB"), "WEBP": ("RGB", "RGBA"), "PPM": ("1", "L", "RGB")}


def stored(picture: Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    out = io.BytesIO()
    picture.save(out, kind, **options)
    return out.getvalue()


def photos() -> list[Case]:
    """Models of 8 photographs: COLMAP, transforms.json with and without sizes, shrunk images, images of every mode."""
    found = []
    with TemporaryDirectory() as name:
        root = Path(name)
        for k in range(4):
            (root / str(k)).mkdir()
        found.append(files_in(write_photos(root / "0", PHOTOS, cloud(5))))
        found.append(files_in(write_transforms(root / "1", PHOTOS)))
        found.append(files_in(write_transforms(root / "2", PHOTOS, sizes=False, suffix="")))
    half, modes = dict(found[0]), dict(found[1])
    pictures = [path for path in found[0] if path.endswith(".png")]
    for k, path in enumerate(pictures):
        picture = Image.open(io.BytesIO(found[0][path]))
        half[path] = stored(picture.resize((picture.width // 2, picture.height // 2)))
        mode = ("RGB", "RGBA", "L", "LA", "P", "1", "RGB", "RGB")[k]
        modes[path] = stored(picture.convert(mode), ("JPEG", "WEBP")[k - 6] if k > 5 else "PNG")
    clear = Image.open(io.BytesIO(found[0][pictures[1]])).convert("RGBA")
    clear.putalpha(128)
    modes[pictures[1]] = stored(clear)
    modes[pictures[4]] = stored(Image.open(io.BytesIO(modes[pictures[4]])), transparency=0)
    return [*found, half, modes]


def change_picture(rng: Random, data: bytes) -> bytes:
    """One change of a photograph: its chunks under right checksums, its kind, mode or size, or its bytes."""
    way = rng.randrange(10)
    if way < 5 and data.startswith(_PNG):
        return change_chunk(rng, data)
    if way < 7:
        return change_bytes(rng, data)
    try:
        with quiet_pillow(), Image.open(io.BytesIO(data)) as image:
            picture = image.convert("RGB") if image.width * image.height <= 1 << 20 else None
    except FAULTS:
        picture = None
    if picture is None:  # damaged before, or said to be too large
        return change_bytes(rng, data)
    if way == 7:
        sides = (1, 15, 16, picture.width // 2, picture.width - 1, 2 * picture.width, 400)
        picture = picture.resize((max(rng.choice(sides), 1), max(rng.choice(sides), 1)))
    kind = rng.choice(sorted(_KEPT_BY))
    return stored(picture.convert(rng.choice(_KEPT_BY[kind])), kind)


def change_chunk(rng: Random, data: bytes) -> bytes:
    """A PNG with a chunk changed, left out, doubled or put in, its checksum right."""
    chunks, at = [], len(_PNG)
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    if not chunks:
        return change_bytes(rng, data)
    k = rng.randrange(len(chunks))
    name, content = chunks[k]
    way = rng.randrange(6)
    if way == 0:
        sides = struct.pack(">II", *(rng.choice((0, 1, 16, 48, 9000, 12000, 40000, 1 << 31)) for _ in range(2)))
        kept = chunks[0][1][8:] if rng.random() < 0.5 else change_bytes(rng, chunks[0][1][8:])
        chunks[0] = (chunks[0][0], sides + kept)
    elif way == 1:
        del chunks[k]
    elif way == 2:
        chunks.insert(rng.randrange(len(chunks) + 1), (name, content))
    elif way == 3:
        names = (b"tRNS", b"PLTE", b"iCCP", b"zTXt", b"iTXt", b"tEXt", b"eXIf", b"acTL", b"gAMA", b"pHYs")
        bodies = (b"", b"\0", bytes(6), b"a\0\0" + zlib.compress(bytes(1 << 20)), change_bytes(rng, bytes(20)))
        chunks.insert(rng.randrange(1, len(chunks) + 1), (rng.choice(names), rng.choice(bodies)))
    elif name == b"IDAT" and way == 4:
        inner = zlib.decompressobj().decompress(content, 1 << 20)
        chunks[k] = (name, zlib.compress(change_bytes(rng, inner)))
    else:
        chunks[k] = (name, change_bytes(rng, content))
    packed = (struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks)
    return _PNG + b"".join(packed)


KINDS["picture"] = change_picture


def in_photos(folder: Path, case: Case) -> None:
    with pytest.raises(FileNotFoundError):
        load_photos(folder / "none")
    with pytest.raises(FileNotFoundError):
        load_photos(folder, images="none")
    found = load_photos(folder)
    with pytest.raises(ValueError, match="downscale: expected images"):
        load_photos(folder, downscale=1e9)
    with pytest.raises(ValueError, match="size: expected at most"):
        load_photos(folder, size=(1 << 20, 1 << 20))
    try:
        small = load_photos(folder, size=(24, 16))
        assert small.views.images.shape == (len(found.views.cameras), 16, 24, 3)
    except ValueError as error:
        assert str(error).startswith("size: expected at most ")
    images, cameras = found.views.images, found.views.cameras
    assert images.dtype == np.uint8
    assert images.shape == (len(cameras), cameras.height, cameras.width, 3)
    assert np.isfinite(cameras.viewmats).all()
    assert np.isfinite(cameras.Ks).all()
    assert found.names == tuple(sorted(found.names))
    assert found.points is None or np.isfinite(found.points.means).all()


SUBSETS, COUNT = "subsets.npz", 60
LEVELS = LevelsConfig(shares=(0.25, 0.5), iterations=6, evaluate_every=0)


@cache
def run(seed: int) -> tuple[Gaussians, PosedImages]:
    """A scene and views of it; another seed is another run."""
    scene = random_scene(np.random.default_rng(seed), COUNT)
    return scene, render_views(scene, Cameras.orbit((0, 0, 0), 4.0, 4, width=24, height=20))


def chosen_in(folder: Path | None, seed: int = 0) -> dict[int, Any]:
    scene, views = run(seed)
    return _subsets(scene, views, None, None, LEVELS.sizes(COUNT), LEVELS, folder, silent)


def subsets() -> list[Case]:
    with TemporaryDirectory() as folder:
        chosen_in(Path(folder))
        return [files_in(Path(folder))]


def change_subsets(rng: Random, case: Case, target: Target) -> Case:
    """Change the file, or put that of another run in its place."""
    from tests.fuzz.targets import change_files

    if rng.random() < 0.02:
        return dict(other_subsets())
    return change_files(rng, case, target)


@cache
def other_subsets() -> Case:
    with TemporaryDirectory() as folder:
        chosen_in(Path(folder), 1)
        return files_in(Path(folder))


def in_subsets(folder: Path, case: Case) -> None:
    masks = chosen_in(folder)
    if case == subsets()[0]:
        assert all(np.array_equal(mask, masks[count]) for count, mask in chosen_in(None).items())
    assert sorted(masks) == sorted({0, *(frozen for _, frozen, _ in LEVELS.sizes(COUNT))})
    for count, mask in masks.items():
        assert mask.shape == (COUNT,)
        assert mask.dtype == bool
        assert mask.sum() == count


TRAIN, FILES = "gsvis.train.", "gsvis.files."

TARGETS = [
    Target(
        "photographs",
        photos,
        in_photos,
        (FormatError, FileNotFoundError, SceneError),
        kinds={f"images/photo_{k:03d}.png": "picture" for k in range(PHOTOS)},
        modules=(TRAIN + "_photo_files", TRAIN + "photos"),
        weight=0.5,
    ),
    Target(
        "subsets",
        subsets,
        in_subsets,
        change=change_subsets,
        modules=(FILES + "archive", TRAIN + "levels"),
        weight=0.5,
        beginnings=("work: expected ",),
    ),
]
