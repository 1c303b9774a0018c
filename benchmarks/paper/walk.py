"""The share of a scene's Gaussians that a walk has seen so far, as a curve over time.

This is the first curve of the paper's figure 13. It is measured by cameras along the walk, or by the visible sets of
the cells on the walk, which a server would send. Scene frame and units, seconds from the start.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.progress import Progress, silent
from gsvis.raycast import TAU, Tracer, visible_in
from gsvis.render.weights import view_weights
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath

__all__ = ["PAPER_WALK", "VisibleCells", "WalkConfig", "WalkVisibility", "measure_walk"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

PAPER_WALK = MappingProxyType({"seconds": 30.0, "seen": 0.8685})
"""SRBF-Gaussian, figure 13: share of all Gaussians sent after 30 s of walking."""


@runtime_checkable
class VisibleCells(Protocol):
    """Cells with visible sets, such as a PVS store."""

    def cell_at(self, position: Any, /) -> Any:
        """Return the cell that holds a position (3,); None or a negative number outside all cells."""
        ...

    def visible(self, cell: Any, /) -> Iterable[int]:
        """Return the ids of the Gaussians visible from somewhere in a cell."""
        ...


@dataclass(frozen=True)
class WalkConfig:
    """Options of a measurement along a walk.

    Attributes:
        seconds: Time measured, from the start of the walk.
        rate: Poses per second.
        width: Width of a view, pixels.
        height: Height of a view, pixels.
        fov: Horizontal field of view, degrees.
        tau: Weight in (0, 1] from which a Gaussian is visible.
    """

    seconds: float = 30.0
    rate: float = 5.0
    width: int = 640
    height: int = 480
    fov: float = 90.0
    tau: float = TAU

    def __post_init__(self) -> None:
        for name in ("seconds", "rate"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {value!r}")
        _check.positive_int("width", self.width)
        _check.positive_int("height", self.height)
        if not 0.0 < self.fov < 180.0:
            raise ValueError(f"fov: expected degrees in (0, 180), got {self.fov!r}")
        if not 0.0 < self.tau <= 1.0:
            raise ValueError(f"tau: expected a weight in (0, 1], got {self.tau!r}")


@dataclass(frozen=True, eq=False)
class WalkVisibility:
    """What a walk sees at S instants.

    Attributes:
        times: (S,) seconds from the start.
        visible: (S,) share of the N Gaussians visible at the instant.
        seen: (S,) share of the N Gaussians seen at the instant or before; never falls.
        first_seen: (N,) float32, seconds until each Gaussian is first seen; infinite if never.
        outside: Number of instants at which the walk is in no cell; 0 for cameras.
        by: "raster" or "raycast" for cameras, "cells" for visible sets.
        config: Options of the measurement. With "cells", only `seconds` and `rate` have an effect.
    """

    times: F64
    visible: F64
    seen: F64
    first_seen: NDArray[np.float32]
    outside: int
    by: str
    config: WalkConfig

    def as_dict(self) -> dict[str, Any]:
        """Return everything but `first_seen` as plain numbers, strings and lists for JSON."""
        return {
            "by": self.by,
            "config": asdict(self.config),
            "gaussians": len(self.first_seen),
            "outside": self.outside,
            "mean_visible": float(self.visible.mean()),
            "max_visible": float(self.visible.max()),
            "seen_at_end": float(self.seen[-1]),
            "times": self.times.tolist(),
            "visible": self.visible.tolist(),
            "seen": self.seen.tolist(),
            "paper": dict(PAPER_WALK),
        }


def measure_walk(
    scene: Gaussians | Tracer | VisibleCells,
    path: HeadPath,
    config: WalkConfig | None = None,
    *,
    gaussians: int | None = None,
    progress: Progress = silent,
) -> WalkVisibility:
    """Measure the share of a scene that a walk has seen, over time.

    Args:
        scene: Gaussians (weights of the rasterizer), a tracer (weights along pixel rays), or cells with visible sets.
        path: The walk, in the scene's frame. A walk shorter than `config.seconds` is measured to its end.
        config: Time, rate, resolution and tau; None means `WalkConfig()`.
        gaussians: N, the number of Gaussians in the scene; required for cells without an attribute `gaussians`.
        progress: Called with stage "walk".

    Returns:
        The curves. With cameras, fewer pixels or instants see less, so report both with every figure.

    Raises:
        ValueError: If `gaussians` is missing with cells or contradicts the scene, or the scene is empty.

    References:
        SRBF-Gaussian, figure 13.
    """
    config = config or WalkConfig()
    walk = path.cut(0.0, config.seconds) if path.duration > config.seconds else path
    walk = walk.resample(config.rate)
    see, count, by = _watcher(scene, walk, config)
    if gaussians is not None and count is not None and gaussians != count:
        raise ValueError(f"gaussians: expected {count}, as the scene has, got {gaussians}; leave it out")
    count = count if count is not None else gaussians
    if count is None:
        raise ValueError("gaussians: expected their number with cells, got None; pass gaussians=len(scene)")
    _check.positive_int("gaussians", count)
    visible = np.zeros(len(walk))
    seen = np.zeros(len(walk))
    first_seen = np.full(count, np.inf, np.float32)
    ever = np.zeros(count, bool)
    outside = 0
    progress("walk", 0, len(walk))
    for i, time in enumerate(walk.times):
        ids = see(i)
        if ids is None:
            outside += 1
        else:
            if len(ids) and not 0 <= ids.min() <= ids.max() < count:
                raise ValueError(f"gaussians: expected more than the largest id {ids.max()}, got {count}")
            visible[i] = len(ids) / count
            fresh = ids[~ever[ids]]
            ever[fresh] = True
            first_seen[fresh] = time
        seen[i] = np.count_nonzero(ever) / count
        progress("walk", i + 1, len(walk))
    return WalkVisibility(walk.times, visible, seen, first_seen, outside, by, config)


def _watcher(
    scene: Gaussians | Tracer | VisibleCells, walk: HeadPath, config: WalkConfig
) -> tuple[Callable[[int], NDArray[np.int64] | None], int | None, str]:
    """Return a function that gives the ids visible at pose i (None outside all cells), N if known, and `by`."""
    cameras = walk.cameras(config.width, config.height, config.fov)
    tau = np.float32(config.tau)
    if isinstance(scene, Gaussians):
        return lambda i: np.flatnonzero(view_weights(scene, cameras[i]).largest[0] >= tau), len(scene), "raster"
    if isinstance(scene, Tracer):
        count = len(scene.proxies.gaussians)
        return lambda i: np.flatnonzero(visible_in(scene, cameras[i])[0] >= tau), count, "raycast"
    if not isinstance(scene, VisibleCells):
        raise ValueError(f"scene: expected Gaussians, a Tracer or cells with cell_at and visible, got {type(scene)}")
    kept: dict[Hashable, NDArray[np.int64]] = {}

    def of_cell(i: int) -> NDArray[np.int64] | None:
        cell = scene.cell_at(walk.positions[i])
        if cell is None or (isinstance(cell, int | np.integer) and cell < 0):
            return None
        if cell not in kept:
            kept[cell] = _ids(scene.visible(cell))
        return kept[cell]

    known = getattr(scene, "gaussians", None)  # a store has the attribute
    return of_cell, known if isinstance(known, int) else None, "cells"


def _ids(found: Iterable[int]) -> NDArray[np.int64]:
    """Return sorted, unique ids from an array or any collection, such as a roaring bitmap."""
    values = found if isinstance(found, np.ndarray) else np.fromiter(found, np.int64)
    return np.unique(_check.integers("ids", values, ("M",)))
