"""Train a scene on posed images, step by step: one loop for every backend of the rasterizer.

A step renders one view, compares it with the image, and updates the Gaussians; some steps add and remove Gaussians.
Every random choice is a function of the seed and the step, so a resumed run is identical to an uninterrupted one.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from numba import get_num_threads

from gsvis import _check
from gsvis.progress import Progress, silent
from gsvis.render.cpu import Frozen, rasterize_cpu
from gsvis.render.device import OnDevice, torch_device_of
from gsvis.render.rasterizer import rasterize
from gsvis.render.splats import View, check_no_skew
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash, sight_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.in_sight import InSight
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.checkpoint import load_checkpoint, run_key, save_checkpoint
from gsvis.train.config import TrainConfig
from gsvis.train.densify import Densifier
from gsvis.train.history import Record
from gsvis.train.images import PosedImages
from gsvis.train.likeness import mean_psnr
from gsvis.train.loss import photometric_loss
from gsvis.train.parameters import Parameters

__all__ = ["Record", "TrainConfig", "TrainResult", "Trainer", "extent_of", "train"]

_clock = time.monotonic  # replaced in tests
_WALLS = 8  # steps in occupied voxels after which a ray ends; images need more than estimates
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class TrainResult:
    """Result of training.

    Attributes:
        gaussians: The scene; its first rows are the frozen ones, unchanged.
        history: A record for each evaluation, the last at the end.
    """

    gaussians: Gaussians
    history: list[Record]


class Trainer:
    """Train a scene.

    On a device whose memory runs out, training goes on on the CPU from the same step; one line is logged.

    Args:
        views: Target images, with their cameras.
        start: Initial Gaussians.
        config: How to train, and on which device.
        frozen: Gaussians that are rendered but never changed; they come first in the result.
        held_out: Views to measure on.
        space: Voxels that stop light. In rooms, a step on the CPU skips frozen Gaussians that its camera cannot see.
            Around plants and objects this saves little and can err, so give None.

    Attributes:
        parameters: Raw values.
        step: Steps taken.
        seconds: Time spent on steps.
        history: Evaluations so far.
        beginning: Hash of the initial Gaussians.
        backend: The backend that takes the next step.

    Raises:
        ValueError: If there are no views, or nothing to train.
    """

    def __init__(
        self,
        views: PosedImages,
        start: Gaussians,
        config: TrainConfig,
        *,
        frozen: Gaussians | None = None,
        held_out: PosedImages | None = None,
        space: NavigableSpace | None = None,
    ) -> None:
        if len(views) == 0:
            raise ValueError("views: expected at least one image to train on, got none")
        if len(start) == 0:
            raise ValueError("start: expected at least one Gaussian to begin with, got none")
        check_no_skew(views.cameras)
        self.views = views
        self.held_out = held_out
        self.config = config
        self.extent = extent_of(views.cameras)
        self._frozen = frozen
        self.beginning = "".join(scene_hash(part) for part in (start, frozen) if part is not None)
        self._sight = None
        if space is not None and space.kind.kind == "rooms" and frozen is not None and len(frozen):
            self._sight = InSight.from_scene(frozen, space, walls=_WALLS)
            self.beginning += sight_hash(space)
        degree = config.sh_degree if config.sh_every == 0 else min(start.sh_degree, config.sh_degree)
        whole = _set_degree(start, degree)
        if frozen is not None and len(frozen):
            degree = max(degree, frozen.sh_degree)
            whole = Gaussians.concatenate([_set_degree(part, degree) for part in (frozen, start)])
        self._facts = whole.facts
        self.backend = config.backend
        self.parameters = Parameters.from_gaussians(whole, frozen=0 if frozen is None else len(frozen))
        rules = config.densify
        self.densifier = Densifier(rules, self.extent, self.parameters) if rules is not None else None
        self.step = 0
        self.seconds = 0.0
        self.loss = math.nan
        self.history: list[Record] = []
        self._run(self._begin)

    @cached_property
    def key(self) -> str:
        """Hash of the configuration, the images and the initial Gaussians; identifies the run."""
        return run_key(self)

    def rates(self) -> dict[str, float]:
        """Return the learning rates of the next step."""
        c = self.config
        share = self.step / max(c.iterations - 1, 1)
        means = c.means_rate ** (1.0 - share) * c.means_rate_end**share * self.extent
        falling = c.rates_end ** max(2.0 * share - 1.0, 0.0)
        return {
            "means": means,
            "log_scales": falling * c.scales_rate,
            "quats": falling * c.quats_rate,
            "logit_opacities": falling * c.opacities_rate,
            "sh0": falling * c.sh0_rate,
            "shN": falling * c.shN_rate,
        }

    def view_of(self, step: int) -> int:
        """Return the index of the view of a step: each view once per round, in random order."""
        turn, place = divmod(step, len(self.views))
        return int(np.random.default_rng([self.config.seed, turn]).permutation(len(self.views))[place])

    def advance(self) -> float:
        """Take one step; return its loss."""
        began = _clock()
        self._run(self._change)
        value = self._run(self._descend)
        self.step += 1
        share = max(1.0 / self.step, 0.01)
        self.loss = value if math.isnan(self.loss) else (1.0 - share) * self.loss + share * value
        self.seconds += _clock() - began
        return value

    def _run(self, part: Callable[[], float]) -> float:
        """Return the result of a part of a step, done on the CPU if the memory of the device runs out.

        Args:
            part: The part. Where it raises `torch.OutOfMemoryError`, it leaves the state as it was.
        """
        if torch_device_of(self.backend) is None:
            return part()
        found = OnDevice.attempt(part)
        if found is not None:
            return found
        _LOG.warning("the memory of the GPU ran out at step %d; training goes on on the CPU", self.step)
        self.backend = "cpu"
        self._begin()
        return part()

    def _begin(self) -> float:
        """Move all values to the device of the backend; return their number."""
        device = torch_device_of(self.backend) or "cpu"
        self.parameters.move(device)
        if self.densifier is not None:
            self.densifier.move(device)
        return float(len(self.parameters))

    def _change(self) -> float:
        """Add and remove Gaussians and raise the degree of SH, if it is time; return the number of Gaussians.

        This comes at the start of a step, so that a run never ends right after a split.
        """
        c = self.config
        rules = self.densifier
        p = self.parameters
        held = p.copy() if torch_device_of(self.backend) else p  # on a device, what is replaced is held until the end
        sums = None if rules is None else (rules.total, rules.seen)
        try:
            if rules is not None and self.step:
                rules.refine(self.step, torch.Generator().manual_seed(hash_of(c.seed, self.step)))
            if c.sh_every and self.step % c.sh_every == 0:
                p.raise_sh_degree(min(self.step // c.sh_every, c.sh_degree))
        except torch.OutOfMemoryError:
            p.values = held.values
            p.first = held.first
            p.second = held.second
            if rules is not None and sums is not None:
                rules.total, rules.seen = sums
            raise
        return float(len(p))

    def _descend(self) -> float:
        """Draw a view and update the Gaussians along the gradient of its loss; return the loss."""
        c = self.config
        index = self.view_of(self.step)
        camera = self.views.cameras[index]
        lengths = None
        try:
            image, centers = self._draw(camera)
            target = torch.from_numpy(self.views.image(index)).to(image)
            loss = photometric_loss(image, target, c.ssim_weight)
            loss.backward()  # type: ignore[no-untyped-call]
            if self.densifier is not None and centers is not None and centers.grad is not None:
                lengths = self.densifier.lengths(centers.grad.reshape(-1, 2), camera.width, camera.height)
            self.parameters.adam_step(self.rates())  # from here on no memory is needed
        except torch.OutOfMemoryError:
            self.parameters.forget_gradients()
            raise
        if self.densifier is not None and lengths is not None:
            self.densifier.add(lengths)
        return float(loss.detach())

    def record(self) -> Record:
        """Measure on held-out views, if there are any, and append a record."""
        now = Record(self.step, self.seconds, self.loss, len(self.parameters))
        if self.held_out is not None:
            psnr = mean_psnr(self.gaussians(), self.held_out, self.backend, self._facts.antialiased)
            now = replace(now, psnr=psnr)
        self.history.append(now)
        _LOG.info("step %d: loss %.4f, %d Gaussians, %.2f dB", now.step, now.loss, now.count, now.psnr)
        return now

    def _draw(self, camera: Cameras) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the image (H, W, 3) of a camera, and zeros for the gradients by projected centers, if these count."""
        tensors = self.parameters.activate()
        stand = self.parameters.frozen
        antialiased = self._facts.antialiased
        if torch_device_of(self.backend) is not None or self.backend == "reference":
            drawn = rasterize(tensors, camera, backend=self.backend, antialiased=antialiased, frozen=stand)
            return drawn.images[0], drawn.means2d
        centers = None if self.densifier is None else torch.zeros((len(tensors), 2), requires_grad=True)
        image, *_ = rasterize_cpu(
            tensors,
            View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height),
            background=np.zeros(3, np.float32),
            sh_degree=tensors.sh_degree,
            antialiased=antialiased,
            probe=centers,
            frozen=Frozen(stand, None if self._sight is None else self._sight.of(camera)),
        )
        return image, centers

    def run(
        self,
        *,
        checkpoint: str | os.PathLike[str] | None = None,
        checkpoint_seconds: float = 120.0,
        progress: Progress = silent,
    ) -> TrainResult:
        """Take all remaining steps, with measurements and checkpoints on the way; see `train`.

        `progress` runs between two steps and may read the trainer: its loss, its history, its number of Gaussians.
        torch uses at most as many threads as the kernels (`numba.set_num_threads`), also afterwards.
        """
        torch.set_num_threads(
            min(torch.get_num_threads(), get_num_threads())
        )  # numba's OpenMP raises the number of torch
        last = self.config.iterations
        checkpoint = None if checkpoint is None else _check.path("checkpoint", checkpoint)
        if checkpoint is not None and checkpoint.exists():
            self._run(partial(load_checkpoint, checkpoint, self))
        progress("train", self.step, last)
        # `whole` is False in the middle of a step, where the state is inconsistent
        saved = _clock()
        whole = True
        try:
            self._record_if_due()
            while self.step < last:
                whole = False
                self.advance()
                whole = True
                self._record_if_due()
                if checkpoint is not None and (self.step == last or _clock() - saved >= checkpoint_seconds):
                    save_checkpoint(checkpoint, self)
                    saved = _clock()
                progress("train", self.step, last)
        except KeyboardInterrupt:
            if checkpoint is not None and whole:
                save_checkpoint(checkpoint, self)
            raise
        return TrainResult(self.gaussians(), self.history)

    def _record_if_due(self) -> None:
        """Measure if this step requires it, unless it was done before an interruption."""
        every = self.config.evaluate_every
        due = self.step == self.config.iterations or (every > 0 and self.step > 0 and self.step % every == 0)
        if due and (not self.history or self.history[-1].step < self.step):
            self.record()

    def gaussians(self) -> Gaussians:
        """Return the current scene; frozen rows are exactly as given."""
        whole = self.parameters.gaussians().with_facts(self._facts)
        if self._frozen is None or len(self._frozen) == 0:
            return whole
        degree = max(self._frozen.sh_degree, whole.sh_degree)
        own = _set_degree(whole[len(self._frozen) :], degree)
        return Gaussians.concatenate([_set_degree(self._frozen, degree), own])


