"""Write the report on visible sets: `report.json`, plots and maps as PNG, and `report.html` with all of it inside."""

from __future__ import annotations

import os
from functools import partial
from typing import Any

import numpy as np
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from gsvis.progress import Progress, silent
from gsvis.pvs.quality import Quality
from gsvis.pvs.store import VisibilityStore
from gsvis.render import rasterize
from gsvis.report.document import Subject
from gsvis.report.files import write_report_folder
from gsvis.report.html import Figure, where_figure
from gsvis.report.maps import CellMap, Ground, draw_cells
from gsvis.report.pictures import picture_figures
from gsvis.report.pvs_page import pvs_page
from gsvis.report.pvs_plots import (
    LEAST_MISSING,
    draw_bounds,
    draw_missing,
    draw_shares,
    draw_trades,
    draw_viewpoints,
)
from gsvis.report.theme import PERCENT, Plot, draw_plots
from gsvis.scene.gaussians import Gaussians

__all__ = ["pvs_document", "write_pvs_report"]

_BRIGHTER = 8.0  # factor by which the picture of differences is brightened


def pvs_document(quality: Quality, store: VisibilityStore, subject: Subject) -> dict[str, Any]:
    """Return the content of `report.json`.

    Args:
        quality: The measurements.
        store: The visible sets.
        subject: Context of the report; its `cameras_from` names the source of fresh viewpoints.
    """
    return {
        "format": "gsvis-pvs-report",
        "version": 3,
        "gsvis": subject.version,
        "command": subject.command,
        "parameters": subject.parameters,
        "scene": {"name": subject.title, **subject.facts},
        "viewpoints_from": subject.cameras_from,
        "store": _describe_store(store),
        "quality": quality.as_dict(),
        "bounds_checked": _check_bounds(quality, store),
        "judged": subject.judged,
    }


def _check_bounds(quality: Quality, store: VisibilityStore) -> dict[str, Any] | None:
    """Return how many stored bounds lie below what fresh rays estimate; None where there is nothing to compare."""
    bound = store.certificates.bound[quality.cells]
    known = ~np.isnan(bound)
    if quality.light is None or not known.any():
        return None
    below = int(np.count_nonzero(quality.light.missed_by_cell[known] > bound[known]))
    return {"cells": int(np.count_nonzero(known)), "below_estimate": below}


def _describe_store(store: VisibilityStore) -> dict[str, Any]:
    """Return a description of the store, over all cells."""
    shares = store.visible_counts / max(store.gaussians, 1)
    looked = store.viewpoints
    certified = store.certificates
    return {
        "file": store.path.name,
        "gaussians": store.gaussians,
        "scene": store.info.scene,
        "tau": store.tau,
        "class_edges": store.info.class_edges.tolist(),
        "config": dict(store.info.config),
        "grid": store.grid.as_dict(),
        "bytes": store.sizes(),
        "visible_share": {"mean": float(shares.mean()), "min": float(shares.min()), "max": float(shares.max())},
        "ever_visible_share": len(store.ever_visible()) / max(store.gaussians, 1),
        "viewpoints": {"mean": float(looked.mean()), "min": int(looked.min()), "max": int(looked.max())},
        "certificates": certified.as_dict(),
        "cells_above_limit": count_above_limit(store),
        "cells_without_a_free_viewpoint": int(np.count_nonzero((looked == 0) & (certified.rays == 0))),
        "cells": {
            "centers": store.grid.centers.tolist(),
            "visible": store.visible_counts.tolist(),
            "viewpoints": looked.tolist(),
            "inner_viewpoints": certified.inner.tolist(),
            "tile": [None if np.isnan(share) else float(share) for share in certified.tile],
            "bound": [None if np.isnan(share) else float(share) for share in certified.bound],
        },
    }


def count_above_limit(store: VisibilityStore) -> int:
    """Return the number of cells whose bound is above the limit of the build."""
    limit = _limit(store)
    return 0 if limit is None else int(np.count_nonzero(store.certificates.bound > limit))


