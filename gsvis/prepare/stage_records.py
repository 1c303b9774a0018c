"""The stages between colors and records: epsilon, rounding, and lists of active terms."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.color.records import QuantizedColors
from gsvis.color.srbf import SrbfColors
from gsvis.jobs.work_folder import digest_of_folder
from gsvis.package import Contents
from gsvis.package.active_terms import colors_hash
from gsvis.package.rounding import Limits
from gsvis.prepare.active_terms import list_package_terms
from gsvis.prepare.calibration import OBSERVED, Epsilon, calibrate_by_flip
from gsvis.prepare.colors import ColorConfig
from gsvis.prepare.record_limits import cameras_of_choice, choose_limits
from gsvis.prepare.stages import Stages, hash_levels
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.levels import Levels

__all__ = ["describe_precision", "name_epsilon", "run_epsilon", "run_rounding", "run_terms"]


def describe_precision(stages: Stages) -> dict[str, Any]:
    """Return what the precision of colors and of records adds to a key; empty for the usual ones."""
    names = ("precision", "record_psnr")
    given = {name: getattr(stages.config.colors, name) for name in names}
    return {name: value for name, value in given.items() if value != getattr(ColorConfig, name)}


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


def run_rounding(stages: Stages, levels: Levels, exact: SrbfColors, packed: QuantizedColors) -> Limits | None:
    """Return how records are rounded; None if they keep all bits."""
    wanted = stages.config.colors.record_psnr
    if wanted is None:
        return None
    views = stages.config.cost_views
    facts = {"views": asdict(views), "photos": stages.photos_hash}
    facts |= {"colors": colors_hash(exact), "space": stages.space_hash, **describe_precision(stages)}
    name = f"rounding-{stages.key('rounding', levels=hash_levels(levels), **facts)}.json"
    with stages.stage("rounding") as done:
        if not stages.work.whole(name):
            done.append(True)
            cameras = cameras_of_choice(levels, stages.space, views, stages.photos)
            found = choose_limits(levels, exact, packed, cameras, wanted, progress=stages.progress)
            stages.keep(name, asdict(found))
        made = stages.read(name).value
    stages.remarks += [] if made["limits"] else [f"records keep all bits: rounded ones have less than {wanted:g} dB"]
    return Limits(*made["limits"]) if made["limits"] else None


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
