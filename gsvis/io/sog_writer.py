"""Write SOG version 2: WebP planes in a stored zip, the higher SH as a palette found by clustering.

Lossy: 16 bits per coordinate on a logarithmic scale, 8 bits per quaternion component and opacity, 256 values for
    all scales and for all colors, up to 65,536 sets of higher coefficients. The order of the Gaussians is kept.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.files.atomic import atomic_path
from gsvis.io._build import smallest_three
from gsvis.io._origin import size_of_gaussians
from gsvis.io._webp import MAX_PIXELS, encode_plane
from gsvis.io.facts import KEY, facts_to_json
from gsvis.io.losses import report_loss, report_note
from gsvis.io.quantize import codebook_of, nearest_entry, palette_of
from gsvis.io.sog import ANTIALIASED
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.symlog import symlog

__all__ = ["EncodedSog", "encode_sog", "report_palette_loss", "report_sog_losses", "save_sog"]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
_PALETTE_ROW = 64
_MAX_PALETTE = 65536
_COARSE = 0.25  # step that may be visible, as a share of a Gaussian's size
_SHOWS = 1.0 / 255.0  # change of color that may be visible


@dataclass(frozen=True)
class EncodedSog:
    """A scene as SOG.

    Attributes:
        files: Files by name: the planes, then `meta.json`.
        sets: Number of sets of higher coefficients in the palette; 0 without higher coefficients.
        sh_error: Change of color caused by the palette, root mean square over Gaussians, directions and channels; 1 is
            white.
    """

    files: dict[str, bytes]
    sets: int = 0
    sh_error: float = 0.0


def save_sog(scene: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write a `.sog` file, atomically. The same scene gives the same bytes.

    Args:
        scene: The scene; its order and frame are kept.
        path: The file; its folder is created if missing.

    Raises:
        ValueError: If the scene is empty or has more Gaussians than a plane has pixels.
        OSError: If it cannot be written.
    """
    found = encode_sog(scene)
    report_sog_losses(scene, path)
    report_palette_loss(path, len(scene), found.sets, found.sh_error)
    with atomic_path(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
        for name, data in found.files.items():
            archive.writestr(zipfile.ZipInfo(name), data)


def encode_sog(scene: Gaussians, *, palette: int = _MAX_PALETTE, digits: int | None = None) -> EncodedSog:
    """Return a scene as the files of SOG, with the error of the palette of its higher coefficients.

    Args:
        scene: The scene; its order and frame are kept.
        palette: Largest number of sets of higher coefficients, 1 to 65,536.
        digits: Significant digits of the codebooks in `meta.json`; None writes them in full.

    Raises:
        ValueError: If the scene is empty or has more Gaussians than a plane has pixels.
    """
    if not 1 <= len(scene) <= MAX_PIXELS:
        raise ValueError(f"scene: expected 1 to {MAX_PIXELS:,} Gaussians for SOG, got {len(scene):,}")
    planes: dict[str, U8] = {}
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "gsvis"}, "count": len(scene)}
    meta |= _facts(scene)
    meta["means"] = _means(scene, planes)
    planes["quats"] = _as_plane(_quats(scene.quats))
    meta["quats"] = {"files": ["quats.webp"]}
    scales = np.log(scene.scales.astype(np.float64)).astype(np.float32)
    codebook = _rounded(codebook_of(scales), digits)
    planes["scales"] = _as_plane(nearest_entry(scales, codebook))
    meta["scales"] = {"codebook": _numbers_for_json(codebook, digits), "files": ["scales.webp"]}
    sh0 = scene.sh0[:, 0]
    codebook = _rounded(codebook_of(sh0), digits)
    opacities = np.rint(scene.opacities * 255.0).astype(np.uint8)
    planes["sh0"] = _as_plane(np.column_stack([nearest_entry(sh0, codebook), opacities]))
    meta["sh0"] = {"codebook": _numbers_for_json(codebook, digits), "files": ["sh0.webp"]}
    error = 0.0
    if scene.sh_degree:
        meta["shN"], error = _higher(scene, planes, palette, digits)
    files = {f"{name}.webp": encode_plane(plane) for name, plane in planes.items()}
    files["meta.json"] = json.dumps(meta, separators=None if digits is None else (",", ":")).encode()
    return EncodedSog(files, meta["shN"]["count"] if scene.sh_degree else 0, error)


def _facts(scene: Gaussians) -> dict[str, Any]:
    """Return the facts of the scene, ready for JSON; empty if there are none."""
    found = facts_to_json(scene.facts)
    if found.pop("antialiased", False):
        return {"model": ANTIALIASED} | ({KEY: found} if found else {})
    return {KEY: found} if found else {}