def _limit(store: VisibilityStore) -> float | None:
    limit = store.info.config.get("limit")
    return float(limit) if isinstance(limit, int | float) else None


def write_pvs_report(
    folder: str | os.PathLike[str],
    quality: Quality,
    store: VisibilityStore,
    subject: Subject,
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Draw everything and write the folder, atomically.

    Args:
        folder: Created if missing; files in it that do not belong to a report are kept.
        quality: The measurements.
        store: The visible sets.
        subject: Context of the report; its `cameras_from` names the source of fresh viewpoints.
        progress: Called with stage "writing".

    Returns:
        The content of `report.json`.

    Raises:
        OSError: If the folder cannot be written.
        FormatError: If the store is damaged.
    """
    document = pvs_document(quality, store, subject)
    figures = _figures(quality, store, subject, document["store"]["ever_visible_share"], progress)
    write_report_folder(folder, pvs_page(quality, document, figures), document, figures.values(), subject.seconds)
    return document


def _figures(
    quality: Quality, store: VisibilityStore, subject: Subject, ever: float, progress: Progress
) -> dict[str, Figure]:
    """Return all plots, maps and pictures by name, plots for light and for dark pages."""
    grid = store.grid
    rim = 0.5 * grid.cell_size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    ground = Ground.from_scene(subject.gaussians, subject.up, (grid.centers[:, None] + rim).reshape(-1, 3))
    shares = store.visible_counts / max(store.gaussians, 1)
    missing = np.full(len(grid), np.nan)
    missing[quality.cells] = np.maximum(1.0 - quality.weighted_recall[..., 0].mean(axis=1), LEAST_MISSING)
    least = float(shares.min())
    most = float(shares.max())
    seen = CellMap(grid, shares, "visible share", least, max(most, least + 1e-4), ticks=PercentFormatter(1.0))
    bounds = min(1e-4, float(np.nanmin(missing))), max(1e-2, float(np.nanmax(missing)))
    lost = CellMap(grid, missing, "light missed", *bounds, logarithmic=True, ticks=PERCENT)
    size = ground.size_with_bar
    certified = store.certificates
    shared = store.viewpoints - certified.inner
    plots: dict[str, Plot] = {
        "map_visible": (partial(draw_cells, ground=ground, cells=seen), size),
        "visible": (partial(draw_shares, shares=shares, ever=ever), (5.2, 3.1)),
        "viewpoints": (partial(draw_viewpoints, shared=shared, inner=certified.inner), (5.2, 3.3)),
        "bounds": (partial(draw_bounds, bound=certified.bound, limit=_limit(store)), (5.2, 3.3)),
        "missing": (partial(draw_missing, quality=quality), (5.2, 3.7)),
        "map_missing": (partial(draw_cells, ground=ground, cells=lost), (size[0], size[1] + 0.3)),
        "classes": (partial(draw_trades, quality=quality), (5.2, 3.7)),
    }
    where = where_figure(subject.place)
    figures: dict[str, Figure] = {} if where is None else {"where": where}
    worst = picture_figures(_worst_image(quality, store, subject.gaussians))
    return {**figures, **worst, **draw_plots(plots, progress)}


def _worst_image(quality: Quality, store: VisibilityStore, g: Gaussians) -> dict[str, NDArray[np.float32]]:
    """Return the image with the largest loss: of the full scene, of the set, and their difference."""
    m, v = np.unravel_index(int(quality.psnr[..., 0].argmin()), quality.psnr.shape[:2])
    camera = quality.camera(int(m), int(v))
    held = np.zeros(store.gaussians, bool)
    held[store.visible_ids(int(quality.cells[m]))] = True
    kept = g[held if quality.shown is None else held[quality.shown]]
    full, culled = (np.clip(rasterize(some, camera, backend="cpu").images[0], 0.0, 1.0) for some in (g, kept))
    return {"worst_full": full, "worst_set": culled, "worst_difference": _BRIGHTER * np.abs(full - culled)}
