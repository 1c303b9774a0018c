"""Do all the work of `gsvis color`: fit the colors, write them, find epsilon and active terms, compare.

    fitted = color_scene(g, space, "scene.srbf.arrow", ColorOutputs(held_out=ViewSampling(8, stream=1)))

An interrupted fit resumes. Reports are written from the result by `gsvis.report`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.color.srbf import SrbfColors
from gsvis.color.storage import save_srbf
from gsvis.errors import OutputError
from gsvis.jobs.resume import KeptWork
from gsvis.prepare.active_terms import build_active_terms
from gsvis.prepare.calibration import OBSERVED, calibrate_by_flip
from gsvis.prepare.color_quality import ColorQualityConfig, measure_colors
from gsvis.prepare.colors import ColorConfig, ColorPreparation, find_kept, prepare_colors
from gsvis.prepare.fitted_colors import PRECISION_NAMES, FittedColors, round_colors
from gsvis.prepare.learned_colors import Learned, Lesson, learn_lesson
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, union_of
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["ColorOutputs", "color_scene"]


@dataclass(frozen=True)
class ColorOutputs:
    """What is written and measured besides the file of colors.

    Attributes:
        precision: Precision of the records: one of `PRECISION_NAMES`.
        epsilon: Contribution above which a term is active; None for none, or a calibrated one.
        calibrate: Whether to find epsilon by the model observer FLIP. This is not possible for a scene without terms or
            without navigable space.
        fallback: Epsilon if the calibration is not possible.
        active: File of the terms that each cell needs; written if there are visible sets and an epsilon.
        observed: Views of the model observer.
        held_out: Views in which the colors are compared with SH; None compares nothing.
        quality: What the comparison measures.
        made_by: Name and version of the program, for the file.
    """

    precision: str = "wire"
    epsilon: float | None = None
    calibrate: bool = False
    fallback: float | None = None
    active: str | os.PathLike[str] | None = None
    observed: ViewSampling = OBSERVED
    held_out: ViewSampling | None = None
    quality: ColorQualityConfig = field(default_factory=ColorQualityConfig)
    made_by: str = "gsvis"

    def __post_init__(self) -> None:
        _check.one_of("precision", self.precision, PRECISION_NAMES)


def color_scene(
    scene: Gaussians | Levels,
    space: NavigableSpace | None,
    out: str | os.PathLike[str],
    outputs: ColorOutputs | None = None,
    *,
    config: ColorConfig | None = None,
    store: VisibilityStore | None = None,
    lesson: Lesson | None = None,
    progress: Progress = silent,
) -> FittedColors:
    """Fit the colors of a scene, write them, and make the requested measurements.

    Args:
        scene: The scene, or its levels.
        space: The navigable space; None only for a scene of SH degree 0.
        out: The file of colors. An interrupted fit is kept beside it and resumes.
        outputs: What else to write and measure; None means `ColorOutputs()`.
        config: Options of the fit; None means `ColorConfig()`.
        store: Visible sets of the scene; None traces directions instead.
        lesson: Images that the fitted colors then learn from; None keeps the fit. Learning is not kept when it is
            interrupted: it begins anew from the fit, and ends the same.
        progress: Called with the stages of `prepare_colors`, then those of `learn_lesson`, "records", "epsilon",
            "terms" and those of `measure_colors`.

    Returns:
        The colors and the figures.

    Raises:
        ValueError: If there is no navigable space for a scene with view dependence, or the store has another scene.
        SceneError: If the scene has nothing to see, or no viewpoint is usable.
        OutputError: If a file cannot be written; the message says what is kept.
        KeyboardInterrupt: If it is interrupted; the message says what is kept.
    """
    outputs = outputs or ColorOutputs()
    config = config or ColorConfig()
    sets = None if store is None else store.direction_sets
    kept = find_kept(scene, space, config, out, sets=sets)
    with _keeping(kept):
        found = prepare_colors(scene, space, config, sets=sets, keep=out, progress=progress)
        shown = scene.member(len(scene) - 1) if isinstance(scene, Levels) else None
        learned: Learned | None = None
        if lesson is not None:
            found, learned = _learn(
                union_of(scene),
                found,
                lesson,
                precision=outputs.precision,
                shown=shown,
                backend=config.backend,
                progress=progress,
            )
        progress("records", 0, 1)
        colors = round_colors(found.fit.colors, outputs.precision)
        progress("records", 1, 1)
        fitted = FittedColors(
            union_of(scene), colors, found, outputs.precision, 0, outputs.epsilon, shown=shown, learned=learned
        )
        if outputs.calibrate and outputs.epsilon is None:
            calibration = calibrate_by_flip(scene, space, fitted.drawn, outputs.observed, progress=progress)
            epsilon = outputs.fallback if calibration is None else calibration.epsilon
            fitted = replace(fitted, epsilon=epsilon, calibration=calibration)
        _write(scene, out, outputs, config, fitted)
        fitted = replace(fitted, file_bytes=Path(out).stat().st_size)
    if kept is not None:
        kept.remove()
    with _written(out):
        return _examine(scene, space, outputs, store, fitted, progress)


def _learn(
    g: Gaussians,
    found: ColorPreparation,
    lesson: Lesson,
    *,
    precision: str,
    shown: NDArray[np.bool_] | None,
    backend: str,
    progress: Progress,
) -> tuple[ColorPreparation, Learned]:
    """Return a preparation with learned colors, and what was gained."""

    def to_records(colors: SrbfColors) -> SrbfColors:
        """Round colors as the file does."""
        return round_colors(colors, precision)

    colors, learned = learn_lesson(
        g, found.fit.colors, lesson, to_records, shown=shown, backend=backend, progress=progress
    )
    return replace(found, fit=replace(found.fit, colors=colors)), learned


@contextmanager
def _keeping(kept: KeptWork | None) -> Iterator[None]:
    """State in errors of the block that unfinished work is kept."""
    try:
        yield
    except KeyboardInterrupt:
        if kept is None or not kept.folder.exists():
            raise
        message = f"what was found is kept in {kept.folder.name}; run the same command to resume"
        raise KeyboardInterrupt(message) from None
    except OutputError as error:
        if kept is None or not kept.folder.exists():
            raise
        raise error.keeping(f"what was found is kept in {kept.folder.name}") from error


@contextmanager
def _written(out: str | os.PathLike[str]) -> Iterator[None]:
    """State in errors of the block that the file of colors is written."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{out} is written, what else was asked for may not be") from None
    except OutputError as error:
        raise error.keeping(f"{out} is written") from error


