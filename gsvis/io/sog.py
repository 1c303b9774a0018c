"""Read SOG, scenes of PlayCanvas as lossless WebP planes, versions 1 and 2, in a folder or a zip.

Pixel i of every plane belongs to Gaussian i. Positions are 16-bit over a logarithmic range, and quaternions three of
four components. Other values are bytes that index ranges (version 1) or codebooks (version 2). Higher SH is a palette
with labels.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import Budget, inside, read_whole, safe_name
from gsvis.io._build import bytes_of_scene, exp_scales, gaussians_from, largest_from_three, sigmoid
from gsvis.io._origin import settle_origin
from gsvis.io._sog_files import FolderStore, Store, ZipStore
from gsvis.io._webp import MAX_PIXELS, decode_plane, plane_size
from gsvis.io.facts import KEY, facts_from_json
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.symlog import from_symlog

__all__ = ["ANTIALIASED", "SogMeta", "load_sog", "read_sog"]

ANTIALIASED = "antialiased"
"""Value of `model` in the metadata of an antialiased scene."""

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}
_PALETTE_ROW = 64  # centroids in a row of their plane


def load_sog(path: str | os.PathLike[str]) -> Gaussians:
    """Read a SOG scene.

    Args:
        path: A `.sog` zip, a folder with `meta.json`, or that `meta.json`.

    Returns:
        The scene, in the file's order and frame.

    Raises:
        FormatError: If metadata or planes are missing, damaged or inconsistent.
        OSError: If the file cannot be opened.
    """
    where = _check.path("path", path)
    is_folder = where.is_dir()
    if is_folder:
        where = where / "meta.json"
    if where.suffix.lower() != ".json":
        with ZipStore(where) as archive:
            budget = Budget(where, archive.size)
            return read_sog(SogMeta(parse_object(where, archive.read("meta.json", budget), budget)), archive, budget)
    if is_folder:
        inside(where, "", where.parent, where.name)
    store = FolderStore(where.parent, where)
    data = read_whole(where)
    budget = Budget(where, len(data))
    meta = SogMeta(parse_object(where, data, budget))
    budget.file_bytes += store.file_bytes(meta.names)
    return read_sog(meta, store, budget)


class SogMeta:
    """The checked metadata of one SOG scene.

    Args:
        fields: The object in `meta.json`.

    Raises:
        FormatError: If the version is unknown or a value has the wrong type or range.
    """

    def __init__(self, fields: Fields) -> None:
        self.fields = fields
        self.path = fields.path
        self.version = fields.integer("version", 2, 2) if "version" in fields else 1
        if self.version == 2:
            self.count = fields.integer("count", 1, MAX_PIXELS)
        else:
            means = fields.child("means")
            shape = means.items("shape")
            self.count = Fields(means.path, "means.shape", {"0": shape[0] if shape else None}).integer(
                "0", 1, MAX_PIXELS
            )
        numbers = {"means": 2, "quats": 1, "scales": 1, "sh0": 1} | ({"shN": 2} if "shN" in fields else {})
        self.files = {key: self._files(key, number) for key, number in numbers.items()}
        self.names = [name for names in self.files.values() for name in names]

    def _files(self, key: str, number: int) -> list[str]:
        """Return the file names of a plane; raise unless there are `number`."""
        part = self.fields.child(key)
        return [safe_name(self.path, part.where("files"), name) for name in part.items("files", number)]

    def facts(self) -> SceneFacts:
        """Return the facts in the file: its model, as splat-transform writes it, and the facts of gsvis."""
        stated = facts_from_json(self.fields.raw(KEY)) if KEY in self.fields else SceneFacts()
        named = self.fields.raw("model") if "model" in self.fields else ""
        return replace(stated, antialiased=True) if named == ANTIALIASED else stated

    def table(self, key: str, channels: int) -> F32:
        """Return the values of all bytes of a plane.

        Args:
            key: `scales`, `sh0` or `shN`.
            channels: Number of channels with their own range in version 1.

        Returns:
            (entries, channels) raw values; 256 entries, or fewer in a short codebook.
        """
        part = self.fields.child(key)
        with np.errstate(all="ignore"):
            if self.version == 1:
                low, high = (
                    part.numbers(end, channels) if channels > 1 else np.array([part.number(end)])
                    for end in ("mins", "maxs")
                )
                return (low + (high - low) * (np.arange(256) / 255.0)[:, None]).astype(np.float32)
            entries = part.items("codebook")
            if len(entries) == 256 and entries[0] is None:  # a bug of early writers; extrapolate
                rest = Fields(self.path, key, {"codebook": entries[1:]}).numbers("codebook", 255)
                codebook = np.concatenate([[rest[0] + (rest[0] - rest[254]) / 255.0], rest])
            else:
                codebook = part.numbers("codebook")
            return np.repeat(codebook.astype(np.float32)[:, None], channels, axis=1)


def read_sog(meta: SogMeta, store: Store, budget: Budget) -> Gaussians:
    """Decode the planes of one SOG scene.

    Args:
        meta: Its metadata.
        store: Source of its planes.
        budget: Limit of the unpacked size; it already counts the size of the files.

    Raises:
        FormatError: If a plane is missing, damaged, too small, or holds an index out of range.
    """
    budget.claim(bytes_of_scene(meta.count, 0), "count")
    means = _means(meta, store, budget)
    packed = _plane(meta, store, budget, "quats")
    tags = packed[:, 3]
    if tags.min() < 252:
        row = int(tags.argmin())
        raise FormatError(store.path, f"quats, Gaussian {row}", "a tag from 252 to 255 in alpha", f"{tags[row]}")
    three = (packed[:, :3].astype(np.float32) / 255.0 * 2.0 - 1.0) / np.float32(np.sqrt(2.0))
    quats = largest_from_three(three, tags - np.uint8(252))
    scales = exp_scales(_look_up(meta, "scales", _plane(meta, store, budget, "scales")[:, :3], 3))
    color = _plane(meta, store, budget, "sh0")
    if meta.version == 1:
        values = _look_up(meta, "sh0", color, 4)
        sh0 = np.ascontiguousarray(values[:, :3])
        opacities = sigmoid(values[:, 3])
    else:
        sh0 = _look_up(meta, "sh0", color[:, :3], 3)
        opacities = color[:, 3].astype(np.float32) / np.float32(255.0)
    higher = _higher(meta, store, budget) if "shN" in meta.files else None
    facts = meta.facts()
    scene = gaussians_from(store.path, means, quats, scales, opacities, sh0[:, None, :], higher, facts)
    return settle_origin(scene, facts.origin) if any(facts.origin) else scene


def _plane(meta: SogMeta, store: Store, budget: Budget, key: str, index: int = 0) -> U8:
    """Return the first N pixels (N, 4) of a plane with one pixel per Gaussian."""
    pixels = _image(meta, store, budget, key, index)
    if pixels.shape[0] * pixels.shape[1] < meta.count:
        raise FormatError(
            store.path,
            meta.files[key][index],
            f"at least {meta.count:,} pixels, one for each Gaussian",
            f"{pixels.shape[1]} x {pixels.shape[0]}",
        )
    return pixels.reshape(-1, 4)[: meta.count]


def _image(meta: SogMeta, store: Store, budget: Budget, key: str, index: int) -> U8:
    """Return a plane (H, W, 4), after claiming its declared size."""
    name = meta.files[key][index]
    data = store.read(name, budget)
    width, height = plane_size(store.path, name, data)
    budget.claim(4 * width * height, name)
    return decode_plane(store.path, name, data)


def _look_up(meta: SogMeta, key: str, pixels: U8, channels: int) -> F32:
    """Return (N, channels) values of the bytes of a plane."""
    table = meta.table(key, channels)
    _check_index(meta, key, int(pixels.max()), len(table), "codebook entries")
    return np.stack([table[:, c][pixels[:, c]] for c in range(channels)], axis=1)


def _check_index(meta: SogMeta, key: str, most: int, entries: int, what: str) -> None:
    """Raise unless all indices are below the number of entries."""
    if most >= entries:
        raise FormatError(meta.path, key, f"indices below {entries}, the number of {what}", f"{most}")


def _means(meta: SogMeta, store: Store, budget: Budget) -> F32:
    """Return (N, 3) centers."""
    part = meta.fields.child("means")
    low = part.numbers("mins", 3)
    high = part.numbers("maxs", 3)
    fine, coarse = (_plane(meta, store, budget, "means", i)[:, :3] for i in range(2))
    steps = fine.astype(np.uint16) | coarse.astype(np.uint16) << np.uint16(8)
    means = np.empty((meta.count, 3), np.float32)
    with np.errstate(all="ignore"):
        for axis in range(3):
            position = low[axis] + (high[axis] - low[axis]) * (np.arange(65536) / 65535.0)
            levels = from_symlog(position).astype(np.float32)
            means[:, axis] = levels[steps[:, axis]]
    return means


def _higher(meta: SogMeta, store: Store, budget: Budget) -> F32 | None:
    """Return (N, K-1, 3) higher coefficients by palette and label."""
    part = meta.fields.child("shN")
    bands = part.integer("bands", 0, 3) if "bands" in part else None
    if bands == 0:
        return None
    centroids = _image(meta, store, budget, "shN", 0)
    widths = {_PALETTE_ROW * k: degree for degree, k in _COEFFICIENTS.items() if bands in (None, degree)}
    height, width = centroids.shape[:2]
    if width not in widths:
        wanted = f"a width of {' or '.join(map(str, widths))} pixels"
        raise FormatError(store.path, meta.files["shN"][0], wanted, f"{width} x {height}")
    degree = widths[width]
    entries = _PALETTE_ROW * height
    if meta.version == 2:
        named = part.integer("count", 1, 65536)
        _check_index(meta, "shN.count", named - 1, entries, "centroids in the plane")
        entries = named
    budget.claim(bytes_of_scene(meta.count, degree) + bytes_of_scene(entries, degree), "shN")
    table = meta.table("shN", 1)[:, 0]
    _check_index(meta, "shN", int(centroids[..., :3].max()), len(table), "codebook entries")
    palette = table[centroids[..., :3]].reshape(-1, _COEFFICIENTS[degree], 3)
    pixels = _plane(meta, store, budget, "shN", 1)
    labels = pixels[:, 0].astype(np.intp) | pixels[:, 1].astype(np.intp) << 8
    _check_index(meta, "shN labels", int(labels.max()), entries, "palette entries")
    shN: F32 = palette[labels]
    return shN
