"""Write PlayCanvas compressed PLY: 16 bytes a Gaussian in chunks of 256, and a byte for each SH coefficient.

The layout is that of `compressed_ply`. Gaussians are sorted along a Morton curve, so that the 256 of a chunk are
neighbors and its ranges are narrow.

References:
    PlayCanvas, "Compressed PLY format", https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from gsvis.files.atomic import atomic_path
from gsvis.io._build import smallest_three
from gsvis.io._origin import size_of_gaussians
from gsvis.io._ply_comments import comments_of
from gsvis.io.losses import report_clipped, report_loss, report_note
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.morton import morton_order
from gsvis.scene.sh import SH_C0

__all__ = ["save_compressed_ply"]

F64 = NDArray[np.float64]
U32 = NDArray[np.uint32]
_CHUNK = 256
_ATTRIBUTES = ("", "scale_")
# steps that may be visible: as a share of a Gaussian's size, of the logarithm of a scale, of a color in 0 to 1
_COARSE = 0.25
_COARSE_LOG = 1.0 / 32.0
_COARSE_COLOR = 1.0 / 64.0
_SH_RANGE = 4.0


def save_compressed_ply(scene: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write a `.compressed.ply`, atomically. The same scene gives the same bytes.

    Lossy: 11, 10 and 11 bits for the coordinates and the logarithms of scales, inside the ranges of a chunk; 10 bits
        for each of three quaternion components; 8 bits for opacities, colors, and SH between -4 and 4. The order of
        the Gaussians is lost. Facts of the scene become comments.

    Args:
        scene: The scene; its frame is kept.
        path: The file; its folder is created if missing.

    Raises:
        ValueError: If the scene is empty.
        OSError: If the file cannot be written.
    """
    if len(scene) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none")
    ordered = scene[morton_order(scene.means)]
    centers, positions = _pack_111011(ordered.means.astype(np.float64))
    scales, logs = _pack_111011(np.log(ordered.scales.astype(np.float64)))
    colors, rgb_and_alpha = _pack_colors(ordered)
    vertices = np.column_stack([positions, _pack_quats(ordered.quats), logs, rgb_and_alpha])
    ranges = np.concatenate([centers, scales, colors], axis=1)
    _report(ordered, ranges, path)
    header = _header(ordered, len(ranges)).encode("ascii")
    with atomic_path(path) as partial, open(partial, "wb") as stream:
        stream.write(header)
        stream.write(ranges.astype("<f4").tobytes())
        stream.write(vertices.astype("<u4").tobytes())
        stream.write(_pack_sh(ordered).tobytes())


def _header(scene: Gaussians, chunks: int) -> str:
    """Return the header, with its last line break."""
    ends = [f"{end}_{attribute}{axis}" for attribute in _ATTRIBUTES for end in ("min", "max") for axis in "xyz"]
    ends += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments_of(scene.facts))]
    lines += [f"element chunk {chunks}", *(f"property float {name}" for name in ends)]
    lines += [f"element vertex {len(scene)}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if scene.sh_degree:
        columns = 3 * scene.shN.shape[1]
        lines += [f"element sh {len(scene)}", *(f"property uchar f_rest_{k}" for k in range(columns))]
    return "\n".join(lines) + "\nend_header\n"


def _ranges_of_chunks(values: F64) -> F64:
    """Return (C, 6) lowest and highest values (N, 3) of each chunk, as float32 holds them."""
    starts = np.arange(0, len(values), _CHUNK)
    ends = np.hstack([np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)])
    return ends.astype(np.float32).astype(np.float64)


def _share_of_range(values: F64, ranges: F64) -> F64:
    """Return (N, 3) where values lie in the ranges of their chunks: 0 at the lowest, 1 at the highest."""
    each = np.repeat(ranges, _CHUNK, axis=0)[: len(values)]
    low = each[:, :3]
    width = each[:, 3:] - low
    shares = np.divide(values - low, width, out=np.zeros_like(values), where=width > 0.0)
    return shares.clip(0.0, 1.0)


def _pack_111011(values: F64) -> tuple[F64, U32]:
    """Return (C, 6) ranges of chunks, and (N,) words with three values of 11, 10 and 11 bits."""
    ranges = _ranges_of_chunks(values)
    steps = np.rint(_share_of_range(values, ranges) * (2047.0, 1023.0, 2047.0)).astype(np.uint32)
    return ranges, steps[:, 0] << np.uint32(21) | steps[:, 1] << np.uint32(11) | steps[:, 2]


def _pack_colors(scene: Gaussians) -> tuple[F64, U32]:
    """Return (C, 6) ranges of base colors, and (N,) words with a byte each for red, green, blue and opacity."""
    rgb = 0.5 + SH_C0 * scene.sh0[:, 0].astype(np.float64)
    ranges = _ranges_of_chunks(rgb)
    steps = np.rint(_share_of_range(rgb, ranges) * 255.0).astype(np.uint32)
    alpha = np.rint(scene.opacities * 255.0).astype(np.uint32)
    shifts = np.array([24, 16, 8], np.uint32)
    return ranges, np.bitwise_or.reduce(steps << shifts, axis=1) | alpha


def _pack_quats(quats: NDArray[np.float32]) -> U32:
    """Return (N,) words: two bits for the index of the largest component, then 10 bits for each of the others."""
    three, largest = smallest_three(quats)
    steps = np.rint((three * np.sqrt(0.5) + 0.5) * 1023.0).clip(0, 1023).astype(np.uint32)
    shifts = np.array([20, 10, 0], np.uint32)
    return np.asarray(largest.astype(np.uint32) << np.uint32(30) | np.bitwise_or.reduce(steps << shifts, axis=1))


def _pack_sh(scene: Gaussians) -> NDArray[np.uint8]:
    """Return (N, 3 K) bytes of the coefficients above degree 0, channel by channel; 256 steps from -4 to 4."""
    flat = scene.shN.transpose(0, 2, 1).reshape(len(scene), -1)
    steps = np.floor((flat / (2.0 * _SH_RANGE) + 0.5) * 256.0).clip(0, 255)
    return np.asarray(steps, np.uint8)


def _report(scene: Gaussians, ranges: F64, path: str | os.PathLike[str]) -> None:
    """Log what may be seen of the rounding.

    Args:
        scene: The Gaussians in the order of the file.
        ranges: (C, 18) ranges of the centers, log scales and colors of chunks, each lowest, then highest.
        path: The file.
    """
    limits = (
        ("centers", _COARSE * size_of_gaussians(scene.scales), (2047.0, 1023.0, 2047.0)),
        ("scales", _COARSE_LOG, (2047.0, 1023.0, 2047.0)),
        ("colors", _COARSE_COLOR, (255.0, 255.0, 255.0)),
    )
    for (what, limit, steps), ends in zip(limits, np.split(ranges, 3, axis=1), strict=True):
        step = ((ends[:, 3:] - ends[:, :3]) / steps).max(axis=1)
        coarse = int(np.repeat(step > limit, _CHUNK)[: len(scene)].sum())
        if coarse:
            text = f"{what} of {coarse:,} Gaussians are rounded to steps of up to {step.max():.3g}"
            report_loss(path, what, f"{text}: others in their chunks are far from them", coarse)
    report_clipped(path, "SH", np.abs(scene.shN) - _SH_RANGE, f"{-_SH_RANGE:g} to {_SH_RANGE:g}")
    if any(scene.facts.origin):
        report_note(path, "the origin is a note that only gsvis reads; other programs see the scene at (0, 0, 0)")
