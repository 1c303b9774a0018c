"""The stage of the colors: the fit, and learning after it."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from typing import Any

from gsvis.color.records import QuantizedColors, quantize
from gsvis.color.srbf import SrbfColors
from gsvis.color.storage import load_srbf_colors, save_srbf, srbf_info
from gsvis.files.mapped import release_mapped
from gsvis.prepare.colors import find_kept, prepare_colors
from gsvis.prepare.learned_colors import (
    Learned,
    draw_lesson,
    learn_lesson,
    read_lesson,
    renders_teach,
    steps_of_learning,
)
from gsvis.prepare.stages import Stages, hash_levels
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.levels import Levels

__all__ = ["StageColors", "count_color_steps", "name_colors", "round_colors", "run_colors"]


@dataclass(frozen=True, eq=False)
class StageColors:
    """Colors of the union of the levels, and how they were found.

    Attributes:
        exact: The colors before rounding.
        directions: Source of the directions of the fit, in words.
        learned: What learning after the fit gained, as `Learned.as_dict` with a "remark"; None without learning.
    """

    exact: SrbfColors
    directions: str
    learned: dict[str, Any] | None


def count_color_steps(stages: Stages) -> int:
    """Return the steps of learning colors after the fit; 0 for a tile, which does not see its surroundings."""
    renders = stages.around is None and renders_teach(stages.highest)
    return steps_of_learning(stages.config.color_steps, photos=stages.photos is not None, renders=renders)


def name_colors(stages: Stages, levels: Levels, store: VisibilityStore) -> str:
    """Return the name of the file of colors."""
    seen = hashlib.sha256(store.direction_sets.tobytes()).hexdigest() if levels.union.sh_degree else None
    learned = _describe_lesson(stages)
    space = stages.space_hash if seen or learned else None
    config = asdict(stages.config.colors)
    del config["record_psnr"]  # which colors do not depend on
    del config["backend"]  # colors of any device are the same stage
    key = stages.key("colors", levels=hash_levels(levels), seen=seen, space=space, config=config, **learned)
    return f"colors-{key}.arrow"


def run_colors(stages: Stages, levels: Levels, store: VisibilityStore) -> StageColors:
    """Return the colors of the union before rounding, and how they were found."""
    name = name_colors(stages, levels, store)
    sets = store.direction_sets
    found_so_far = stages.work.at("directions")  # serves every variant: see `prepare_colors`
    kept = find_kept(levels, stages.space, stages.config.colors, found_so_far, sets=sets)
    if kept is not None:
        stages.work.at(kept.folder.name)
    with stages.stage("colors") as done:
        if not stages.work.whole(name):
            done.append(True)
            found = prepare_colors(
                levels, stages.space, stages.config.colors, sets=sets, keep=found_so_far, progress=stages.progress
            )
            provenance: dict[str, Any] = {"directions": found.sets_from}
            colors = stages.lay_away(found.fit.colors)
            del found
            stages.rest()
            if count_color_steps(stages):
                colors, learned = _learn(stages, levels, colors)
                stages.rest()
                provenance["learned"] = {**learned.as_dict(), "remark": learned.remark}
            save_srbf(stages.work.at(name), levels.union, colors, provenance=provenance)
            stages.work.seal_file(name)
            del colors
            stages.rest()
        path = stages.work.at(name)
        known = srbf_info(path).provenance
        exact = stages.lay_away(load_srbf_colors(path))
        made = StageColors(exact, str(known.get("directions")), known.get("learned"))
    stages.remarks += [made.learned["remark"]] if made.learned and made.learned["remark"] else []
    return made


def round_colors(stages: Stages, exact: SrbfColors) -> QuantizedColors:
    """Return colors as the package holds them."""
    return quantize(exact, stages.config.colors.precision, reach=stages.reach)


def _describe_lesson(stages: Stages) -> dict[str, Any]:
    """Return what decides the result of learning, for a key; empty without learning."""
    if not count_color_steps(stages):
        return {}
    images = {
        "photographs": stages.photos_hash,
        "size": stages.config.level_size,
        "seed": stages.config.level_views.seed,
    }
    return {"learned": {"steps": count_color_steps(stages), **images}}


def _learn(stages: Stages, levels: Levels, colors: SrbfColors) -> tuple[SrbfColors, Learned]:
    """Return colors of the union that were learned from photographs or renders of the highest level."""
    highest = stages.highest
    seed = stages.config.level_views.seed
    if stages.photos is None:
        lesson = draw_lesson(highest, stages.space, count_color_steps(stages), seed=seed)
    else:
        size = stages.config.level_size
        lesson, _ = read_lesson(
            highest, stages.photos, count_color_steps(stages), size=size, seed=seed, progress=stages.progress
        )  # the remarks are those of the levels
    stages.rest()

    def to_records(exact: SrbfColors) -> SrbfColors:
        """Round colors as the package does."""
        packed = round_colors(stages, exact)
        release_mapped(vars(exact).values())
        return packed.dequantize()

    shown = levels.member(len(levels) - 1)
    backend = stages.config.colors.backend
    folder = stages.scratch_folder
    return learn_lesson(
        levels.union, colors, lesson, to_records, shown=shown, backend=backend, folder=folder, progress=stages.progress
    )
