"""What `gsvis inspect --overdraw` measures, and the lighter scene of `gsvis export --budget-...`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gsvis.cli.arguments import Export, Inspect
from gsvis.cli.terminal import Status
from gsvis.cli.where import find_place
from gsvis.package.shown import is_package
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.source import Source

if TYPE_CHECKING:
    from gsvis.edit.budget import Budgeted
    from gsvis.package import Package

__all__ = ["Lighter", "cell_overdraw", "cell_overdraw_rows", "lighten", "measure_overdraw", "overdraw_rows"]

_FIGURES = ("splats", "mean", "worst", "until")


def measure_overdraw(
    command: Inspect, source: Source, space: NavigableSpace | None, status: Status
) -> dict[str, Any] | None:
    """Return the overdraw at cells of a package, or at eyes of the space of a scene, for JSON; None without any."""
    from gsvis.render import fill_around
    from gsvis.scene.view_sampling import ViewSampling

    count = command.overdraw or 0
    if is_package(command.scene):
        from gsvis.package import Package
        from gsvis.pvs.fill import fill_of_cells

        with Package.open(command.scene) as package:
            if package.manifest.visibility is not None and source.levels is not None:
                store = package.visibility
                cells = np.unique(np.linspace(0, len(store) - 1, min(count, len(store))).round().astype(np.int64))
                found = fill_of_cells(source.levels, store, cells, progress=status)
                return _document("what each cell sees", store.grid.centers[cells], found)
    if space is None:
        return None
    eyes = ViewSampling(count, 8, 8, 90.0).cameras(source.gaussians, space).viewpoints
    return _document("everything", eyes, fill_around(source.gaussians, eyes, progress=status))


def cell_overdraw(scene: str) -> dict[str, Any] | None:
    """Return the overdraw of all cells that a package or the tiles of a world state, for JSON; None without any."""
    from gsvis.world import World, is_world

    if not is_package(scene) and not is_world(scene):
        return None
    world = World.open(scene)
    cells: list[dict[str, Any]] = []
    for tile in range(len(world.manifest.tiles)):
        with world.package(tile) as package:
            cells += _stated_cells(package)
    if not cells:
        return None
    columns = {name: np.array([cell[name] for cell in cells]) for name in ("splats", "mean", "worst")}
    return {
        "median": {name: float(np.median(values)) for name, values in columns.items()},
        "largest": {name: float(values.max()) for name, values in columns.items()},
        "heaviest": int(columns["mean"].argmax()),
        "cells": cells,
    }


def _stated_cells(package: Package) -> list[dict[str, Any]]:
    """Return the overdraw of each cell of a package, for JSON; none where it states none."""
    from gsvis.pvs.fill import read_overdraw

    stated = package.manifest.info.provenance.get("overdraw")
    if stated is None or package.manifest.visibility is None:
        return []
    centers = package.visibility.grid.centers
    found = read_overdraw(stated, len(centers))
    if found is None:
        return []
    rows = zip(centers.tolist(), found.splats.tolist(), found.mean.tolist(), found.worst.tolist(), strict=True)
    return [{"place": place, "splats": splats, "mean": mean, "worst": worst} for place, splats, mean, worst in rows]


def cell_overdraw_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of a table about the overdraw of all cells: the median, the largest, and where."""
    median = found["median"]
    largest = found["largest"]
    heaviest = found["cells"][found["heaviest"]]["place"]
    return [
        (
            "splats over a pixel",
            f"{median['mean']:.0f} in the median of {len(found['cells'])} cells, {largest['mean']:.0f} at most",
        ),
        ("", f"{median['worst']:,.0f} over the worst pixel, {largest['worst']:,.0f} at most"),
        ("splats in a view", f"{median['splats']:,.0f} in the median, {largest['splats']:,.0f} at most"),
        ("heaviest cell", ", ".join(f"{value:.3g}" for value in heaviest)),
    ]


def _document(drawn: str, places: Any, found: Any) -> dict[str, Any]:
    """Return the fill at places for JSON, with medians and the place of the largest mean."""
    rows = [
        {"place": place.tolist(), **{name: float(getattr(found, name)[k]) for name in _FIGURES}}
        for k, place in enumerate(np.asarray(places, np.float64))
    ]
    median = {name: float(np.median(getattr(found, name))) for name in _FIGURES}
    return {"drawn": drawn, "median": median, "heaviest": rows[int(found.mean.argmax())], "places": rows}


def overdraw_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of a table about the overdraw: the median, the heaviest place, what was drawn."""
    median = found["median"]
    heaviest = found["heaviest"]
    return [
        ("splats over a pixel", f"{median['mean']:.0f} in the median of {len(found['places'])} places"),
        ("", f"{median['until']:.0f} until it is opaque; {median['worst']:,.0f} over the worst pixel"),
        ("splats in a view", f"{median['splats']:,.0f} in the median"),
        ("heaviest place", ", ".join(f"{value:.3g}" for value in heaviest["place"])),
        ("", f"{heaviest['mean']:.0f} over a pixel, {heaviest['splats']:,.0f} in a view"),
        ("drawn for this", found["drawn"]),
    ]


@dataclass(frozen=True)
class Lighter:
    """What a budget made of a scene; all empty without a budget.

    Attributes:
        source: The source with the lighter scene.
        remarks: Lines for the user.
        figures: What was measured, for JSON.
    """

    source: Source | None = None
    remarks: tuple[str, ...] = ()
    figures: dict[str, Any] | None = None


def lighten(command: Export, source: Source, walk: HeadPath | None, status: Status) -> Lighter:
    """Return a version of a scene that holds the budget of a command; nothing without a budget.

    Raises:
        SceneError: If there is no space for eyes, or nothing would be left.
    """
    if command.budget.budget_splats is None and command.budget.budget_fill is None:
        return Lighter()
    from gsvis.edit.budget import Budget, fit_budget

    space = find_place(source, command.where, walk).required("say where eyes may be with --box or --around")
    budget = Budget(command.budget.budget_splats, command.budget.budget_fill)
    found = fit_budget(source.gaussians, space, budget, progress=status)
    lighter = replace(source, gaussians=found.scene, levels=None, known_up=source.steady_up)  # the up axis stays
    figures = {name: getattr(found, name) for name in ("before", "after", "held", "mean_db", "worst_db")}
    return Lighter(lighter, tuple(_remarks(found, budget.eyes, len(source.gaussians))), figures)


def _remarks(found: Budgeted, eyes: int, count: int) -> list[str]:
    """Return lines about a version: what it has, what it costs, and whether it holds."""
    before = found.before
    after = found.after
    lines = [
        f" {len(found.scene):,} of {count:,} Gaussians; at {eyes} other eyes a view has at most"
        f" {after['splats']:,.0f} splats and {after['mean']:.0f} over a pixel"
        f" (before: {before['splats']:,.0f} and {before['mean']:.0f}).",
        f" Against the whole scene: {found.mean_db:.1f} dB in the mean of other views, {found.worst_db:.1f} at worst.",
    ]
    if not found.held:
        lines.append(" THE BUDGET IS NOT HELD at every one of these eyes; ask for what is printed above, or for less.")
    return lines
