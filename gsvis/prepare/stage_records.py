"""The stages between colors and records: epsilon, rounding, and lists of active terms."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from gsvis._extras import has
from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.color.records import QuantizedColors, quantize
from gsvis.color.srbf import SrbfColors
from gsvis.color.storage import load_srbf_colors, save_srbf
from gsvis.jobs.work_folder import digest_of_folder
from gsvis.package import Contents
from gsvis.package.active_terms import colors_hash
from gsvis.package.rounding import Limits
from gsvis.prepare.active_terms import list_package_terms
from gsvis.prepare.calibration import OBSERVED, Epsilon, calibrate_by_flip
from gsvis.prepare.colors import ColorConfig
from gsvis.prepare.record_limits import RecordLimits, cameras_of_choice, choose_limits
from gsvis.prepare.rounded_colors import RecordLesson
from gsvis.prepare.stages import Stages, hash_levels
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.levels import Levels

__all__ = ["describe_precision", "learns_rounded", "name_epsilon", "run_epsilon", "run_rounding", "run_terms"]


def describe_precision(stages: Stages) -> dict[str, Any]:
    """Return what the precision of colors and of records adds to a key; empty for the usual ones."""
    names = ("precision", "record_psnr")
    given = {name: getattr(stages.config.colors, name) for name in names}
    known = {name: value for name, value in given.items() if value != getattr(ColorConfig, name)}
    return known | ({"learned": True} if "record_psnr" in known and learns_rounded(stages) else {})


def name_epsilon(stages: Stages, levels: Levels, packed: QuantizedColors) -> str:
    """Return the name of the file of an epsilon that the staircase finds."""
    colors = colors_hash(packed.dequantize())
    return f"epsilon-{stages.key('epsilon', levels=hash_levels(levels), colors=colors, space=stages.space_hash)}.json"


def run_epsilon(stages: Stages, levels: Levels, packed: QuantizedColors) -> Epsilon:
    """Return epsilon, found by the staircase if the options do not say it."""
    if stages.config.epsilon is not None:
        return Epsilon(stages.config.epsilon)
    name = name_epsilon(stages, levels, packed)
    with stages.stage("epsilon") as done:
        if not stages.work.whole(name):
            done.append(True)
            shown = levels.member(len(levels) - 1)
            drawn = levels.union[shown], packed.dequantize()[shown]
            calibration = calibrate_by_flip(levels, stages.space, drawn, OBSERVED, progress=stages.progress)
            made = Epsilon(DEFAULT_EPSILON) if calibration is None else Epsilon.from_staircase(calibration)
            stages.keep(name, asdict(made))
        return Epsilon(**stages.read(name).value)


def learns_rounded(stages: Stages) -> bool:
    """Return whether colors are learned once records are rounded: unless somebody wants no learning; needs torch."""
    return stages.config.color_steps != 0 and has("torch")


def run_rounding(
    stages: Stages, levels: Levels, exact: SrbfColors, packed: QuantizedColors
) -> tuple[Limits | None, QuantizedColors]:
    """Return how records are rounded, None if they keep all bits; and the colors of these records."""
    wanted = stages.config.colors.record_psnr
    if wanted is None:
        return None, packed
    views = stages.config.cost_views
    facts = {"views": asdict(views), "photos": stages.photos_hash}
    facts |= {"colors": colors_hash(exact), "space": stages.space_hash, **describe_precision(stages)}
    key = stages.key("rounding", levels=hash_levels(levels), **facts)
    name = f"rounding-{key}.json"
    learned = f"rounded-{key}.arrow"
    with stages.stage("rounding") as done:
        if not (stages.work.whole(name) and stages.work.whole(learned)):
            done.append(True)
            found = _round(stages, levels, exact, packed, wanted)
            save_srbf(stages.work.at(learned), levels.union, packed if found.colors is None else found.colors)
            stages.work.seal_file(learned)
            figures = {name: getattr(found, name) for name in ("limits", "finer", "psnr", "worst")}
            stages.keep(name, {**figures, "learned": found.colors is not None})
        made = stages.read(name).value
        rounded = load_srbf_colors(stages.work.at(learned))
    stages.remarks += [] if made["limits"] else [f"records keep all bits: rounded ones have less than {wanted:g} dB"]
    limits = Limits(*made["limits"]) if made["limits"] else None
    return limits, quantize(rounded, grids=packed.grids, refit=False)


def _round(stages: Stages, levels: Levels, exact: SrbfColors, packed: QuantizedColors, wanted: float) -> RecordLimits:
    """Choose how records are rounded, and learn their colors."""
    cameras = cameras_of_choice(levels, stages.space, stages.config.cost_views, stages.photos)
    lesson = None
    if learns_rounded(stages):
        lesson = RecordLesson.draw(levels, exact, packed, stages.space, stages.photos)
        lesson = replace(lesson, backend=stages.config.colors.backend)
    return choose_limits(levels, exact, packed, cameras, wanted, lesson=lesson, progress=stages.progress)


def run_terms(
    stages: Stages, levels: Levels, contents: Contents, store: VisibilityStore, epsilon: float
) -> Path | None:
    """Return the path of the lists of active terms; None if they are computed when they are needed."""
    if stages.config.cell_terms == "computed":
        return None
    colors = contents.colors().dequantize()
    sets = digest_of_folder(store.path).split()[0]
    key = stages.key("terms", levels=hash_levels(levels), colors=colors_hash(colors), sets=sets, epsilon=epsilon)
    name = f"active-{key}.terms.arrow"
    with stages.stage("terms") as done:
        if not stages.work.whole(name):
            done.append(True)
            g = contents.gaussians()
            list_package_terms(g, colors, store, epsilon, stages.work.at(name), progress=stages.progress)
            stages.work.seal_file(name)
    return stages.work.at(name)
