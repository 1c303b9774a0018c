"""The stages that measure a package: cost, fidelity, sets at independent eyes, overdraw."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from gsvis.color.records import QuantizedColors
from gsvis.color.srbf import SrbfColors
from gsvis.jobs.work_folder import digest_of_folder
from gsvis.package import Contents, Cost, ExactLevel, Fidelity, measure_cost, measure_fidelity
from gsvis.package.active_terms import colors_hash
from gsvis.package.cell_terms import CellTerms
from gsvis.package.rounding import Limits
from gsvis.prepare.judged import judge_tile, small_views
from gsvis.prepare.stage_records import describe_precision
from gsvis.prepare.stage_sets import around_of
from gsvis.prepare.stages import Stages, hash_levels
from gsvis.pvs.fill import describe_overdraw, sample_fill_of_cells
from gsvis.pvs.judged import judge_sets
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.levels import Levels

__all__ = ["name_cost", "name_fidelity", "run_cost", "run_fidelity", "run_judges", "run_overdraw"]


def name_cost(stages: Stages, levels: Levels, exact: SrbfColors) -> str:
    """Return the name of the file of the cost of rounding."""
    facts = {"colors": colors_hash(exact), "views": asdict(stages.config.cost_views), **describe_precision(stages)}
    key = stages.key("cost", levels=hash_levels(levels), space=stages.space_hash, **facts)
    return f"cost-{key}.json"


def run_cost(stages: Stages, levels: Levels, exact: SrbfColors, packed: QuantizedColors, limits: Limits | None) -> Cost:
    """Return the cost of rounding in PSNR."""
    name = name_cost(stages, levels, exact)
    with stages.stage("cost") as done:
        if not stages.work.whole(name):
            done.append(True)
            cameras = stages.config.cost_views.cameras(levels, stages.space)
            cost = measure_cost(levels, exact, packed, cameras, limits=limits, progress=stages.progress)
            stages.keep(name, asdict(cost))
        return Cost(**stages.read(name).value)


def name_fidelity(stages: Stages, levels: Levels, exact: SrbfColors, sets: Path, epsilon: float) -> str:
    """Return the name of the file of the fidelity."""
    key = stages.key(
        "fidelity",
        scene=stages.scene_hash,
        levels=hash_levels(levels),
        colors=colors_hash(exact),
        sets=digest_of_folder(sets).split()[0],
        epsilon=epsilon,
        views=asdict(stages.config.fidelity_views),
        space=stages.space_hash,
        **describe_precision(stages),
    )
    return f"fidelity-{key}.json"


def run_fidelity(
    stages: Stages, levels: Levels, exact: SrbfColors, contents: Contents, store: VisibilityStore, epsilon: float
) -> Fidelity:
    """Return the final quality of records against the source scene, in views that are used for nothing else."""
    name = name_fidelity(stages, levels, exact, store.path, epsilon)
    with stages.stage("fidelity") as done:
        if not stages.work.whole(name):
            done.append(True)
            member = levels.member(len(levels) - 1)

            def terms() -> CellTerms:
                """Return what finds the terms of cells."""
                return CellTerms(contents.gaussians(), contents.colors().dequantize(), store, epsilon)

            found = measure_fidelity(
                stages.highest,
                contents,
                stages.config.fidelity_views.cameras(levels, stages.space),
                exact=ExactLevel(levels.union.showing(member), exact),
                sets=store,
                active=terms,
                progress=stages.progress,
            )
            stages.keep(name, found.as_dict())
        return Fidelity.from_fields(stages.read(name))


def run_judges(stages: Stages, levels: Levels, store: VisibilityStore) -> dict[str, Any]:
    """Return the quality of the sets at eyes that are independent of navigable space."""
    views = small_views(stages.config.fidelity_views, stages.judges)
    around = None if stages.around is None else (stages.around, stages.work.at(around_of(store.path.name)))
    witnesses = None if stages.space.witnesses is None else stages.space.witnesses.digest
    key = stages.key(
        "judged",
        levels=hash_levels(levels),
        sets=digest_of_folder(store.path).split()[0],
        views=asdict(views),
        space=stages.space_hash,
        around=None if stages.around is None else stages.around.digest,
        witnesses=witnesses,
    )
    name = f"judged-{key}.json"
    if not stages.work.whole(name):
        judge = partial(judge_sets, levels, stages.space, store, views, progress=stages.progress)
        if stages.one_level or around is not None:
            judge = partial(judge_tile, levels, stages.space, store, views, around, progress=stages.progress)
        stages.keep(name, judge().as_dict())
        stages.rest()
    record: dict[str, Any] = stages.read(name).value
    if record["warning"]:
        stages.remarks.append(record["warning"])
    return record


def run_overdraw(stages: Stages, levels: Levels, store: VisibilityStore) -> dict[str, Any]:
    """Return the overdraw of each cell, see `describe_overdraw`; with surroundings, of what cells see of both."""
    around = {} if stages.around is None else {"around": stages.around.digest}
    key = stages.key("overdraw", levels=hash_levels(levels), sets=digest_of_folder(store.path).split()[0], **around)
    name = f"overdraw-{key}.json"
    if not stages.work.whole(name):
        with ExitStack() as opened:
            beyond = None
            if stages.around is not None:
                levels = stages.around.joined(levels)
                beyond = opened.enter_context(VisibilityStore.open(stages.work.at(around_of(store.path.name))))
            found = describe_overdraw(sample_fill_of_cells(levels, store, beyond, progress=stages.progress))
        stages.keep(name, found)
    return stages.read(name).value
