"""A package prepared on a device: as good as one of the CPU, the same stages, resumed by either.

The backend "reference" goes the way of a GPU with tensors on the CPU.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gsvis.color.fit import FitConfig
from gsvis.prepare import PrepareConfig, Prepared, learned_colors, prepare_package
from gsvis.prepare.colors import ColorConfig
from gsvis.pvs.config import PvsConfig
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OccluderScene, two_rooms
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.levels import LevelsConfig

FEW = ViewSampling(2, 18, 14)
CONFIG = PrepareConfig(
    levels=LevelsConfig(iterations=2),
    level_views=FEW,
    level_held_out=1,
    cells=1,
    sets=PvsConfig(size=16, rays=256, max_inner=1),
    colors=ColorConfig(FitConfig(max_terms=1, refine=False), FEW),
    cost_views=replace(FEW, stream=3),
    fidelity_views=replace(FEW, stream=5),
    color_steps=2,
)
THERE = replace(
    CONFIG,
    levels=LevelsConfig(iterations=2, backend="reference"),
    colors=replace(CONFIG.colors, backend="reference"),
)


@pytest.fixture(scope="module", autouse=True)
def few_views() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned_colors, "RENDERS", ViewSampling(9, 18, 14, stream=3))
        yield


@pytest.fixture(scope="module")
def rooms() -> OccluderScene:
    scene = two_rooms(1000, sh_degree=1)
    space = NavigableSpace.from_box((0.5, 0.5, 0.6), (7.5, 3.5, 2.4), 14)
    return replace(scene, gaussians=scene.gaussians[::5], navigable=space)


def prepare(rooms: OccluderScene, out: Path, config: PrepareConfig, **more: Any) -> Prepared:
    return prepare_package(rooms.gaussians, out, rooms.navigable, config, **more)


def test_a_stage_of_another_device_is_the_same_stage(rooms: OccluderScene, tmp_path: Path) -> None:
    there = prepare(rooms, tmp_path / "a.gsvis", THERE)
    here = prepare(rooms, tmp_path / "a.gsvis", CONFIG)
    assert all(stage.reused for stage in here.stages)
    assert here.parts_kept == here.parts
    alone = prepare(rooms, tmp_path / "b.gsvis", CONFIG)
    assert alone.manifest.info.provenance["config"] == there.manifest.info.provenance["config"]
    assert alone.manifest.counts == there.manifest.counts
    for one, other in ((there, alone), (alone, there)):
        assert one.quality is not None
        assert other.quality is not None
        for mine, theirs in zip(one.quality["psnr"], other.quality["psnr"], strict=True):
            assert mine["mean"] == pytest.approx(theirs["mean"], abs=0.05)


def test_unfinished_levels_of_a_device_are_finished_on_the_cpu(rooms: OccluderScene, tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        if stage == "train medium" and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(rooms, tmp_path / "a.gsvis", THERE, progress=stop)
    trained: list[str] = []
    found = prepare(rooms, tmp_path / "a.gsvis", CONFIG, progress=lambda stage, done, total: trained.append(stage))
    assert "prune" not in trained  # what stays was chosen before
    assert len(found.manifest.counts) == 3
