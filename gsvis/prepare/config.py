"""Options of the preparation of a package: levels, cells, colors, and the views that measure them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from gsvis import _check
from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.prepare.colors import ColorConfig
from gsvis.pvs.cells import MAX_CELLS
from gsvis.pvs.config import PvsConfig
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.config import decisive_options
from gsvis.train.levels import LevelsConfig

__all__ = ["PrepareConfig"]

_LEVEL_FOV = 2.0 * math.degrees(math.atan(240.0 / 300.0))
_LEVEL_VIEWS = ViewSampling(400, 480, 360, _LEVEL_FOV)
_COST_VIEWS = ViewSampling(8, 480, 360, 60.0, stream=3)
_FIDELITY_VIEWS = ViewSampling(12, 320, 240, 60.0, stream=5)


@dataclass(frozen=True)
class PrepareConfig:
    """Everything that decides the content of a package, besides the scene and the navigable space.

    Attributes:
        levels: Lower levels and their training; None keeps the scene as it is. Ignored for a scene that has levels.
        level_views: Cameras that levels are trained from if there are no photos.
        level_held_out: Number of further cameras that measure levels; 0 for none. With photos, every eighth photo is
            held out instead.
        level_size: Size (width, height) in pixels to shrink photos to; None keeps their size.
        cells: Most cells. Cells are as small as this limit allows. None is 128, or 32 around an object and 64
            outdoors where visible sets hardly grow then; see `fitting_cells`.
        cell_size: Side of a cell, scene units; replaces `cells`. None uses `cells`.
        join_cells: Whether cells are joined until the visible sets are about a fifth of the package.
        sets: Options of the visible sets.
        colors: Options of the colors.
        color_steps: Steps of learning colors, after the fit, from photos or else from renders; 0 keeps the fit. None
            is 300; 0 without photos for a scene whose colors do not depend on direction, for a tile of a world, and
            where torch is missing.
        epsilon: Largest change of an RGB channel, in (0, 1], by a term that may be left out of a cell. None finds it by
            the staircase, see `calibrate_by_flip`.
        cell_terms: "computed": the active terms of a cell are computed when they are needed. "stored": the package
            lists them (paper, section 6.2).
        cost_views: Views that measure the cost of rounding.
        fidelity_views: Separate views that measure final quality against the source scene.
        meters_per_unit: Meters in a scene unit; 0 if unknown.

    Raises:
        ValueError: If a value is out of range.
    """

    levels: LevelsConfig | None = field(default_factory=LevelsConfig)
    level_views: ViewSampling = _LEVEL_VIEWS
    level_held_out: int = 12
    level_size: tuple[int, int] | None = None
    cells: int | None = None
    cell_size: float | None = None
    join_cells: bool = False
    sets: PvsConfig = field(default_factory=PvsConfig)
    colors: ColorConfig = field(default_factory=ColorConfig)
    color_steps: int | None = None
    epsilon: float | None = DEFAULT_EPSILON
    cell_terms: str = "computed"
    cost_views: ViewSampling = _COST_VIEWS
    fidelity_views: ViewSampling = _FIDELITY_VIEWS
    meters_per_unit: float = 0.0

    def __post_init__(self) -> None:
        if self.cells is not None and _check.positive_int("cells", self.cells) > MAX_CELLS:
            raise ValueError(f"cells: expected at most {MAX_CELLS:,}, got {self.cells:,}; make them larger")
        _check.one_of("cell_terms", self.cell_terms, ("computed", "stored"))
        _check.positive_int("level_held_out", self.level_held_out, at_least=0)
        if self.color_steps is not None:
            _check.positive_int("color_steps", self.color_steps, at_least=0)
        if self.cell_size is not None and not (np.isfinite(self.cell_size) and self.cell_size > 0):
            raise ValueError(f"cell_size: expected a finite number > 0 or None, got {self.cell_size!r}")
        if self.epsilon is not None and not 0.0 < self.epsilon <= 1.0:
            raise ValueError(f"epsilon: expected a change of color in (0, 1], got {self.epsilon!r}")
        if not 0.0 <= self.meters_per_unit < np.inf:
            raise ValueError(f"meters_per_unit: expected a finite number >= 0, got {self.meters_per_unit!r}")
        for name in ("level_views", "cost_views", "fidelity_views"):
            if getattr(self, name).count == 0:
                raise ValueError(f"{name}: expected at least one view, got none")

    @property
    def epsilon_from(self) -> str:
        """Source of epsilon, in words."""
        if self.epsilon is None:
            return "the staircase, with FLIP as observer"
        return "the default: FLIP as observer on two scenes" if self.epsilon == DEFAULT_EPSILON else "given"

    def as_dict(self) -> dict[str, Any]:
        """Return the options as plain numbers, strings and lists for JSON, with the source of epsilon.

        Backends are left out or "auto": the device decides only how results are rounded.
        """
        found = {**asdict(self), "epsilon_from": self.epsilon_from}
        del found["colors"]["backend"]
        if self.levels is not None:
            found["levels"] = decisive_options(self.levels)
        fit = found["colors"]["fit"]
        if not np.isfinite(fit["width_loss"]):  # JSON has no infinity
            fit["width_loss"] = None
        return found
