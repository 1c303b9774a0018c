"""A run that dies is resumed from its last checkpoint, whatever it was doing; an incomplete step is never kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.train import trainer as trainers
from gsvis.train.densify import DensifyConfig
from gsvis.train.images import PosedImages
from gsvis.train.initial import gaussians_from_points
from gsvis.train.likeness import mean_psnr, measure_views
from gsvis.train.trainer import TrainConfig, Trainer
from tests.train.photo_files import cameras, cloud, pictures

RULES = DensifyConfig(start=3, stop=18, every=5, threshold=1e-5, reset_every=0)
CONFIG = TrainConfig(iterations=20, sh_degree=1, sh_every=8, evaluate_every=10, densify=RULES)


def trainer() -> Trainer:
    views, held_out = PosedImages(cameras(), pictures()).split(5)
    return Trainer(views, gaussians_from_points(cloud()), CONFIG, held_out=held_out)


class KilledError(Exception):
    """As if the process had been killed: nothing handles it."""


@pytest.mark.parametrize("error", [KilledError, KeyboardInterrupt])
@pytest.mark.parametrize("at", [1, 6, 14])
def test_a_run_that_dies_within_a_step_goes_on_from_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException], at: int
) -> None:
    whole = trainer().run()
    path = tmp_path / "run.checkpoint"
    dying = trainer()
    adam_step = type(dying.parameters).adam_step

    def die(self: object, rates: dict[str, float]) -> None:
        adam_step(self, rates)  # parameters have moved, the step is not counted
        if dying.step == at:
            raise error

    monkeypatch.setattr(type(dying.parameters), "adam_step", die)
    with pytest.raises(error):
        dying.run(checkpoint=path, checkpoint_seconds=0.0)
    monkeypatch.setattr(type(dying.parameters), "adam_step", adam_step)
    steps: list[int] = []
    again = trainer().run(checkpoint=path, progress=lambda stage, done, total: steps.append(done))
    assert steps[0] == at
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(again.gaussians, name), getattr(whole.gaussians, name))
    assert [r.psnr for r in again.history] == [r.psnr for r in whole.history]


def test_checkpoints_are_written_as_time_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running = trainer()
    written: list[int] = []
    monkeypatch.setattr(trainers, "_clock", lambda: 50.0 * running.step)
    monkeypatch.setattr(trainers, "save_checkpoint", lambda path, of: written.append(of.step))
    running.run(checkpoint=tmp_path / "run.checkpoint", checkpoint_seconds=120.0)
    assert written == [3, 6, 9, 12, 15, 18, 20]


def test_a_stop_before_the_last_measurement_does_not_lose_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.checkpoint"
    stopped = trainer()
    monkeypatch.setattr(Trainer, "record", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        stopped.run(checkpoint=path)
    assert (stopped.step, stopped.history) == (10, [])
    monkeypatch.undo()
    assert [record.step for record in trainer().run(checkpoint=path).history] == [10, 20]


def test_views_are_measured_one_by_one() -> None:
    views = PosedImages(cameras(), pictures())
    start = gaussians_from_points(cloud())
    found = measure_views(start, views)
    assert found.names == cameras().names
    assert found.psnr.mean() == pytest.approx(mean_psnr(start, views))
    alone = measure_views(start, views[3])
    assert (alone.psnr[0], alone.ssim[0]) == (found.psnr[3], found.ssim[3])
    assert found.as_dict()["psnr"]["worst"] == found.psnr.min()
    assert found.as_dict()["each"][3]["name"] == "photo_003.png"
    with pytest.raises(ValueError, match="views: expected at least one"):
        measure_views(start, views[[]])