def report_sog_losses(scene: Gaussians, path: str | os.PathLike[str]) -> None:
    """Log visible rounding of centers that are far from (0, 0, 0) or widely spread, and a note about the origin."""
    size = size_of_gaussians(scene.scales)
    position = symlog(scene.means)
    steps = (position.max(axis=0) - position.min(axis=0)) / 65535.0 * (1.0 + np.median(np.abs(scene.means), axis=0))
    if float(steps.max()) > _COARSE * size:
        report_loss(path, "centers", f"centers are rounded to steps of {steps.max():.3g}; Gaussians have {size:.3g}")
    if any(scene.facts.origin):
        report_note(path, "the origin is a note that only gsvis reads; other programs see the scene at (0, 0, 0)")


def report_palette_loss(path: str | os.PathLike[str], gaussians: int, sets: int, error: float) -> None:
    """Log that Gaussians share sets of higher coefficients, if that changes their colors visibly.

    Args:
        path: The file or folder.
        gaussians: Number of Gaussians with higher coefficients.
        sets: Number of sets that they share.
        error: Change of color; see `EncodedSog.sh_error`.
    """
    if error > _SHOWS:
        text = f"{gaussians:,} Gaussians share {sets:,} sets of SH; colors change by {error:.2g} of white (RMS)"
        report_loss(path, "SH", text, gaussians)


def _numbers_for_json(values: NDArray[np.floating[Any]], digits: int | None) -> list[float]:
    """Return numbers for JSON, rounded to significant digits; None keeps all digits."""
    return [v if digits is None else float(f"{v:.{digits}g}") for v in values.tolist()]


def _rounded(codebook: F32, digits: int | None) -> F32:
    """Return a codebook as readers will parse it."""
    return np.asarray(_numbers_for_json(codebook, digits), np.float32)


def _as_plane(values: U8) -> U8:
    """Return an (H, W, 4) image with one pixel per row; missing channels are 0 and alpha is 255."""
    width = 4 * math.ceil(math.sqrt(len(values)) / 4)
    height = 4 * math.ceil(len(values) / width / 4)
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _means(scene: Gaussians, planes: dict[str, U8]) -> dict[str, Any]:
    """Add the planes of the centers; return their entry in `meta.json`."""
    position = symlog(scene.means)
    low = position.min(axis=0)
    high = position.max(axis=0)
    unit = (position - low) / np.where(high > low, high - low, 1.0)
    steps = np.rint(unit * 65535.0).astype(np.uint16)
    planes["means_l"] = _as_plane((steps & np.uint16(0xFF)).astype(np.uint8))
    planes["means_u"] = _as_plane((steps >> np.uint16(8)).astype(np.uint8))
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}


def _quats(quats: F32) -> U8:
    """Return (N, 4) bytes: the three smaller components, and 252 plus the index of the largest."""
    three, largest = smallest_three(quats)
    packed = np.clip(np.rint((three * np.sqrt(0.5) + 0.5) * 255.0), 0, 255)
    return np.column_stack([packed, 252 + largest]).astype(np.uint8)


def _higher(scene: Gaussians, planes: dict[str, U8], entries: int, digits: int | None) -> tuple[dict[str, Any], float]:
    """Add the planes of the higher bands; return their entry in `meta.json` and the change of color."""
    n, k = scene.shN.shape[:2]
    palette, labels = palette_of(scene.shN.reshape(n, 3 * k), entries)
    codebook = _rounded(codebook_of(palette), digits)
    rows = math.ceil(len(palette) / _PALETTE_ROW)
    pixels = np.zeros((rows * _PALETTE_ROW * k, 4), np.uint8)
    pixels[:, 3] = 255
    rounded = nearest_entry(palette, codebook)
    pixels[: len(palette) * k, :3] = rounded.reshape(-1, 3)
    planes["shN_centroids"] = pixels.reshape(rows, _PALETTE_ROW * k, 4)
    planes["shN_labels"] = _as_plane(np.column_stack([labels & 0xFF, labels >> 8]).astype(np.uint8))
    written = codebook[rounded].reshape(len(palette), k, 3)
    squares = sum(float(np.square(scene.shN[:, c] - written[labels, c]).sum(dtype=np.float64)) for c in range(k))
    meta = {
        "count": len(palette),
        "bands": scene.sh_degree,
        "codebook": _numbers_for_json(codebook, digits),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    return meta, math.sqrt(squares / (3 * n * 4.0 * math.pi))  # the mean square of each basis function is 1 / (4 pi)
