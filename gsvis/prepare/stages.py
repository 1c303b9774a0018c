"""The stages from a scene to a package. Each makes one piece in the working folder, or reuses it from there.

The name of a piece is a hash of its inputs' content and of its options, never of a path or a date. Each result is read
back from its file, so a resumed run gives the same bytes as an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.color.records import QuantizedColors, quantize
from gsvis.color.srbf import SrbfColors
from gsvis.color.storage import load_srbf, save_srbf, srbf_info
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.fields import parse_object
from gsvis.files.limits import read_whole
from gsvis.io.levels import MAP, levels_info, load_levels, save_levels
from gsvis.jobs.freed_memory import release_freed_memory
from gsvis.jobs.work_folder import WorkFolder, digest_of_folder
from gsvis.jobs.workers import Workers
from gsvis.package import Contents, Cost, ExactLevel, Fidelity, in_package_order, measure_cost, measure_fidelity
from gsvis.package.active_terms import colors_hash
from gsvis.package.cell_terms import CellTerms
from gsvis.package.rounding import Limits
from gsvis.prepare.active_terms import list_package_terms
from gsvis.prepare.calibration import OBSERVED, Epsilon, calibrate_by_flip
from gsvis.prepare.colors import ColorConfig, find_kept, prepare_colors
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.judged import judge_tile, small_views
from gsvis.prepare.learned_colors import (
    Learned,
    draw_lesson,
    learn_lesson,
    read_lesson,
    renders_teach,
    steps_of_learning,
)
from gsvis.prepare.levels import make_levels
from gsvis.prepare.memory import left_for_sets
from gsvis.prepare.record_limits import cameras_of_choice, choose_limits
from gsvis.prepare.surroundings import Surroundings
from gsvis.progress import Progress
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cell_count import MOST_CELLS, fitting_cells
from gsvis.pvs.cells import MAX_CELLS, CellGrid
from gsvis.pvs.fill import describe_overdraw, sample_fill_of_cells
from gsvis.pvs.joined import JoinedCells, join_until_small
from gsvis.pvs.judged import judge_sets
from gsvis.pvs.store import VisibilityStore
from gsvis.render.judges import JUDGES
from gsvis.scene.content import scene_hash, space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.level_views import LevelViews, draw_views, load_photograph_views

__all__ = ["VERSIONS", "StageColors", "StageRecord", "Stages", "around_of"]

VERSIONS = {
    "levels": 9,
    "sets": 5,
    "joined": 3,
    "colors": 3,
    "epsilon": 1,
    "rounding": 1,
    "cost": 2,
    "fidelity": 3,
    "judged": 3,
    "overdraw": 1,
    "terms": 1,
}
"""Version of the results of each stage; increase it when they change."""


@dataclass(frozen=True)
class StageRecord:
    """The record of a stage in this run.

    Attributes:
        name: "levels", "sets", "colors", "epsilon" if it has to be found, "rounding" if records are rounded, "cost",
            "fidelity", "terms" if they are stored, or "package".
        reused: Whether the whole result existed already.
        seconds: Time that it took in this run.
    """

    name: str
    reused: bool
    seconds: float


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


@dataclass(eq=False)
class Stages:
    """A scene, the options of its package, and the stages between them.

    Attributes:
        scene: The scene or levels, as given.
        space: The navigable space.
        config: The options.
        photos: Photos to train levels and learn colors on; None trains levels on renders of the scene.
        work: The folder that keeps the pieces.
        progress: Called with the progress stages of the functions that run.
        records: Records of the stages so far.
        remarks: Sentences that the user should read.
        around: Gaussians around the scene that belong to other packages; None for none.
        reach: Least and largest value of each component of base colors of all these packages; None for this one's own.
        one_level: Whether sets are found with one level in memory; see `build_pvs`.
        judges: Largest number of views by each rule that judge the sets.
        joined: Sizes of cells that were tried for the package; empty for a tile.
    """

    scene: Gaussians | Levels
    space: NavigableSpace
    config: PrepareConfig
    photos: str | os.PathLike[str] | None
    work: WorkFolder
    progress: Progress
    records: list[StageRecord]
    remarks: list[str]
    around: Surroundings | None = None
    reach: tuple[tuple[float, float], ...] | None = None
    one_level: bool = False
    judges: int = JUDGES
    joined: tuple[JoinedCells, ...] = ()

    @property
    def trains(self) -> bool:
        """Whether levels must be trained."""
        return not isinstance(self.scene, Levels) and self.config.levels is not None

    @cached_property
    def space_hash(self) -> str:
        """Hash of the navigable space, which is in the names of most pieces."""
        return space_hash(self.space)

    @cached_property
    def levels_name(self) -> str:
        """Name of the folder of the levels."""
        assert isinstance(self.scene, Gaussians)
        config = self.config
        if self.photos is None:
            views: dict[str, Any] = {
                "drawn": asdict(config.level_views),
                "held_out": config.level_held_out,
                "space": self.space_hash,
            }
        else:
            views = {"photographs": digest_of_folder(self.photos), "size": config.level_size}
        training = None if config.levels is None else asdict(config.levels)
        return "levels-" + self._key("levels", scene=scene_hash(self.scene), training=training, views=views)

    def reuse_levels(self) -> Levels | None:
        """Return the levels, in the order of a package, if no training is needed; None otherwise."""
        if isinstance(self.scene, Levels) or self.config.levels is None:
            self.progress("order", 0, 1)
            given = self.scene if isinstance(self.scene, Levels) else Levels.single(self.scene)
            found = in_package_order(given)
            self.progress("order", 1, 1)
            return found
        folder = self.work.at(self.levels_name)
        try:
            return load_levels(folder) if (folder / MAP).exists() else None
        except FormatError:
            return None

    def levels(self) -> tuple[Levels, dict[str, Any] | None]:
        """Return the levels in the order of a package, and the record of their quality; None if none were trained."""
        with self._stage("levels") as done:
            found = self.reuse_levels()
            if found is None:
                done.append(True)
                found = self._train(self.work.at(self.levels_name))
            extra = levels_info(self.work.at(self.levels_name)).extra if self.trains else None
        judged = (extra or {}).get("judged") or []
        self.remarks += [each["warning"] for each in judged if each["warning"]][:1]
        return found, extra

    def grid(self) -> CellGrid:
        """Return the cells."""
        size = self.config.cell_size
        return CellGrid.over(self.space, max_cells=self._most_cells if size is None else MAX_CELLS, cell_size=size)

    @cached_property
    def _most_cells(self) -> int:
        """Most cells, as configured or chosen."""
        scene = self.scene if isinstance(self.scene, Gaussians) else self.scene.level(len(self.scene) - 1)
        return self.config.cells or fitting_cells(scene, self.space, MOST_CELLS)

    def sets_name(self, levels: Levels, grid: CellGrid) -> str:
        """Return the name of the file of visible sets."""
        cells = {**grid.as_dict(), "coords": hashlib.sha256(grid.coords.astype("<i4").tobytes()).hexdigest()}
        space = self.space_hash
        config = self.config.sets.as_dict()
        around = {} if self.around is None else {"around": self.around.digest}
        return (
            f"sets-{self._key('sets', levels=_content(levels), grid=cells, space=space, config=config, **around)}.pvs"
        )

    def sets(self, levels: Levels, workers: Workers | None) -> Path:
        """Return the path of the store of visible sets."""
        grid = self.grid()
        name = self.sets_name(levels, grid)
        with self._stage("sets") as done:
            if not self.work.whole(name) or not (self.around is None or self.work.whole(around_of(name))):
                done.append(True)
                left = left_for_sets(workers, levels, len(levels.union), self.config.sets)
                self._find_sets(levels, grid, name, left)
        return self.work.at(name)

    def _find_sets(self, levels: Levels, grid: CellGrid, name: str, workers: Workers | None) -> None:
        """Write the store of visible sets, and that of the surroundings."""
        path = self.work.at(name)
        around = self.around

        def build(seen: Levels, target: Path) -> VisibilityStore:
            """Build the visible sets of some levels."""
            return build_pvs(
                seen,
                grid,
                self.space,
                target,
                self.config.sets,
                workers=workers,
                one_level=self.one_level,
                progress=self.progress,
            )

        if around is None:
            build(levels, path).close()
        else:
            both = self.work.at(f"joint-{name}")
            joint = around.joined(levels)
            around = self.around = replace(around, gaussians=joint.union[len(levels.union) :])  # the same, once
            with build(joint, both) as store:
                around.split(store, levels, path, self.work.at(around_of(name)), progress=self.progress)
            self.work.seal_file(around_of(name))
            both.unlink(missing_ok=True)
        self.work.seal_file(name)

    def shipped_sets(self, store: VisibilityStore) -> Path:
        """Return the path of the store that the package gets: shared direction sets, and joined cells if asked for.

        The store of a tile stays as it is: its surroundings have the same cells.
        """
        path = self.shipped_path(store.path)
        if path == store.path:
            return path
        record = self.work.at(path.with_suffix(".json").name)
        if not self.work.whole(path.name) or not self.work.whole(record.name):
            tried = join_until_small(store, path, may_join=self.config.join_cells, progress=self.progress)
            self.work.seal_file(path.name)
            self._keep(record.name, [asdict(each) for each in tried])
        self.joined = tuple(JoinedCells(**each) for each in json.loads(read_whole(record)))
        return path

    def shipped_path(self, sets: Path) -> Path:
        """Return the path of the store that the package gets, from that of the visible sets."""
        if self.around is not None or self.one_level:
            return sets
        key = self._key("joined", sets=digest_of_folder(sets).split()[0], join=self.config.join_cells)
        return self.work.at(f"joined-{key}.pvs")

    @property
    def color_steps(self) -> int:
        """Steps of learning colors after the fit; 0 for none. A tile, which does not see its surroundings, has none."""
        renders = self.around is None and renders_teach(self.highest)
        return steps_of_learning(self.config.color_steps, photos=self.photos is not None, renders=renders)

    def colors_name(self, levels: Levels, store: VisibilityStore) -> str:
        """Return the name of the file of colors."""
        seen = hashlib.sha256(store.direction_sets.tobytes()).hexdigest() if levels.union.sh_degree else None
        learned = self._lesson_record()
        space = self.space_hash if seen or learned else None
        config = asdict(self.config.colors)
        del config["record_psnr"]  # which colors do not depend on
        key = self._key("colors", levels=_content(levels), seen=seen, space=space, config=config, **learned)
        return f"colors-{key}.arrow"

    def colors(self, levels: Levels, store: VisibilityStore) -> StageColors:
        """Return the colors of the union before rounding, and how they were found."""
        name = self.colors_name(levels, store)
        sets = store.direction_sets
        found_so_far = self.work.at("directions")  # serves every variant: see `prepare_colors`
        kept = find_kept(levels, self.space, self.config.colors, found_so_far, sets=sets)
        if kept is not None:
            self.work.at(kept.folder.name)
        with self._stage("colors") as done:
            if not self.work.whole(name):
                done.append(True)
                found = prepare_colors(
                    levels, self.space, self.config.colors, sets=sets, keep=found_so_far, progress=self.progress
                )
                provenance: dict[str, Any] = {"directions": found.sets_from}
                colors = found.fit.colors
                if self.color_steps:
                    colors, learned = self._learn(levels, colors)
                    provenance["learned"] = {**learned.as_dict(), "remark": learned.remark}
                save_srbf(self.work.at(name), levels.union, colors, provenance=provenance)
                self.work.seal_file(name)
            path = self.work.at(name)
            known = srbf_info(path).provenance
            made = StageColors(load_srbf(path)[1], str(known.get("directions")), known.get("learned"))
        self.remarks += [made.learned["remark"]] if made.learned and made.learned["remark"] else []
        return made

    def rounded(self, exact: SrbfColors) -> QuantizedColors:
        """Return colors as the package holds them."""
        return quantize(exact, self.config.colors.precision, reach=self.reach)

    def _precision_record(self) -> dict[str, Any]:
        """Return what the precision of colors and of records adds to a key; empty for the usual ones."""
        names = ("precision", "record_psnr")
        given = {name: getattr(self.config.colors, name) for name in names}
        return {name: value for name, value in given.items() if value != getattr(ColorConfig, name)}

    def _lesson_record(self) -> dict[str, Any]:
        """Return what decides the result of learning, for a key; empty without learning."""
        if not self.color_steps:
            return {}
        photos = None if self.photos is None else digest_of_folder(self.photos)
        images = {"photographs": photos, "size": self.config.level_size, "seed": self.config.level_views.seed}
        return {"learned": {"steps": self.color_steps, **images}}

    def _learn(self, levels: Levels, colors: SrbfColors) -> tuple[SrbfColors, Learned]:
        """Return colors of the union that were learned from photographs or renders of the highest level."""
        highest = self.highest
        seed = self.config.level_views.seed
        if self.photos is None:
            lesson = draw_lesson(highest, self.space, self.color_steps, seed=seed, progress=self.progress)
        else:
            size = self.config.level_size
            lesson, _ = read_lesson(
                highest, self.photos, self.color_steps, size=size, seed=seed, progress=self.progress
            )  # the remarks are those of the levels

        def to_records(exact: SrbfColors) -> SrbfColors:
            """Round colors as the package does."""
            return self.rounded(exact).dequantize()

        shown = levels.member(len(levels) - 1)
        return learn_lesson(levels.union, colors, lesson, to_records, shown=shown, progress=self.progress)

    def epsilon_name(self, levels: Levels, packed: QuantizedColors) -> str:
        """Return the name of the file of an epsilon that the staircase finds."""
        colors = colors_hash(packed.dequantize())
        return f"epsilon-{self._key('epsilon', levels=_content(levels), colors=colors, space=self.space_hash)}.json"

    def epsilon(self, levels: Levels, packed: QuantizedColors) -> Epsilon:
        """Return epsilon, found by the staircase if the options do not say it."""
        if self.config.epsilon is not None:
            return Epsilon(self.config.epsilon)
        name = self.epsilon_name(levels, packed)
        with self._stage("epsilon") as done:
            if not self.work.whole(name):
                done.append(True)
                shown = levels.member(len(levels) - 1)
                drawn = levels.union[shown], packed.dequantize()[shown]
                calibration = calibrate_by_flip(levels, self.space, drawn, OBSERVED, progress=self.progress)
                made = Epsilon(DEFAULT_EPSILON) if calibration is None else Epsilon.from_staircase(calibration)
                self._keep(name, asdict(made))
            return Epsilon(**parse_object(self.work.at(name), read_whole(self.work.at(name))).value)

    def limits(self, levels: Levels, exact: SrbfColors, packed: QuantizedColors) -> Limits | None:
        """Return how records are rounded; None if they keep all bits."""
        wanted = self.config.colors.record_psnr
        if wanted is None:
            return None
        views = self.config.cost_views
        facts = {"views": asdict(views), "photos": self.photos and digest_of_folder(self.photos)}
        facts |= {"colors": colors_hash(exact), "space": self.space_hash, **self._precision_record()}
        name = f"rounding-{self._key('rounding', levels=_content(levels), **facts)}.json"
        with self._stage("rounding") as done:
            if not self.work.whole(name):
                done.append(True)
                cameras = cameras_of_choice(levels, self.space, views, self.photos)
                found = choose_limits(levels, exact, packed, cameras, wanted, progress=self.progress)
                self._keep(name, asdict(found))
            made = parse_object(self.work.at(name), read_whole(self.work.at(name))).value
        self.remarks += [] if made["limits"] else [f"records keep all bits: rounded ones have less than {wanted:g} dB"]
        return Limits(*made["limits"]) if made["limits"] else None

    def _keep(self, name: str, value: Any) -> None:
        """Write a piece of JSON to the working folder."""
        with atomic_path(self.work.at(name)) as partial:
            partial.write_text(json.dumps(value), encoding="ascii")
        self.work.seal_file(name)

    def cost_name(self, levels: Levels, exact: SrbfColors) -> str:
        """Return the name of the file of the cost of rounding."""
        facts = {"colors": colors_hash(exact), "views": asdict(self.config.cost_views), **self._precision_record()}
        key = self._key("cost", levels=_content(levels), space=self.space_hash, **facts)
        return f"cost-{key}.json"

    def cost(self, levels: Levels, exact: SrbfColors, packed: QuantizedColors, limits: Limits | None) -> Cost:
        """Return the cost of rounding in PSNR."""
        name = self.cost_name(levels, exact)
        with self._stage("cost") as done:
            if not self.work.whole(name):
                done.append(True)
                cameras = self.config.cost_views.cameras(levels, self.space)
                cost = measure_cost(levels, exact, packed, cameras, limits=limits, progress=self.progress)
                self._keep(name, asdict(cost))
            return Cost(**parse_object(self.work.at(name), read_whole(self.work.at(name))).value)

    def fidelity_name(self, levels: Levels, exact: SrbfColors, sets: Path, epsilon: float) -> str:
        """Return the name of the file of the fidelity."""
        key = self._key(
            "fidelity",
            scene=scene_hash(self.highest),
            levels=_content(levels),
            colors=colors_hash(exact),
            sets=digest_of_folder(sets).split()[0],
            epsilon=epsilon,
            views=asdict(self.config.fidelity_views),
            space=self.space_hash,
            **self._precision_record(),
        )
        return f"fidelity-{key}.json"

    def fidelity(
        self, levels: Levels, exact: SrbfColors, contents: Contents, store: VisibilityStore, epsilon: float
    ) -> Fidelity:
        """Return the final quality of records against the source scene, in views that are used for nothing else."""
        name = self.fidelity_name(levels, exact, store.path, epsilon)
        with self._stage("fidelity") as done:
            if not self.work.whole(name):
                done.append(True)
                member = levels.member(len(levels) - 1)
                terms = CellTerms(contents.gaussians(), contents.colors().dequantize(), store, epsilon)
                found = measure_fidelity(
                    self.highest,
                    contents,
                    self.config.fidelity_views.cameras(levels, self.space),
                    exact=ExactLevel(levels.union[member], exact[member]),
                    sets=store,
                    active=terms,
                    progress=self.progress,
                )
                self._keep(name, found.as_dict())
            return Fidelity.from_fields(parse_object(self.work.at(name), read_whole(self.work.at(name))))

    def cell_terms(self, levels: Levels, contents: Contents, store: VisibilityStore, epsilon: float) -> Path | None:
        """Return the path of the lists of active terms; None if they are computed when they are needed."""
        if self.config.cell_terms == "computed":
            return None
        colors = contents.colors().dequantize()
        sets = digest_of_folder(store.path).split()[0]
        key = self._key("terms", levels=_content(levels), colors=colors_hash(colors), sets=sets, epsilon=epsilon)
        name = f"active-{key}.terms.arrow"
        with self._stage("terms") as done:
            if not self.work.whole(name):
                done.append(True)
                g = contents.gaussians()
                list_package_terms(g, colors, store, epsilon, self.work.at(name), progress=self.progress)
                self.work.seal_file(name)
        return self.work.at(name)

    def judged(self, levels: Levels, store: VisibilityStore) -> dict[str, Any]:
        """Return the quality of the sets at eyes that are independent of navigable space."""
        views = small_views(self.config.fidelity_views, self.judges)
        around = None if self.around is None else (self.around, self.work.at(around_of(store.path.name)))
        witnesses = None if self.space.witnesses is None else self.space.witnesses.digest
        key = self._key(
            "judged",
            levels=_content(levels),
            sets=digest_of_folder(store.path).split()[0],
            views=asdict(views),
            space=self.space_hash,
            around=None if self.around is None else self.around.digest,
            witnesses=witnesses,
        )
        name = f"judged-{key}.json"
        if not self.work.whole(name):
            judge = partial(judge_sets, levels, self.space, store, views, progress=self.progress)
            if self.one_level or around is not None:
                judge = partial(judge_tile, levels, self.space, store, views, around, progress=self.progress)
            self._keep(name, judge().as_dict())
        record: dict[str, Any] = json.loads(read_whole(self.work.at(name)))
        if record["warning"]:
            self.remarks.append(record["warning"])
        return record

    def overdraw(self, levels: Levels, store: VisibilityStore) -> dict[str, Any]:
        """Return the overdraw of each cell, see `describe_overdraw`; with surroundings, of what cells see of both."""
        around = {} if self.around is None else {"around": self.around.digest}
        key = self._key("overdraw", levels=_content(levels), sets=digest_of_folder(store.path).split()[0], **around)
        name = f"overdraw-{key}.json"
        if not self.work.whole(name):
            with ExitStack() as opened:
                beyond = None
                if self.around is not None:
                    levels = self.around.joined(levels)
                    beyond = opened.enter_context(VisibilityStore.open(self.work.at(around_of(store.path.name))))
                found = describe_overdraw(sample_fill_of_cells(levels, store, beyond, progress=self.progress))
            self._keep(name, found)
        return dict(json.loads(read_whole(self.work.at(name))))

    @property
    def highest(self) -> Gaussians:
        """The scene as given, or its highest level."""
        return self.scene.level(len(self.scene) - 1) if isinstance(self.scene, Levels) else self.scene

    def _train(self, folder: Path) -> Levels:
        """Train, measure and save levels, and return them as saved."""
        assert isinstance(self.scene, Gaussians)
        assert self.config.levels is not None
        shutil.rmtree(folder, ignore_errors=True)
        begun = self.work.at(f"{folder.name}.begun")
        views = self._views()
        self.remarks += views.remarks
        for last in (False, True):
            try:
                made = make_levels(
                    self.scene, views, self.config.levels, work=begun, with_curve=False, progress=self.progress
                )
                break
            except FormatError:  # the kept work of an earlier run is damaged
                shutil.rmtree(begun, ignore_errors=True)
                if last:
                    raise
        record: dict[str, Any] = {"cameras": views.cameras_from}
        quality = made.quality
        if views.held_out is not None and quality is not None:
            record |= {
                "views": len(views.held_out),
                "width": views.held_out.cameras.width,
                "height": views.held_out.cameras.height,
                "psnr": _spreads(quality.scene_psnr),
            }
            if quality.photo_psnr is not None:
                record["psnr_photographs"] = _spreads(quality.photo_psnr)
        record["judged"] = [each.as_dict() for each in made.judged]
        save_levels(in_package_order(made.trained.levels), folder, record)
        shutil.rmtree(begun, ignore_errors=True)
        return load_levels(folder)

    def _views(self) -> LevelViews:
        """Return the views for training."""
        assert isinstance(self.scene, Gaussians)
        config = self.config
        if self.photos is not None:
            return load_photograph_views(self.scene, self.photos, config.level_size, progress=self.progress)
        return draw_views(self.scene, self.space, config.level_views, config.level_held_out, progress=self.progress)

    def _key(self, stage: str, **decides: Any) -> str:
        return self.work.key(stage, {"version": VERSIONS[stage], **decides})

    @contextmanager
    def _stage(self, name: str) -> Iterator[list[bool]]:
        """Record a stage. Yields a list; the caller appends to it if the stage had work to do."""
        began = time.perf_counter()
        done = list[bool]()
        yield done
        release_freed_memory()
        self.records.append(StageRecord(name, not done, time.perf_counter() - began))


def around_of(sets: str) -> str:
    """Return the name of the store of the surroundings' visible sets, from the name of the visible sets."""
    return f"around-{sets}"


def _content(levels: Levels) -> dict[str, Any]:
    """Return what identifies levels: hashes of Gaussians and membership, and names."""
    member = hashlib.sha256(levels.first.tobytes() + levels.last.tobytes()).hexdigest()
    return {"scene": scene_hash(levels.union), "names": list(levels.names), "member": member}


def _spreads(values: np.ndarray[Any, np.dtype[np.float64]]) -> list[dict[str, float]]:
    """Return the mean and the least value of each row of (L, C) values."""
    return [{"mean": float(row.mean()), "worst": float(row.min())} for row in values]
