"""Estimate the preparation of a package: what is done, what is left, and what it costs. Writes nothing.

Visible sets are estimated from a few cells, the other stages from a little of each (`trial`).
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsvis.color.records import bytes_per_term
from gsvis.color.srbf import SrbfColors
from gsvis.color.storage import load_srbf_colors
from gsvis.jobs.cost import machine_load
from gsvis.jobs.workers import Workers
from gsvis.prepare.calibration import OBSERVED
from gsvis.prepare.coded_size import bytes_of_record
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.memory import kept_memory, left_for_sets
from gsvis.prepare.prepare import stages_of
from gsvis.prepare.record_limits import LEARNED_TRIES
from gsvis.prepare.rounded_colors import STEPS
from gsvis.prepare.stage_colors import count_color_steps, name_colors, round_colors
from gsvis.prepare.stage_levels import name_levels, reuse_levels
from gsvis.prepare.stage_quality import name_cost, name_fidelity
from gsvis.prepare.stage_records import learns_rounded, name_epsilon, run_epsilon
from gsvis.prepare.stage_sets import find_shipped_sets, name_sets, shares_in_runs
from gsvis.prepare.stages import Stages
from gsvis.prepare.trial import StageTrial
from gsvis.progress import Progress, silent
from gsvis.pvs.coded_size import DIRECTIONS_BYTES, bytes_of_directions
from gsvis.pvs.estimate import estimate_pvs
from gsvis.pvs.joined import MOST_SHARE, RECORD_BYTES, measure_sets
from gsvis.pvs.memory import expected_memory
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.levels import SUBSETS

__all__ = ["PreparationEstimate", "StageEstimate", "estimate_preparation"]

_clock = time.perf_counter  # tests set another

_CODED = 1 << 15  # Gaussians that are coded for the size of records
_PACKED_TERM = 0.78  # size of coded terms over their raw size
_SHIPPED_SETS = 0.5  # of the bytes of sets but directions, completed with shared classes: 0.3 to 0.7 in eight scenes
_OBJECT_SETS = 0.25  # the same, when runs of Gaussians share how classes change: 0.23 to 0.27 in five objects
_SHARED_DIRECTIONS = 0.25  # bytes a Gaussian of direction sets that neighbors share: 0.1 to 0.3 in six scenes
_FILES = 10_000  # bytes of a package besides records, terms and sets
_ROUNDING = 20.0  # time of choosing how to round records over that of the views that measure the cost of rounding
_STAIRCASE = 15.0  # time of the staircase over that of the views that measure the cost of rounding
_IMAGES = 5  # of a view that measures what a client gets


@dataclass(frozen=True)
class StageEstimate:
    """The expected cost of a stage.

    Attributes:
        name: Name of the stage, as in `StageRecord`.
        state: "done" if its result exists; "begun" if a part of it exists; "to do"; or "given" if nothing is made.
        what: Description in words and counts.
        seconds: Time left.
        nbytes: Bytes of its result in the working folder.
    """

    name: str
    state: str
    what: str
    seconds: float
    nbytes: int


@dataclass(frozen=True)
class PreparationEstimate:
    """The expected cost of a preparation.

    Attributes:
        stages: The stages, in order.
        gaussians: N of the union of levels.
        levels: Names and sizes of levels, lowest first.
        cells: Cells of the visible sets.
        nbytes: Bytes of the package.
        sets_bytes: Bytes of the visible sets in it.
        saved_bytes: Bytes of Gaussians that they save on a walk. If they are not built yet, for a viewer who stays in
            one cell, against what the tried cells see together: a walk saves less, and more cells see more.
        memory: Peak bytes of memory of all processes while visible sets are built; if they exist, with one process that
            would build them. Training large levels may need more.
        seconds: Time left.
        load: Processes that used or waited for a core when the estimate began; None if unknown.
    """

    stages: tuple[StageEstimate, ...]
    gaussians: int
    levels: tuple[tuple[str, int], ...]
    cells: int
    nbytes: int
    sets_bytes: int
    saved_bytes: int
    memory: int
    seconds: float
    load: float | None

    @property
    def work_bytes(self) -> int:
        """Bytes of the working folder after the preparation."""
        return sum(stage.nbytes for stage in self.stages)


def estimate_preparation(
    scene: Gaussians | Levels,
    out: str | os.PathLike[str],
    space: NavigableSpace,
    config: PrepareConfig | None = None,
    *,
    photos: str | os.PathLike[str] | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> PreparationEstimate:
    """Estimate the cost of `prepare_package` with these arguments. Writes nothing.

    Raises:
        SceneError: If the scene has nothing to see.
        FormatError: If the target folder holds something else.
        ValueError: If the scene is too small for its levels, or the memory limit of `workers` is too small.
    """
    stages = stages_of(scene, out, space, config, photos=photos, progress=progress)
    return _Estimator(stages, workers or Workers()).all()


class _Estimator:
    """The estimate of one run."""

    def __init__(self, stages: Stages, workers: Workers) -> None:
        self.stages = stages
        self.workers = workers
        self.config = stages.config
        self.load = machine_load()
        self.known = reuse_levels(stages)
        self.levels = _stand_in(stages) if self.known is None else self.known
        self.counts = self.levels.counts if self.known is not None else _counts(stages)
        top = self.levels.counts[-1]
        self.union = len(self.levels.union) if self.known is not None else top + _own(stages)
        self.found: list[StageEstimate] = []
        self.saved = 0.0  # bytes that the sets save

    def all(self) -> PreparationEstimate:
        """Return the estimate of all stages."""
        self._levels()
        store, disk, memory = self._sets()
        shipped = self._shipped(store, disk)
        exact = self._colors(store)
        terms = exact.num_terms if exact is not None else self._expect_terms()
        epsilon = self._epsilon(exact)
        self._rounding(exact)
        self._cost(exact)
        self._fidelity(exact, store, epsilon)
        if store is not None:
            store.close()
        term_bytes = _PACKED_TERM * bytes_per_term(self.config.colors.fit.variant, self.config.colors.precision) * terms
        began = _clock()
        record = bytes_of_record(self.levels, _CODED)
        seconds = (_clock() - began) * self.union / min(_CODED, len(self.levels.union))
        nbytes = int(self.union * record + term_bytes + shipped) + _FILES
        what = f"{self.union:,} records, {terms:,} terms"
        self.found.append(StageEstimate("package", "to do", what, seconds, 0))
        return PreparationEstimate(
            tuple(self.found),
            self.union,
            tuple(zip(self.levels.names, self.counts, strict=True)),
            len(self.stages.grid),
            nbytes,
            int(shipped),
            int(self.saved),
            memory,
            sum(stage.seconds for stage in self.found),
            self.load,
        )

    def _levels(self) -> None:
        """Estimate the stage of the levels."""
        stages = self.stages
        config = self.config.levels
        sizes = ", ".join(f"{n} {c:,}" for n, c in zip(self.levels.names, self.counts, strict=True))
        if not stages.trains or config is None:
            self.found.append(StageEstimate("levels", "given", sizes, 0.0, 0))
            return
        nbytes = int(self._ply_bytes() * sum(self.counts)) + 18 * self.union
        if self.known is not None:
            self.found.append(StageEstimate("levels", "done", sizes, 0.0, nbytes))
            return
        chosen = (stages.work.at(f"{name_levels(stages)}.begun") / SUBSETS).exists()
        seconds = self.trial.training(config, photos=stages.photos is not None, chosen=chosen)
        what = f"{sizes}; {config.iterations:,} steps each"
        self.found.append(StageEstimate("levels", "begun" if chosen else "to do", what, seconds, nbytes))

    def _sets(self) -> tuple[VisibilityStore | None, int, int]:
        """Return the store if it exists, bytes on disk, and memory."""
        stages = self.stages
        grid = self.stages.grid
        kept = kept_memory(self.union, self.levels.union.sh_degree)
        name = name_sets(stages, self.levels, grid) if self.known is not None else "none"
        what = f"{len(grid):,} cells of side {grid.cell_size:.3g}"
        if stages.work.whole(name):
            path = stages.work.at(name)
            store = VisibilityStore.open(path)
            size = path.stat().st_size
            self.saved = measure_sets(store).saved
            self.found.append(StageEstimate("sets", "done", what, 0.0, size))
            return store, size, kept + expected_memory(self.levels, self.config.sets, 1)
        cost = estimate_pvs(
            self.levels,
            grid,
            stages.space,
            stages.work.at(name),
            self.config.sets,
            workers=left_for_sets(self.workers, self.levels, self.union, self.config.sets),
            progress=stages.progress,
        )
        scale = self.union / len(self.levels.union)
        disk = int(cost.disk * scale)
        self.saved = RECORD_BYTES * scale * (cost.ever - cost.visible)
        state = "begun" if cost.finished or cost.looked else "to do"
        if cost.finished:
            what += f", {cost.finished:,} of them found"
        self.found.append(StageEstimate("sets", state, what, cost.seconds, disk))
        return None, disk, kept + cost.memory

    def _shipped(self, store: VisibilityStore | None, disk: int) -> float:
        """Return the bytes of the sets in the package, which are completed, with shared directions and classes.

        Args:
            store: The store, if it exists.
            disk: Its bytes.
        """
        own = DIRECTIONS_BYTES * self.union if store is None else bytes_of_directions(store.direction_sets)
        rest = _OBJECT_SETS if shares_in_runs(self.stages) else _SHIPPED_SETS
        shared = rest * (disk - own) + _SHARED_DIRECTIONS * self.union
        most = MOST_SHARE * RECORD_BYTES * self.union  # see `join_until_small`
        return min(shared, most) if self.config.join_cells else shared

    def _colors(self, store: VisibilityStore | None) -> SrbfColors | None:
        """Return the colors if they exist."""
        stages = self.stages
        fit = self.config.colors.fit
        terms = self._expect_terms()
        aim = f"up to {terms:,} terms" if terms else "no terms: no color depends on direction"
        what = f"{self.union:,} colors, variant {fit.variant}; {aim}"
        nbytes = 60 * self.union + 25 * terms
        if store is not None:
            name = name_colors(stages, self.levels, store)
            if stages.work.whole(name):
                path = stages.work.at(name)
                exact = load_srbf_colors(path)
                what = f"{len(exact):,} colors, variant {exact.variant}, {exact.num_terms:,} terms"
                self.found.append(StageEstimate("colors", "done", what, 0.0, path.stat().st_size))
                return exact
        seconds = self.trial.colors(self.union)
        if count_color_steps(stages):
            seconds += self.trial.learning(count_color_steps(stages), photos=stages.photos is not None)
            what += f"; {count_color_steps(stages):,} steps of learning"
        self.found.append(StageEstimate("colors", "to do", what, seconds, nbytes))
        return None

    def _rounding(self, exact: SrbfColors | None) -> None:
        """Estimate the stage that chooses how to round records, if they are rounded."""
        if self.config.colors.record_psnr is None:
            return
        what = f"{2 * self.config.cost_views.count:,} views by each rule, several times"
        done = exact is not None and self.stages.work.whole(name_cost(self.stages, self.levels, exact))
        seconds = 0.0
        if not done:
            seconds += _ROUNDING * self.trial.cost()
        if learns_rounded(self.stages):
            steps = LEARNED_TRIES * STEPS
            seconds += 0.0 if done else self.trial.learning(steps, photos=False)
            what += f"; {steps:,} steps of learning"
        self.found.append(StageEstimate("rounding", "done" if done else "to do", what, seconds, 100))

    def _cost(self, exact: SrbfColors | None) -> None:
        """Estimate the stage that measures what rounding costs."""
        views = self.config.cost_views
        what = f"{views.count:,} views of {views.width} x {views.height}"
        if exact is not None and self.stages.work.whole(name_cost(self.stages, self.levels, exact)):
            self.found.append(StageEstimate("cost", "done", what, 0.0, 100))
            return
        seconds = self.trial.cost()
        self.found.append(StageEstimate("cost", "to do", what, seconds, 100))

    def _epsilon(self, exact: SrbfColors | None) -> float | None:
        """Estimate the stage that finds epsilon, if there is one; return epsilon, or None if it is not known yet."""
        stages = self.stages
        if self.config.epsilon is not None:
            return self.config.epsilon
        what = f"a staircase in {OBSERVED.count} views of {OBSERVED.width} x {OBSERVED.height}"
        if exact is not None:
            packed = round_colors(stages, exact)
            if stages.work.whole(name_epsilon(stages, self.levels, packed)):
                self.found.append(StageEstimate("epsilon", "done", what, 0.0, 4000))
                return run_epsilon(stages, self.levels, packed).value
        self.found.append(StageEstimate("epsilon", "to do", what, _STAIRCASE * self.trial.cost(), 4000))
        return None

    def _fidelity(self, exact: SrbfColors | None, store: VisibilityStore | None, epsilon: float | None) -> None:
        """Estimate the stage that compares the package with the scene."""
        stages = self.stages
        views = self.config.fidelity_views
        what = f"{views.count:,} views of {views.width} x {views.height}, {_IMAGES} images of each"
        if exact is not None and store is not None and epsilon is not None:
            shipped = find_shipped_sets(stages, store.path)
            if stages.work.whole(name_fidelity(stages, self.levels, exact, shipped, epsilon)):
                self.found.append(StageEstimate("fidelity", "done", what, 0.0, 4000))
                return
        seconds = self.trial.fidelity()
        self.found.append(StageEstimate("fidelity", "to do", what, seconds, 4000))

    @cached_property
    def trial(self) -> StageTrial:
        """A little of each stage."""
        return StageTrial(self.levels, self.stages.space, self.config, _clock)

    def _ply_bytes(self) -> float:
        return float(4 * (14 + 3 * self.levels.union.shN.shape[1]))

    def _expect_terms(self) -> int:
        """Return the expected number of terms of all Gaussians."""
        fit = self.config.colors.fit
        if self.levels.union.sh_degree == 0:
            return 0
        return int(self.union * (fit.max_terms if fit.mean_terms is None else min(fit.mean_terms, fit.max_terms)))


def _sizes(stages: Stages) -> list[tuple[int, int, int]]:
    """Return the sizes of the levels that training will make."""
    assert isinstance(stages.scene, Gaussians)
    assert stages.config.levels is not None
    return stages.config.levels.sizes(len(stages.scene))


def _counts(stages: Stages) -> tuple[int, ...]:
    assert isinstance(stages.scene, Gaussians)
    return (*(total for total, _, _ in _sizes(stages)), len(stages.scene))


def _own(stages: Stages) -> int:
    """Return the number of Gaussians that only lower levels have."""
    return sum(total - frozen for total, frozen, _ in _sizes(stages))


def _stand_in(stages: Stages) -> Levels:
    """Return levels of about the right sizes, from the Gaussians that cover most, to try a few cells with."""
    g = stages.scene
    config = stages.config.levels
    assert isinstance(g, Gaussians)
    assert config is not None
    order = np.argsort(-g.opacities * np.sort(g.scales, axis=1)[:, 1:].prod(axis=1), kind="stable")
    top = len(config.level_names) - 1
    first = np.full(len(g), top, np.uint8)
    for k, (total, _, _) in reversed(list(enumerate(_sizes(stages)))):
        first[order[:total]] = k
    return Levels(g, first, np.full(len(g), top, np.uint8), config.level_names)