def _write(
    scene: Gaussians | Levels,
    out: str | os.PathLike[str],
    outputs: ColorOutputs,
    config: ColorConfig,
    fitted: FittedColors,
) -> None:
    """Write the file of colors."""
    found: ColorPreparation = fitted.preparation
    levels: list[dict[str, Any]] | None = None
    if isinstance(scene, Levels):
        levels = [{"name": name, "gaussians": n} for name, n in zip(scene.names, scene.counts, strict=True)]
    provenance = {
        "made_by": outputs.made_by,
        "fit": asdict(config.fit),
        "views": asdict(config.views),
        "directions": found.sets_from,
        "levels": levels,
        "learned": None if fitted.learned is None else fitted.learned.as_dict(),
        "epsilon": fitted.epsilon,
        "epsilon_from": None if fitted.calibration is None else fitted.calibration.as_dict(),
    }
    exact: SrbfColors = found.fit.colors
    precision = None if outputs.precision == "exact" else outputs.precision
    save_srbf(out, fitted.gaussians, exact, precision=precision, provenance=provenance)


def _examine(
    scene: Gaussians | Levels,
    space: NavigableSpace | None,
    outputs: ColorOutputs,
    store: VisibilityStore | None,
    fitted: FittedColors,
    progress: Progress,
) -> FittedColors:
    """Build active terms and compare with SH, once the file of colors is written."""
    epsilon = fitted.epsilon
    if outputs.active is not None and store is not None and epsilon is not None:
        text = "given" if fitted.calibration is None else "the model observer FLIP"
        with build_active_terms(
            fitted.colors, fitted.gaussians, store, epsilon, outputs.active, provenance=text, progress=progress
        ) as active:
            shares = np.array([active.share(cell).of_all for cell in range(len(active))])
        fitted = replace(fitted, cell_shares=shares)
    if outputs.held_out is None or space is None:
        return fitted
    quality = outputs.quality
    if epsilon is not None:
        quality = replace(quality, epsilons=tuple(sorted({*quality.epsilons, epsilon})))
    views = outputs.held_out.cameras(scene, space)
    return replace(fitted, quality=measure_colors(*fitted.drawn, views, quality, progress=progress))
