"""The share of a scene's terms that a walk has needed so far, as a curve over time.

This is the second curve of the paper's figure 13, beside that of the Gaussians. A term counts from the first instant at
which its Gaussian is visible and the term is active: for the eye, or for any eye in the cell, as a server would send
it. Scene frame and units, seconds from the start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.color.activation import Activation
from gsvis.color.records import bytes_per_term
from gsvis.color.srbf import SrbfColors
from gsvis.package.active_terms import ActiveTerms
from gsvis.prepare.active_terms import most_weights
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.raycast import Tracer, visible_in
from gsvis.render.weights import view_weights
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath
from paper.walk import PAPER_WALK, VisibleCells, WalkConfig

__all__ = ["PAPER_TERMS", "WalkTerms", "terms_over_walk"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

PAPER_TERMS = MappingProxyType({"seconds": 30.0, "start": 0.0358, "end": 0.2239})
"""SRBF-Gaussian, figure 13: share of all SRBFs sent at the start and after 30 s of walking."""


@dataclass(frozen=True, eq=False)
class WalkTerms:
    """What a walk needs at S instants.

    Attributes:
        times: (S,) seconds from the start.
        gaussians: (S,) share of the N Gaussians visible at the instant or before.
        terms: (S,) share of the T terms active at the instant or before, all of which were sent; never falls.
        active: (S,) share of the T terms active at the instant.
        of_visible: (S,) among the terms of the Gaussians visible at the instant, the share that is active; 0 if they
            have no terms.
        unpruned: (S,) share of the T terms that belong to Gaussians visible at the instant or before. A server would
            send these if every visible Gaussian came with all of its terms.
        first_active: (T,) float32, seconds until each term is first active; infinite if never.
        term_bytes: Bytes of a term.
        epsilon: Contribution above which a term is active.
        outside: Number of instants at which the walk is in no cell; 0 for cameras.
        by: Source of visibility: "raster" or "raycast" for cameras, or "cells"; then ", active in the cell" or
            ", active at the eye".
        config: Options of the measurement.
    """

    times: F64
    gaussians: F64
    terms: F64
    active: F64
    of_visible: F64
    unpruned: F64
    first_active: NDArray[np.float32]
    term_bytes: float
    epsilon: float
    outside: int
    by: str
    config: WalkConfig

    @property
    def bytes(self) -> F64:
        """(S,) bytes of the terms sent so far."""
        return np.asarray(self.term_bytes * len(self.first_active) * self.terms)

    def as_dict(self) -> dict[str, Any]:
        """Return everything but `first_active` as plain numbers, strings and lists for JSON."""
        curves = ("times", "gaussians", "terms", "active", "of_visible", "unpruned", "bytes")
        return {
            "by": self.by,
            "config": asdict(self.config),
            "epsilon": self.epsilon,
            "all_terms": len(self.first_active),
            "term_bytes": self.term_bytes,
            "outside": self.outside,
            "terms_at_start": float(self.terms[0]),
            "terms_at_end": float(self.terms[-1]),
            "gaussians_at_end": float(self.gaussians[-1]),
            "unpruned_at_end": float(self.unpruned[-1]),
            **{name: getattr(self, name).tolist() for name in curves},
            "paper": {**PAPER_TERMS, "gaussians": PAPER_WALK["seen"]},
        }


def terms_over_walk(
    colors: SrbfColors,
    scene: Gaussians,
    path: HeadPath,
    epsilon: float | ActiveTerms,
    *,
    sets: VisibleCells | Tracer | None = None,
    config: WalkConfig | None = None,
    weighted: bool = False,
    progress: Progress = silent,
) -> WalkTerms:
    """Measure the share of a scene's terms that a walk needs, over time.

    Args:
        colors: Colors of the N Gaussians, T terms.
        scene: The Gaussians.
        path: The walk, in the scene's frame. A walk shorter than `config.seconds` is measured to its end.
        epsilon: Contribution above which a term is active; or the active terms of cells, with their store as `sets`.
        sets: Source of visibility. None: cameras, by the weights of the rasterizer. A tracer: cameras, by pixel rays.
            A `VisibilityStore`: the cell of the eye, with the terms that may be active anywhere in it. Other cells:
            their sets, with the terms that are active at the eye, without weights.
        config: Time, rate, resolution and tau; None means `WalkConfig()`.
        weighted: Multiply contributions by blending weights: the largest weight in the camera's pixels, or the largest
            that the Gaussian's class in the cell allows. Without effect if `epsilon` is a store of active terms.
        progress: Called with stage "walk".

    Raises:
        ValueError: If lengths differ, epsilon is out of range, or active terms come without their store.
        FormatError: If store, active terms and scene do not match.

    References:
        SRBF-Gaussian, sections 6.2 and 7.3.1, figure 13.
    """
    if len(colors) != len(scene):
        raise ValueError(f"colors: expected those of {len(scene):,} Gaussians, got {len(colors):,}")
    config = config or WalkConfig()
    walk = (path.cut(0.0, config.seconds) if path.duration > config.seconds else path).resample(config.rate)
    look, threshold, by = _looker(colors, scene, epsilon, sets, walk, config, weighted)
    count = len(scene)
    counts = colors.counts
    size = len(walk)
    curves = {name: np.zeros(size) for name in ("gaussians", "terms", "active", "of_visible", "unpruned")}
    first_active = np.full(colors.num_terms, np.inf, np.float32)
    ever = np.zeros(count, bool)
    sent = np.zeros(colors.num_terms, bool)
    outside = 0
    all_terms = max(1, colors.num_terms)
    progress("walk", 0, size)
    for i, time in enumerate(walk.times):
        found_here = look(i)
        if found_here is None:
            outside += 1
        else:
            ids, mask = found_here
            ever[ids] = True
            first_active[mask & ~sent] = time
            sent |= mask
            found = np.count_nonzero(mask)
            curves["active"][i] = found / all_terms
            curves["of_visible"][i] = found / max(1, int(counts[ids].sum()))
        curves["gaussians"][i] = np.count_nonzero(ever) / max(1, count)
        curves["terms"][i] = np.count_nonzero(sent) / all_terms
        curves["unpruned"][i] = int(counts[ever].sum()) / all_terms
        progress("walk", i + 1, size)
    return WalkTerms(
        walk.times,
        **curves,
        first_active=first_active,
        term_bytes=bytes_per_term(colors.variant),
        epsilon=threshold,
        outside=outside,
        by=by,
        config=config,
    )


_Look = Callable[[int], tuple[I64, Mask] | None]
"""Visible Gaussians and active terms at the i-th pose; None outside all cells."""


def _looker(
    colors: SrbfColors,
    scene: Gaussians,
    epsilon: float | ActiveTerms,
    sets: VisibleCells | Tracer | None,
    walk: HeadPath,
    config: WalkConfig,
    weighted: bool,
) -> tuple[_Look, float, str]:
    """Return the look function, epsilon, and `by`."""
    if isinstance(epsilon, ActiveTerms):
        if not isinstance(sets, VisibilityStore):
            raise ValueError("sets: expected the VisibilityStore of the active terms, got none; pass sets=store")
        epsilon.check(scene=scene, colors=colors, sets=sets)
        return _by_active_terms(epsilon, sets, walk), epsilon.epsilon, "cells, active in the cell"
    activation = Activation(colors, scene.means, epsilon)
    if isinstance(sets, VisibilityStore):
        sets.check_scene(scene)
        return _by_store(activation, sets, walk, weighted), activation.epsilon, "cells, active in the cell"
    if sets is None or isinstance(sets, Tracer):
        by = "raster" if sets is None else "raycast"
        return (
            _by_cameras(activation, sets or scene, walk, config, weighted),
            activation.epsilon,
            f"{by}, active at the eye",
        )
    return _by_cells(activation, sets, walk), activation.epsilon, "cells, active at the eye"


def _by_active_terms(terms: ActiveTerms, store: VisibilityStore, walk: HeadPath) -> _Look:
    def look(i: int) -> tuple[I64, Mask] | None:
        cell = store.cell_at(walk.positions[i])
        if cell < 0:
            return None
        mask = np.zeros(terms.info.terms, bool)
        mask[terms.active_ids(cell)] = True
        return store.visible_ids(cell), mask

    return look


def _by_store(activation: Activation, store: VisibilityStore, walk: HeadPath, weighted: bool) -> _Look:
    def look(i: int) -> tuple[I64, Mask] | None:
        cell = store.cell_at(walk.positions[i])
        if cell < 0:
            return None
        ids, weights = most_weights(store, cell) if weighted else (store.visible_ids(cell), None)
        return ids, activation.active_in_box(*store.grid.bounds(cell), ids, weights)

    return look


def _by_cameras(
    activation: Activation, scene: Gaussians | Tracer, walk: HeadPath, config: WalkConfig, weighted: bool
) -> _Look:
    cameras = walk.cameras(config.width, config.height, config.fov)

    def look(i: int) -> tuple[I64, Mask]:
        camera = cameras[i]
        largest = visible_in(scene, camera) if isinstance(scene, Tracer) else view_weights(scene, camera).largest
        ids = np.flatnonzero(largest[0] >= np.float32(config.tau))
        return ids, activation.active(walk.positions[i], ids, np.minimum(largest[0, ids], 1.0) if weighted else None)

    return look


def _by_cells(activation: Activation, cells: VisibleCells, walk: HeadPath) -> _Look:
    def look(i: int) -> tuple[I64, Mask] | None:
        cell = cells.cell_at(walk.positions[i])
        if cell is None or (isinstance(cell, int | np.integer) and cell < 0):
            return None
        found = cells.visible(cell)
        ids = np.unique(found if isinstance(found, np.ndarray) else np.fromiter(found, np.int64))
        return ids, activation.active(walk.positions[i], ids)

    return look
