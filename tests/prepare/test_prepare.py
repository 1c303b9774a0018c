"""From a scene to a package as a library call: what comes out, what is made again, and what a stop leaves."""

from __future__ import annotations

import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsvis.color.fit import FitConfig
from gsvis.color.records import PRECISIONS
from gsvis.errors import FormatError, SceneError
from gsvis.files.shelf import Shelf
from gsvis.jobs.workers import Workers
from gsvis.package import Package, Spread, in_package_order
from gsvis.package.fidelity import STEPS
from gsvis.prepare import (
    PrepareConfig,
    Prepared,
    estimate_preparation,
    learned_colors,
    prepare_package,
    rounded_colors,
)
from gsvis.prepare import estimate as estimates
from gsvis.prepare.colors import ColorConfig
from gsvis.pvs import estimate as pvs_estimates
from gsvis.pvs import joined as joined_cells
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.fill import read_overdraw
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OccluderScene, two_rooms
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.levels import LevelsConfig
from tests.train.photo_files import write_transforms

FEW = ViewSampling(2, 24, 20)
CONFIG = PrepareConfig(
    levels=LevelsConfig(iterations=2),
    level_views=FEW,
    level_held_out=1,
    cells=4,
    sets=PvsConfig(size=16, rays=256, max_inner=1),
    colors=ColorConfig(FitConfig(max_terms=2, refine=False), FEW),
    cost_views=replace(FEW, stream=3),
    fidelity_views=replace(FEW, stream=5),
    meters_per_unit=0.5,
    color_steps=0,
)
STAGES = ["levels", "sets", "colors", "cost", "fidelity", "package"]


@pytest.fixture(scope="module")
def rooms() -> OccluderScene:
    return small(two_rooms(1000, sh_degree=1))


def small(scene: OccluderScene) -> OccluderScene:
    """The same with a coarse space, which is quick to spread viewpoints in."""
    return replace(scene, navigable=NavigableSpace.from_box((0.5, 0.5, 0.6), (7.5, 3.5, 2.4), 14))


@pytest.fixture(scope="module")
def made(rooms: OccluderScene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Prepared]:
    out = tmp_path_factory.mktemp("made") / "rooms.gsvis"
    return out, prepare(rooms, out)


@pytest.fixture
def again(made: tuple[Path, Prepared], tmp_path: Path) -> Path:
    """A copy of the package with what is kept beside it."""
    for suffix in ("", ".work"):
        shutil.copytree(made[0].with_name(made[0].name + suffix), tmp_path / f"rooms.gsvis{suffix}")
    return tmp_path / "rooms.gsvis"


def prepare(rooms: OccluderScene, out: Path, config: PrepareConfig = CONFIG, **more: Any) -> Prepared:
    return prepare_package(rooms.gaussians, out, rooms.navigable, config, about={"scene": "rooms"}, **more)


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def new(found: Prepared) -> list[str]:
    """Stages that were not there already."""
    return [stage.name for stage in found.stages if not stage.reused]


def test_records_are_rounded_from_what_is_kept(again: Path, rooms: OccluderScene) -> None:
    before = prepare(rooms, again).manifest
    config = replace(CONFIG, colors=replace(CONFIG.colors, record_psnr=40.0))
    wanted = ["rounding", "cost", "fidelity", "package"]
    dry = estimate_preparation(rooms.gaussians, again, rooms.navigable, config)
    assert [stage.name for stage in dry.stages if stage.state == "to do"] == wanted
    found = prepare(rooms, again, config)
    assert new(found) == wanted
    assert found.manifest.limits is not None
    assert found.manifest.info.cost is not None
    assert found.manifest.info.cost.psnr > 34.0  # 40 dB in other views
    assert all(found.manifest.sizes()[name] < before.sizes()[name] for name in ("records", "terms"))
    assert not new(prepare(rooms, again, config))


def test_colors_of_rounded_records_are_learned_once(
    again: Path, rooms: OccluderScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned_colors, "RENDERS", ViewSampling(9, 24, 20))
    monkeypatch.setattr(rounded_colors, "LESSON", ViewSampling(8, 24, 20, stream=13))
    monkeypatch.setattr(rounded_colors, "STEPS", 4)
    config = replace(CONFIG, colors=replace(CONFIG.colors, record_psnr=40.0), color_steps=2)
    assert "rounding" in new(prepare(rooms, again, config))
    before = files(again)
    shutil.rmtree(again)
    assert new(prepare(rooms, again, config)) == ["package"]
    assert files(again) == before


