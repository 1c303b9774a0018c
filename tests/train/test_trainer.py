"""The loop: it comes closer, its course is a function of seed and step, a stopped run goes on as if never stopped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numba import get_num_threads, set_num_threads

from gsvis.errors import FormatError
from gsvis.render.rasterizer import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.densify import DensifyConfig
from gsvis.train.images import PosedImages
from gsvis.train.likeness import mean_psnr
from gsvis.train.trainer import TrainConfig, Trainer, extent_of, train

COUNT = 60
RULES = DensifyConfig(start=10, stop=50, every=10, threshold=1e-4, reset_every=40)
CONFIG = TrainConfig(
    iterations=60,
    sh_degree=1,
    sh_every=20,
    sh0_rate=0.02,  # fast, for so few steps
    evaluate_every=30,
    densify=RULES,
)

STEADY = replace(CONFIG, densify=replace(RULES, reset_every=0))  # a reset so late would not be made good


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    rng = np.random.default_rng(5)
    return Gaussians(
        rng.uniform(-1, 1, (COUNT, 3)),
        rng.normal(size=(COUNT, 4)),
        rng.uniform(0.1, 0.3, (COUNT, 3)),
        rng.uniform(0.5, 0.95, COUNT),
        rng.uniform(-1, 1, (COUNT, 1, 3)),
    )


@pytest.fixture(scope="module")
def views(truth: Gaussians) -> PosedImages:
    cameras = Cameras.orbit((0, 0, 0), 4.0, 10, width=48, height=40)
    images = rasterize(truth, cameras).images
    return PosedImages(cameras, (images.clip(0, 1) * 255).round().astype(np.uint8))


@pytest.fixture(scope="module")
def start(truth: Gaussians) -> Gaussians:
    rng = np.random.default_rng(6)
    means = truth.means + rng.normal(scale=0.05, size=truth.means.shape)
    plain = np.full(COUNT, 0.3)
    return Gaussians(means, truth.quats, np.full((COUNT, 3), 0.15), plain, np.zeros((COUNT, 1, 3)))


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in vars(a))


def test_it_comes_closer_also_where_it_did_not_look(views: PosedImages, start: Gaussians) -> None:
    seen, held_out = views.split(5)
    result = train(seen, start, STEADY, held_out=held_out)
    first = mean_psnr(start, held_out)
    assert [record.step for record in result.history] == [30, 60]
    assert first + 3.0 < result.history[-1].psnr
    assert result.history[-1].psnr == pytest.approx(mean_psnr(result.gaussians, held_out), abs=1e-6)
    assert result.gaussians.sh_degree == 1
    assert result.history[-1].count == len(result.gaussians) != COUNT


def test_torch_takes_no_more_threads_than_the_kernels(views: PosedImages, start: Gaussians) -> None:
    before = get_num_threads(), torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        set_num_threads(1)
        train(views, start, replace(CONFIG, iterations=1))
        assert torch.get_num_threads() == 1
    finally:
        set_num_threads(before[0])
        torch.set_num_threads(before[1])


def test_every_view_is_drawn_once_a_round(views: PosedImages, start: Gaussians) -> None:
    trainer = Trainer(views, start, CONFIG)
    rounds = [[trainer.view_of(step) for step in range(k, k + 10)] for k in (0, 10)]
    assert sorted(rounds[0]) == sorted(rounds[1]) == list(range(10))
    assert rounds[0] != rounds[1]


def test_rates_of_centers_fall_from_first_to_last(views: PosedImages, start: Gaussians) -> None:
    trainer = Trainer(views, start, CONFIG)
    extent = extent_of(views.cameras)
    assert trainer.rates()["means"] == pytest.approx(1.6e-4 * extent)
    trainer.step = CONFIG.iterations - 1
    assert trainer.rates()["means"] == pytest.approx(1.6e-6 * extent)


@pytest.mark.parametrize("stop_at", [1, 23, 40])
def test_a_run_stopped_and_resumed_takes_the_same_course(
    views: PosedImages, start: Gaussians, tmp_path: Path, stop_at: int
) -> None:
    whole = train(views, start, CONFIG)
    path = tmp_path / "run.ckpt"

    def stop(stage: str, done: int, total: int) -> None:
        if done == stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(views, start, CONFIG, checkpoint=path, progress=stop)
    steps: list[int] = []
    again = train(views, start, CONFIG, checkpoint=path, progress=lambda stage, done, total: steps.append(done))
    assert steps[0] == stop_at
    assert same(again.gaussians, whole.gaussians)
    assert [replace(r, seconds=0.0) for r in again.history][-1].loss == whole.history[-1].loss
    done = train(views, start, CONFIG, checkpoint=path)  # a finished one is not trained again
    assert same(done.gaussians, whole.gaussians)


def test_a_checkpoint_of_another_run_is_refused(views: PosedImages, start: Gaussians, tmp_path: Path) -> None:
    path = tmp_path / "run.ckpt"
    brief = replace(CONFIG, iterations=2)
    train(views, start, brief, checkpoint=path)
    for others in ((views[:5], start, brief), (views, start[:30], brief), (views, start, replace(brief, seed=1))):
        with pytest.raises(ValueError, match=r"checkpoint: expected .* to the same images, Gaussians and config"):
            train(*others, checkpoint=path)


@pytest.mark.parametrize("damage", ["cut", "other", "empty", "array"])
def test_a_damaged_checkpoint_is_refused(views: PosedImages, start: Gaussians, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "run.ckpt"
    brief = replace(CONFIG, iterations=2)
    train(views, start, brief, checkpoint=path)
    whole = path.read_bytes()
    if damage == "array":
        with np.load(path) as archive:
            arrays = dict(archive)
        arrays["values/means"] = arrays["values/means"][:5]
        with path.open("wb") as file:
            np.savez(file, **arrays)
    else:
        path.write_bytes({"cut": whole[: len(whole) // 2], "other": b"ply\nformat", "empty": b""}[damage])
    with pytest.raises(FormatError, match="checkpoint"):
        train(views, start, brief, checkpoint=path)


def test_frozen_gaussians_stand_to_the_bit_and_the_rest_repairs(
    views: PosedImages, truth: Gaussians, start: Gaussians
) -> None:
    frozen, own = truth[:40], start[40:50]
    rules = DensifyConfig(start=5, every=5, stop=60, split=False, most_share=0.05, most_count=55, reset_every=0)
    config = replace(CONFIG, sh_degree=0, sh_every=0, densify=rules)
    result = train(views, own, config, frozen=frozen)
    assert same(result.gaussians[:40], frozen)
    assert len(result.gaussians) <= 55
    before = mean_psnr(Gaussians.concatenate([frozen, own]), views)
    assert mean_psnr(result.gaussians, views) > before + 1.0


def test_frozen_ones_keep_a_higher_degree(views: PosedImages, truth: Gaussians, start: Gaussians) -> None:
    rng = np.random.default_rng(1)
    shn = rng.normal(size=(COUNT, 8, 3))
    shiny = Gaussians(truth.means, truth.quats, truth.scales, truth.opacities, truth.sh0, shn)
    result = train(views, start, replace(CONFIG, iterations=3, sh_degree=0, sh_every=0), frozen=shiny)
    assert same(result.gaussians[:COUNT], shiny)
    assert result.gaussians.sh_degree == 2


def test_colors_above_white_are_aimed_at(truth: Gaussians, start: Gaussians) -> None:
    cameras = Cameras.orbit((0, 0, 0), 4.0, 4, width=32, height=32)
    bright = rasterize(truth, cameras).images * 2.0
    trainer = Trainer(PosedImages(cameras, bright.astype(np.float32)), start, STEADY)
    losses = [trainer.advance() for _ in range(40)]
    assert np.mean(losses[-4:]) < 0.7 * np.mean(losses[:4])


def test_what_cannot_be_trained_is_refused(views: PosedImages, start: Gaussians) -> None:
    with pytest.raises(ValueError, match="start: expected at least one Gaussian"):
        train(views, Gaussians.empty(), CONFIG)
    with pytest.raises(ValueError, match="views: expected at least one image"):
        train(views[:0], start, CONFIG)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"iterations": 0}, "iterations: expected"),
        ({"sh_degree": 4}, "sh_degree: expected 0 to 3, got 4"),
        ({"ssim_weight": 1.5}, "ssim_weight: expected a share"),
        ({"rates_end": 0.0}, "rates_end: expected a factor"),
        ({"means_rate": 0.0}, "means_rate: expected a finite number > 0"),
        ({"means_rate_end": float("nan")}, "means_rate_end: expected a finite number > 0"),
    ],
)
def test_configurations_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **change)


def test_the_extent_is_that_of_the_cameras() -> None:
    ring = Cameras.orbit((1, 2, 3), 5.0, 8, elevation=0.0, width=8, height=8)
    assert extent_of(ring) == pytest.approx(5.5)
    assert extent_of(ring[:1]) == 1.0


def test_threads_do_not_change_the_course(views: PosedImages, start: Gaussians) -> None:
    import numba

    brief = replace(CONFIG, iterations=12)
    whole = train(views, start, brief).gaussians
    threads, torch_threads = numba.get_num_threads(), torch.get_num_threads()
    try:
        numba.set_num_threads(1)
        torch.set_num_threads(1)
        assert same(train(views, start, brief).gaussians, whole)
    finally:
        numba.set_num_threads(threads)
        torch.set_num_threads(torch_threads)


def test_frozen_ones_out_of_sight_are_left_out_of_a_step(
    views: PosedImages, truth: Gaussians, start: Gaussians
) -> None:
    """Behind a wall of voxels they cost nothing and change nothing; where nothing is hidden, all is as without."""
    few = replace(CONFIG, iterations=6, densify=None)
    far = Gaussians(truth.means + np.float32(40.0), truth.quats, truth.scales, truth.opacities, truth.sh0)
    frozen = Gaussians.concatenate([truth[:30], far])
    occupied = np.zeros((60, 60, 60), bool)
    up = np.array([0.0, 0.0, 1.0])
    rooms = SpaceKind("rooms", "a test")
    open_space = NavigableSpace(np.full(3, -10.0), 1.0, ~occupied, up, occupied, kind=rooms)
    occupied = occupied.copy()
    occupied[20:28] = occupied[:, 20:28] = occupied[:, :, 20:28] = True
    walled = NavigableSpace(np.full(3, -10.0), 1.0, ~occupied, up, occupied, kind=rooms)
    alone = Trainer(views, start[30:], few, frozen=frozen)
    trainers = [Trainer(views, start[30:], few, frozen=frozen, space=space) for space in (open_space, walled)]
    for trainer in (alone, *trainers):
        for _ in range(6):
            trainer.advance()
    sight = trainers[1]._sight
    assert sight is not None
    assert not sight.of(views.cameras[0])[30:].any()
    for trainer in trainers:
        for name, value in trainer.parameters.values.items():
            torch.testing.assert_close(value, alone.parameters.values[name], rtol=1e-4, atol=1e-5)
    assert len({trainer.key for trainer in (alone, *trainers)}) == 3


def test_the_other_rates_fall_in_the_second_half(views: PosedImages, start: Gaussians) -> None:
    trainer = Trainer(views, start, replace(CONFIG, iterations=61, rates_end=0.01))
    found = []
    for trainer.step in (0, 30, 45, 60):
        found.append(trainer.rates()["sh0"] / CONFIG.sh0_rate)
    np.testing.assert_allclose(found, [1.0, 1.0, 0.1, 0.01])
