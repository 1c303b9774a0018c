"""Split scenes of any size into the tiles of a grid, batch by batch. Scene frame and units.

Two passes: the first takes a sample of constant size, which gives robust bounds, the up axis and the side of the
squares; the second writes each batch as one file for each tile in it. Memory holds a batch, or a tile. Nothing depends
on the order of scenes or rows: a row is in the sample by a hash of its center.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.io.batches import Batch, read_batch
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import axis_vector, guess_up
from gsvis.world.graph import Facts, Given
from gsvis.world.manifest import Grid
from gsvis.world.rows import content_order, load_gaussians, save_gaussians

__all__ = [
    "OUTSIDE",
    "VERSIONS",
    "TilingConfig",
    "find_grid",
    "grid_of",
    "sample_rows",
    "sampling_interval",
    "split_batch",
    "tile_name",
]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

VERSIONS = {"sample_rows": 1, "find_grid": 1, "split_batch": 1}

OUTSIDE = "outside"
"""Name of the tile of what lies outside all squares."""

_SAMPLE = 1 << 19  # rows of the sample, about
_MARGIN = 0.25  # of the robust box, added to each side
_MOST_SQUARES = 1 << 16


@dataclass(frozen=True)
class TilingConfig:
    """How a world is cut.

    Attributes:
        most: Most Gaussians of a tile, about: the side of the squares is halved until the fullest has no more.
        coverage: Share of the centers inside the robust box on each axis.
        up: Axis that points upward, such as "+z"; None guesses it.

    Raises:
        ValueError: If a value is out of range.
    """

    most: int = 250_000
    coverage: float = 0.98
    up: str | None = None

    def __post_init__(self) -> None:
        _check.positive_int("most", self.most)
        if not 0.5 <= self.coverage < 1.0:
            raise ValueError(f"coverage: expected a share in [0.5, 1), got {self.coverage!r}")
        if self.up is not None:
            axis_vector(self.up)


def sample_rows(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: write the rows of a batch that are in the sample. `every` of about so many rows is one.

    Facts: how many Gaussians the batch has, and how many are in the sample.
    """
    g = read_batch(Batch(**params["batch"]))
    some = g[(_hashes(g.means) % np.uint32(params["every"]) == 0) & (g.opacities >= MIN_ALPHA)]
    flat = Gaussians(some.means, some.quats, some.scales, some.opacities, some.sh0)
    save_gaussians(out / "sample", flat)
    return {"gaussians": len(g), "sampled": len(flat), "sh_degree": g.sh_degree}


def find_grid(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the grid from all samples.

    Facts: the grid, the up axis, `bottom` and `top` on the axis that is not cut, and the Gaussians that the sample
    expects in each square.
    """
    parts = [load_gaussians(given.path(k, "sample")) for k in range(len(given)) if given.inputs[k].facts["sampled"]]
    if not parts:
        raise SceneError("the scene has no Gaussian with an opacity of at least 1/255: there is nothing to see")
    sample, config = Gaussians.concatenate(parts), TilingConfig(**params["config"])
    sample = sample[content_order(sample)]
    up = config.up or guess_up(sample)[0]
    low, high = sample.bounds(config.coverage)
    spread = np.maximum(_MARGIN * (high - low), 3.0 * float(np.median(sample.scales)))
    low, high = low - spread, high + spread
    upright = int(np.abs(axis_vector(up)).argmax())
    axes = [axis for axis in range(3) if axis != upright]
    inside = sample.means[((sample.means >= low) & (sample.means <= high)).all(axis=1)].astype(np.float64)
    side = float((high - low)[axes].max())
    while True:
        shape = np.maximum(np.ceil((high - low)[axes] / side - 1e-9), 1).astype(int)
        squares = np.floor((inside[:, axes] - low[axes]) / side).astype(int).clip(0, shape - 1)
        counts = np.bincount(squares[:, 0] * shape[1] + squares[:, 1], minlength=int(shape.prod()))
        if counts.max() * params["every"] <= config.most or shape.prod() * 4 > _MOST_SQUARES:
            break
        side *= 0.5
    grid = Grid(_triple(low), side, (axes[0], axes[1]), (int(shape[0]), int(shape[1])))
    return {
        "grid": asdict(grid),
        "up": up,
        "bottom": float(low[upright]),
        "top": float(high[upright]),
        "expected": (counts * params["every"]).tolist(),
    }


def split_batch(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: write the rows of a batch as one file for each tile. The input is the grid.

    Facts: how many rows each tile got.
    """
    g = read_batch(Batch(**params["batch"]))
    found = given.inputs[0].facts
    grid, upright = grid_of(found["grid"]), 3 - sum(found["grid"]["axes"])
    squares = grid.squares_of(g.means)
    heights = g.means[:, upright]
    squares[(heights < found["bottom"]) | (heights > found["top"])] = -1
    keys = squares[:, 0] * grid.shape[1] + squares[:, 1]
    keys[squares[:, 0] < 0] = -1
    counts = {}
    for key in np.unique(keys).tolist():
        name = tile_name(None if key < 0 else divmod(key, grid.shape[1]))
        rows = g[keys == key]
        save_gaussians(out / name, rows)
        counts[name] = len(rows)
    return {"counts": counts}


def tile_name(coords: tuple[int, int] | None) -> str:
    """Return the name of a tile in files and messages."""
    return OUTSIDE if coords is None else f"{coords[0]}-{coords[1]}"


def grid_of(value: Facts) -> Grid:
    """Return the grid of the facts of `find_grid`."""
    origin, axes, shape = value["origin"], value["axes"], value["shape"]
    return Grid(_triple(origin), value["side"], (axes[0], axes[1]), (shape[0], shape[1]))


def sampling_interval(gaussians: int) -> int:
    """Return of how many rows one is in the sample."""
    return max(1, gaussians // _SAMPLE)


def _hashes(means: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Return (N,) hashes of centers, evenly spread.

    References:
        The finalizer of MurmurHash3.
    """
    bits = np.ascontiguousarray(means, "<f4").view("<u4")
    mixed = bits[:, 0] * np.uint32(0x9E3779B1) ^ bits[:, 1] * np.uint32(0x85EBCA77) ^ bits[:, 2] * np.uint32(0xC2B2AE3D)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        mixed = (mixed ^ (mixed >> np.uint32(shift))) * np.uint32(factor)
    return np.asarray(mixed ^ (mixed >> np.uint32(16)))


def _triple(values: F64 | list[float]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