def test_a_package_holds_everything_that_a_server_needs(made: tuple[Path, Prepared], rooms: OccluderScene) -> None:
    out, found = made
    with Package.open(out) as package:
        checked = package.verify()
        assert (checked.gaussians, checked.terms, checked.strays) == (found.manifest.gaussians, found.manifest.terms, 0)
        assert 0 < checked.cells <= 4
        assert package.epsilon == package.active_terms.epsilon == CONFIG.epsilon
        info = package.manifest.info
    assert found.manifest.counts[-1] == len(rooms.gaussians)
    assert found.manifest.terms > 0
    assert info.up == (0.0, 0.0, 1.0)
    assert info.meters_per_unit == 0.5
    assert info.cost is not None
    assert 30 < info.cost.worst <= info.cost.psnr
    assert info.fidelity is not None
    assert tuple(info.fidelity.steps) == STEPS
    assert info.fidelity.steps["levels"] == Spread(100.0, 100.0)
    assert info.fidelity.cell is not None
    assert 15 < info.fidelity.records.worst <= info.fidelity.records.psnr < 100
    assert info.provenance["scene"] == "rooms"
    overdraw = read_overdraw(info.provenance["overdraw"], checked.cells)
    assert overdraw is not None
    assert (overdraw.worst >= overdraw.mean).all()
    assert info.provenance["config"]["cells"] == 4
    assert [row["worst"] for row in info.provenance["levels"]["psnr"]][-1] == 100.0
    assert [stage.name for stage in found.stages] == STAGES == new(found)
    assert (found.parts_kept, found.nbytes_kept) == (0, 0)
    assert found.parts == checked.parts
    assert found.work_bytes == sum(map(len, files(found.work).values()))


def test_nothing_is_made_twice(again: Path, rooms: OccluderScene) -> None:
    before = files(again)
    found = prepare(rooms, again)
    assert new(found) == []
    assert found.parts_kept == found.parts
    assert files(again) == before