def train(
    views: PosedImages,
    start: Gaussians,
    config: TrainConfig | None = None,
    *,
    frozen: Gaussians | None = None,
    held_out: PosedImages | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 120.0,
    progress: Progress = silent,
) -> TrainResult:
    """Train a scene on images.

    Args:
        views: Target images, with their cameras.
        start: Initial Gaussians, such as those of `gaussians_from_points`.
        config: How to train; None means `TrainConfig()`.
        frozen: Gaussians that are rendered but never changed; they come first in the result.
        held_out: Views to measure on, never trained on.
        checkpoint: A file to write regularly and on Ctrl-C, and to resume from if it exists. It must belong to the
            same images, initial Gaussians and configuration. It is kept at the end. Ctrl-C within a step saves the
            previous step; if `progress` raises it, as on the command line, nothing is lost.
        checkpoint_seconds: Time between writes.
        progress: Called with every step; stage "train".

    Raises:
        ValueError: If there are no views or Gaussians, or the checkpoint belongs to a different run.
        FormatError: If the checkpoint is damaged.
        KeyboardInterrupt: After Ctrl-C; between two steps, a checkpoint is written first.
    """
    trainer = Trainer(views, start, config or TrainConfig(), frozen=frozen, held_out=held_out)
    return trainer.run(checkpoint=checkpoint, checkpoint_seconds=checkpoint_seconds, progress=progress)


def extent_of(cameras: Cameras) -> float:
    """Return 1.1 times the largest distance of a viewpoint from their middle, scene units; 1 for one viewpoint."""
    away = np.linalg.norm(cameras.viewpoints - cameras.viewpoints.mean(axis=0), axis=1)
    return 1.1 * float(away.max()) or 1.0


def hash_of(seed: int, step: int) -> int:
    """Return a seed for torch from the run's seed and a step."""
    return int(np.random.SeedSequence([seed, step]).generate_state(1, np.uint64)[0]) >> 1


def _set_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the same Gaussians with SH truncated or padded with zeros to a degree."""
    have = gaussians.shN.shape[1]
    want = (degree + 1) ** 2 - 1
    if have == want:
        return gaussians
    shN = np.zeros((len(gaussians), want, 3), np.float32)
    shN[:, : min(have, want)] = gaussians.shN[:, : min(have, want)]
    g = gaussians
    return Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0, shN, facts=g.facts)
