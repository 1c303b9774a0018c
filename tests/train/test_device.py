"""Training on a device: equal to training on the CPU, and resumed there wherever the memory of the device runs out.

The backend "reference" goes the way of a GPU with tensors on the CPU; its memory runs out on demand.
"""

from __future__ import annotations

import gc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gsvis.render.device import why_no_cuda
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train import trainer as trainer_module
from gsvis.train.checkpoint import save_checkpoint
from gsvis.train.config import DensifyConfig, TrainConfig
from gsvis.train.densify import Densifier
from gsvis.train.images import PosedImages, render_views
from gsvis.train.likeness import measure_views
from gsvis.train.parameters import NAMES, Parameters
from gsvis.train.trainer import Trainer
from tests.train.test_parameters import some_gaussians

NO_CUDA = why_no_cuda()
RULES = DensifyConfig(start=1, stop=6, every=2, threshold=1e-7, most_count=24, reset_every=0)
CONFIG = TrainConfig(iterations=6, sh_degree=1, sh_every=3, densify=RULES, evaluate_every=3, backend="reference")


@pytest.fixture(autouse=True)
def no_garbage(monkeypatch: pytest.MonkeyPatch) -> None:
    """Collect no garbage where memory runs out: that takes a second in a process as large as that of tests."""
    monkeypatch.setattr(gc, "collect", lambda: 0)


@pytest.fixture(scope="module")
def views() -> PosedImages:
    around = Cameras.orbit((0.0, 0.0, 0.0), 4.0, 5, width=20, height=16)
    return render_views(some_gaussians(14), around)


def trainer(views: PosedImages, backend: str = "reference") -> Trainer:
    start = some_gaussians(10, degree=0)
    return Trainer(views[1:], start, replace(CONFIG, backend=backend), held_out=views[:1])


def same(one: Gaussians, other: Gaussians, tolerance: float) -> None:
    assert len(one) == len(other)
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=tolerance, err_msg=name)


def test_a_device_trains_as_the_cpu_does(views: PosedImages) -> None:
    there = trainer(views).run()
    here = trainer(views, "cpu").run()
    same(there.gaussians, here.gaussians, 2e-3)
    assert [record.count for record in there.history] == [record.count for record in here.history]
    assert there.history[-1].psnr == pytest.approx(here.history[-1].psnr, abs=0.05)


PLACES: dict[str, tuple[Any, str, int]] = {
    "drawing": (trainer_module, "rasterize", 4),
    "the loss": (trainer_module, "photometric_loss", 4),
    "the gradient of centers": (Densifier, "lengths", 4),
    "the step": (Parameters, "_scratch", 4),
    "clones": (Densifier, "_is_spent", 4),  # the clones are there already
    "a higher degree": (Parameters, "raise_sh_degree", 3),
}
"""What runs out of memory: whose it is, its name, and the step."""


@pytest.mark.parametrize("place", PLACES)
def test_training_goes_on_on_the_cpu_where_memory_runs_out(
    place: str, views: PosedImages, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    owner, name, step = PLACES[place]
    working = getattr(owner, name)
    run = trainer(views)
    wanted = trainer(views)
    for _ in range(step):
        run.advance()
        wanted.advance()

    def fail(*words: Any, **named: Any) -> Any:
        """Run out of memory on the device, when a part of the work is done."""
        if run.backend == "cpu":
            return working(*words, **named)
        if owner is Parameters and name == "raise_sh_degree":
            words[0].values["shN"] = torch.ones(len(words[0]), 3, 3)
        raise torch.OutOfMemoryError

    wanted.backend = "cpu"
    expected = [wanted.advance() for _ in range(2)]
    monkeypatch.setattr(owner, name, fail)
    assert [run.advance() for _ in range(2)] == pytest.approx(expected, rel=1e-5)
    assert run.backend == "cpu"
    assert caplog.messages == [f"the memory of the GPU ran out at step {step}; training goes on on the CPU"]
    same(run.gaussians(), wanted.gaussians(), 1e-6)


@pytest.mark.parametrize("place", ["the values", "a checkpoint"])
def test_a_scene_that_does_not_fit_is_trained_on_the_cpu(
    place: str, views: PosedImages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    wanted = trainer(views, "cpu")
    for _ in range(3):
        wanted.advance()
    save_checkpoint(tmp_path / "a", wanted)
    run = trainer(views) if place == "a checkpoint" else None
    owner, name = (torch, "from_numpy") if run else (Parameters, "move")
    working = getattr(owner, name)
    tries: list[int] = []

    def fail(*words: Any) -> Any:
        """Run out of memory twice: the second try is with caches emptied."""
        tries.append(1)
        if len(tries) < 3:
            raise torch.OutOfMemoryError
        return working(*words)

    monkeypatch.setattr(owner, name, fail)
    run = run or trainer(views)
    found = run.run(checkpoint=tmp_path / "a")
    assert run.backend == "cpu"
    assert caplog.messages == ["the memory of the GPU ran out at step 0; training goes on on the CPU"]
    same(found.gaussians, wanted.run().gaussians, 1e-6)


def test_a_run_begun_on_a_device_resumes_on_another(views: PosedImages, tmp_path: Path) -> None:
    assert len({trainer(views, backend).key for backend in ("auto", "cpu", "reference")}) == 1
    begun = trainer(views)

    def stop(stage: str, done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begun.run(checkpoint=tmp_path / "a", progress=stop)
    resumed = trainer(views, "cpu").run(checkpoint=tmp_path / "a")
    same(resumed.gaussians, trainer(views, "cpu").run().gaussians, 2e-3)


def test_views_are_drawn_and_measured_on_a_device(views: PosedImages) -> None:
    g = some_gaussians(14)
    there = render_views(g, views.cameras, backend="reference")
    np.testing.assert_allclose(there.images, views.images, atol=1e-4)
    assert measure_views(g, views, backend="reference").psnr.min() > 70.0


def test_a_step_needs_no_memory_once_it_has_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    p = Parameters.from_gaussians(some_gaussians(6))
    for name in NAMES:
        p.values[name].grad = torch.ones_like(p.values[name])
    before = {name: value.detach().clone() for name, value in p.values.items()}

    def fail(*words: Any) -> torch.Tensor:
        raise torch.OutOfMemoryError

    monkeypatch.setattr(Parameters, "_scratch", fail)
    with pytest.raises(torch.OutOfMemoryError):
        p.adam_step(dict.fromkeys(NAMES, 0.1))
    assert p.steps == 0
    for name in NAMES:
        assert torch.equal(p.values[name], before[name])
        assert p.values[name].grad is not None


def test_a_step_on_a_device_is_that_of_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    both = [Parameters.from_gaussians(some_gaussians(6), frozen=2) for _ in range(2)]
    for turn, p in enumerate(both):
        for name in NAMES:
            p.values[name].grad = torch.linspace(-1.0, 1.0, p.values[name].numel()).view_as(p.values[name])
        if turn:
            monkeypatch.setattr(Parameters, "_scratch", lambda self: torch.empty(100))
        p.adam_step(dict.fromkeys(NAMES, 0.1))
    for name in NAMES:
        assert torch.allclose(both[0].values[name], both[1].values[name], atol=1e-6)


@pytest.mark.skipif(bool(NO_CUDA), reason=NO_CUDA or "a GPU is here")
def test_a_gpu_trains_as_the_cpu_does(views: PosedImages) -> None:
    there = trainer(views, "cuda").run()
    here = trainer(views, "cpu").run()
    assert there.history[-1].psnr == pytest.approx(here.history[-1].psnr, abs=0.5)