def test_an_option_changes_only_what_depends_on_it(
    again: Path, rooms: OccluderScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert new(prepare(rooms, again, replace(CONFIG, epsilon=0.3))) == ["fidelity"]
    assert new(prepare(rooms, again, replace(CONFIG, epsilon=0.3, meters_per_unit=2.0))) == []  # parts, that is
    flat = replace(CONFIG, epsilon=0.3, colors=replace(CONFIG.colors, fit=FitConfig(max_terms=0)))
    stages: list[str] = []
    found = prepare(rooms, again, flat, progress=lambda stage, done, total: stages.append(stage))
    assert new(found) == ["colors", "cost", "fidelity", "package"]
    assert "importance" not in stages  # what views found serves every fit
    assert found.manifest.terms == 0
    monkeypatch.setattr(joined_cells, "MOST_SHARE", 0.0)  # no set is small enough
    joined = prepare(rooms, again, replace(flat, join_cells=True))
    assert new(joined) == ["fidelity", "package"]
    assert 1 == joined.joined[-1].cells < joined.joined[0].cells == found.joined[0].cells
    assert new(prepare(rooms, again, replace(flat, cells=1)))[0] == "sets"
    kept = {path.name.partition("-")[0] for path in found.work.iterdir() if not path.name.endswith(".sha256")}
    pieces = {"levels", "sets", "joined", "colors", "cost", "fidelity", "judged", "overdraw"}
    assert kept == {"gsvis", "plan.json", "directions.partial", *pieces}
    assert len([path for path in found.work.iterdir() if path.name.endswith(".pvs")]) == 2  # old pieces have gone


@pytest.mark.parametrize("stop", ["train medium", "viewpoints", "cells", "importance", "fidelity", "package"])
def test_a_run_that_is_stopped_goes_on_and_gives_the_same_bytes(
    stop: str, made: tuple[Path, Prepared], rooms: OccluderScene, tmp_path: Path
) -> None:
    out = tmp_path / "rooms.gsvis"
    if stop != "train medium":  # what comes before has been seen to go on
        levels = next(made[1].work.glob("levels-*"))
        shutil.copytree(levels, tmp_path / "rooms.gsvis.work" / levels.name)
        (tmp_path / "rooms.gsvis.work" / "gsvis-prepare").touch()

    def stops(stage: str, done: int, total: int) -> None:
        if stage == stop and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(rooms, out, progress=stops)
    assert not (out / "manifest.json").exists()
    calls: list[tuple[str, int]] = []
    prepare(rooms, out, progress=lambda stage, done, total: calls.append((stage, done)))
    assert files(out) == files(made[0])
    stages = [stage for stage, _ in calls]
    if stop == "train medium":
        assert "prune" not in stages
    else:
        assert not {"views", "prune"} & set(stages)
    if stop in ("viewpoints", "cells"):
        assert min(done for stage, done in calls if stage == stop) == 1
    if stop in ("fidelity", "package"):
        assert not {"viewpoints", "cells", "importance", "fit"} & set(stages)


@pytest.mark.usefixtures("warm_processes")
def test_the_same_bytes_with_two_processes_and_from_files(
    made: tuple[Path, Prepared], rooms: OccluderScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.prepare.stages.LARGE", 0)  # every scene is large
    mapped = replace(rooms, gaussians=Shelf(tmp_path / "shelf").put(rooms.gaussians))
    out = tmp_path / "rooms.gsvis"
    work = tmp_path / "rooms.gsvis.work"
    shutil.copytree(made[1].work, work)
    for stage in ("sets", "cost", "fidelity", "judged"):
        for path in work.glob(f"{stage}-*"):
            path.unlink()
    found = prepare(mapped, out, workers=Workers(2))
    assert new(found) == ["sets", "cost", "fidelity", "package"]
    assert files(out) == files(made[0])
    assert not (work / "shelf").exists()


def test_damage_in_what_is_kept_is_seen_and_mended(
    made: tuple[Path, Prepared], again: Path, rooms: OccluderScene
) -> None:
    work = again.with_name("rooms.gsvis.work")
    for pattern in ("sets-*.pvs", "joined-*.pvs", "levels-*/low.ply", "cost-*.json", "fidelity-*.json"):
        (path,) = work.glob(pattern)
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    assert new(prepare(rooms, again)) == ["levels", "sets", "cost", "fidelity"]
    assert files(again) == files(made[0])


def test_levels_that_are_there_are_taken_as_they_are_in_any_order(rooms: OccluderScene, tmp_path: Path) -> None:
    g = rooms.gaussians
    first = (np.arange(len(g)) % 4 > 0).astype(np.uint8)
    levels = Levels(g, first, np.ones(len(g), np.uint8), ("few", "all"))
    turned = np.random.default_rng(0).permutation(len(g))
    shuffled = Levels(g[turned], first[turned], levels.last, levels.names)
    some = {}
    for name, whole in (("a", levels), ("b", shuffled)):
        found = prepare_package(whole, tmp_path / name, rooms.navigable, CONFIG)
        assert found.stages[0].reused
        assert found.quality is None
        some[name] = files(tmp_path / name)
        with Package.open(tmp_path / name) as package:
            assert package.manifest.names == ("few", "all")
            assert package.manifest.scene == scene_hash(in_package_order(levels).union)
    assert some["a"] == some["b"]


def test_photographs_train_levels_and_another_photograph_trains_them_again(
    rooms: OccluderScene, tmp_path: Path
) -> None:
    (tmp_path / "capture").mkdir()
    photos = write_transforms(tmp_path / "capture", 9)
    config = replace(CONFIG, colors=replace(CONFIG.colors, fit=FitConfig(max_terms=0)), color_steps=3)
    out = tmp_path / "s.gsvis"
    g = Gaussians(  # in front of these cameras
        rooms.gaussians.means * 0.2,
        *(getattr(rooms.gaussians, name) for name in ("quats", "scales", "opacities", "sh0")),
    )
    found = prepare_package(g, out, rooms.navigable, config, photos=photos)
    assert found.quality is not None
    assert found.quality["cameras"] == "photographs"
    assert len(found.quality["psnr_photographs"]) == 3
    assert found.learned is not None
    assert found.learned["from"] == "photographs"
    assert any("check that they show this scene" in remark for remark in found.remarks)  # they do not
    again = prepare_package(g, out, rooms.navigable, config, photos=photos)
    assert new(again) == []
    assert again.learned == found.learned
    picture = sorted(photos.rglob("*.png"))[0]
    Image.fromarray(255 - np.asarray(Image.open(picture))).save(picture)
    assert new(prepare_package(g, out, rooms.navigable, config, photos=photos))[0] == "levels"


def test_colors_learn_from_renders_on_request(
    again: Path, rooms: OccluderScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned_colors, "RENDERS", ViewSampling(9, 24, 20))
    config = replace(CONFIG, color_steps=2)
    estimate = estimate_preparation(rooms.gaussians, again, rooms.navigable, config)
    assert "2 steps of learning" in next(stage.what for stage in estimate.stages if stage.name == "colors")
    found = prepare(rooms, again, config)
    assert new(found)[0] == "colors"
    assert found.learned is not None
    assert found.learned["from"] == "renders"
    with Package.open(again) as package:
        assert package.manifest.info.provenance["learned_colors"] == found.learned


def test_coarse_records_hold_the_same_colors_in_fewer_bits(again: Path, rooms: OccluderScene) -> None:
    found = prepare(rooms, again, replace(CONFIG, colors=replace(CONFIG.colors, precision="coarse")))
    assert new(found) == ["colors", "cost", "fidelity", "package"]
    assert found.manifest.grids.precision == PRECISIONS["coarse"]
    with Package.open(again) as package:
        assert package.contents.term_counts.any()


def test_an_edit_of_the_scene_is_seen(tmp_path: Path) -> None:
    many = small(two_rooms(1000, sh_degree=0))
    plain = replace(CONFIG, levels=None)
    g = many.gaussians
    prepare(many, tmp_path / "s.gsvis", plain)
    corner = g.means[:, 0] < g.means[:, 0].min() + 0.3
    moved = Gaussians(g.means + 0.01 * corner[:, None], g.quats, g.scales, g.opacities, g.sh0, g.shN)
    found = prepare_package(moved, tmp_path / "s.gsvis", many.navigable, plain, about={"scene": "rooms"})
    assert new(found) == ["sets", "colors", "cost", "fidelity", "package"]
    with Package.open(tmp_path / "s.gsvis") as package:
        assert package.verify().strays == 0


def test_an_estimate_says_what_is_there_and_writes_nothing(
    again: Path, rooms: OccluderScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = itertools.count(0.0, 10.0)  # each measurement finds 10 seconds
    monkeypatch.setattr(estimates, "_clock", lambda: next(clock))
    monkeypatch.setattr(pvs_estimates, "_clock", lambda: next(clock))
    work = again.with_name("rooms.gsvis.work")
    before = files(tmp_path)
    done = estimate_preparation(rooms.gaussians, again, rooms.navigable, CONFIG)
    assert [stage.state for stage in done.stages] == [*["done"] * 5, "to do"]
    assert done.seconds == done.stages[-1].seconds
    held = sum(p.stat().st_size for p in again.rglob("*") if p.is_file())
    assert 0.3 * held < done.nbytes < 3 * held
    assert done.sets_bytes > 0 <= done.saved_bytes
    other = estimate_preparation(rooms.gaussians, again, rooms.navigable, replace(CONFIG, epsilon=0.3))
    assert [s.name for s in other.stages if s.state == "to do"] == ["fidelity", "package"]
    fresh = estimate_preparation(rooms.gaussians, tmp_path / "new.gsvis", rooms.navigable, CONFIG)
    assert {stage.state for stage in fresh.stages} == {"to do"}
    assert fresh.seconds > 10.0
    # What is left needs some, too; levels that are made have merged Gaussians beside those of the scene.
    assert 0 < done.memory <= 1.001 * fresh.memory
    assert dict(fresh.levels)["high"] == len(rooms.gaussians)
    assert abs(fresh.gaussians - done.gaussians) <= 0.05 * done.gaussians
    assert files(tmp_path) == before
    assert not work.with_name("new.gsvis.work").exists()
    json.dumps(fresh.work_bytes)


def test_what_cannot_serve_is_refused_before_any_work(rooms: OccluderScene, tmp_path: Path) -> None:
    g, space = rooms.gaussians, rooms.navigable
    out = tmp_path / "s.gsvis"
    with pytest.raises(SceneError, match="nothing to see"):
        prepare_package(g[:0], out, space, CONFIG)
    with pytest.raises(ValueError, match="shares: expected at least 2"):
        prepare_package(g[:3], out, space, CONFIG)
    with pytest.raises(FileNotFoundError):
        prepare_package(g, out, space, CONFIG, photos=tmp_path / "none")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    with pytest.raises(FormatError, match=r"thesis\.txt"):
        prepare_package(g, tmp_path / "mine", space, CONFIG)
    (tmp_path / "s.gsvis.work").mkdir()
    (tmp_path / "s.gsvis.work" / "thesis.txt").touch()
    with pytest.raises(ValueError, match="a folder of something else"):
        prepare_package(g, out, space, CONFIG)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "s.gsvis.work"]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("cells", 0),
        ("cell_size", -1.0),
        ("epsilon", 0.0),
        ("meters_per_unit", -1.0),
        ("cost_views", replace(FEW, count=0)),
    ],
)
def test_wrong_values_are_named(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        replace(CONFIG, **{name: value})


def test_two_runs_of_one_package_do_not_meet(rooms: OccluderScene, tmp_path: Path) -> None:
    out = tmp_path / "s.gsvis"

    def meets(stage: str, done: int, total: int) -> None:
        with pytest.raises(ValueError, match="out: expected work that no other process is busy with"):
            prepare(rooms, out)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(rooms, out, progress=meets)


def test_options_are_json_whatever_width_may_cost() -> None:
    free = replace(CONFIG, colors=ColorConfig(FitConfig(width_loss=np.inf), FEW)).as_dict()
    assert json.loads(json.dumps(free, allow_nan=False))["colors"]["fit"]["width_loss"] is None
    assert CONFIG.as_dict()["colors"]["fit"]["width_loss"] == CONFIG.colors.fit.width_loss
