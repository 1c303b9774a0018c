"""Processor seconds that a system may spend on training, and training that stops when they are spent.

The seconds are those of the process with all its threads, so they hardly depend on what else the machine does. Rates
that fall during training follow the share that is spent, as nobody knows the number of steps beforehand.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from arena.course import Course
from gsvis.progress import Progress, silent
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.config import DensifyConfig, TrainConfig
from gsvis.train.loss import photometric_loss
from gsvis.train.parameters import Parameters
from gsvis.train.trainer import Trainer

__all__ = ["Allowance", "Budget", "BudgetTrainer", "descend", "train_gaussians"]

Clock = Callable[[], float]

GROWS = 0.5
"""Share of the budget after which no Gaussian is added or removed."""
_ENDLESS = 1_000_000_000


@dataclass(frozen=True)
class Allowance:
    """What a system may spend, and how large it may become.

    Attributes:
        seconds: Processor seconds.
        gaussians: Most Gaussians of a scene.
        steps: Most steps of each training, for tests; None for as many as the seconds allow.
    """

    seconds: float
    gaussians: int = 60_000
    steps: int | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.seconds) and self.seconds > 0):
            raise ValueError(f"seconds: expected processor seconds > 0, got {self.seconds!r}")


class Budget:
    """An allowance, or a share of it, in use from now on.

    Args:
        allowance: What a system may spend.
        share: Share of its seconds that this training may spend.
        clock: Seconds of processor so far.
    """

    def __init__(self, allowance: Allowance, share: float = 1.0, clock: Clock = time.process_time) -> None:
        self.allowance = allowance
        self.seconds = allowance.seconds * share
        self.steps = 0
        self._clock = clock
        self._began = clock()

    @property
    def spent(self) -> float:
        """Seconds spent so far."""
        return self._clock() - self._began

    @property
    def share(self) -> float:
        """Share spent so far, of seconds or steps, in [0, 1]."""
        by_steps = 0.0 if self.allowance.steps is None else self.steps / self.allowance.steps
        return min(max(self.spent / self.seconds, by_steps), 1.0)

    def step(self) -> bool:
        """Count a step and return True if there is something left for it."""
        if self.share >= 1.0:
            return False
        self.steps += 1
        return True


class BudgetTrainer(Trainer):
    """The trainer of gsvis, whose rates follow what is spent.

    Args:
        course: What to train on.
        budget: What to spend.
        start: Initial Gaussians; None means those of the course.
        penalty: A further loss of the raw values, or None.
        grow: Whether Gaussians are added and removed.
    """

    def __init__(
        self,
        course: Course,
        budget: Budget,
        *,
        start: Gaussians | None = None,
        penalty: Callable[[Parameters, int], Tensor] | None = None,
        grow: bool = True,
    ) -> None:
        rules = DensifyConfig(start=300, stop=_ENDLESS, most_count=budget.allowance.gaussians) if grow else None
        config = TrainConfig(iterations=_ENDLESS, densify=rules)
        super().__init__(course.views, course.start if start is None else start, config)
        self.budget = budget
        self.penalty = penalty

    def rates(self) -> dict[str, float]:
        """Return the learning rates of the next step; those of centers fall with what is spent."""
        c = self.config
        share = self.budget.share
        means = c.means_rate ** (1.0 - share) * c.means_rate_end**share * self.extent
        return {**super().rates(), "means": means}

    def advance(self) -> float:
        """Take one step; return its loss without the penalty."""
        if self.budget.share > GROWS:
            self.densifier = None
        if self.penalty is not None:
            self.penalty(self.parameters, self.step).backward()  # type: ignore[no-untyped-call]
        return super().advance()

    def spend(self, progress: Progress = silent) -> Gaussians:
        """Train until the budget is spent; return the scene."""
        while self.budget.step():
            self.advance()
            progress("train", round(100 * self.budget.share), 100)
        return self.gaussians()


def train_gaussians(course: Course, budget: Budget, progress: Progress = silent) -> Gaussians:
    """Return the scene that the plain trainer makes of the photographs: 3DGS."""
    return BudgetTrainer(course, budget).spend(progress)


def descend(
    course: Course,
    budget: Budget,
    draw: Callable[[Cameras], tuple[Tensor, Tensor]],
    rates: dict[Tensor, float],
    *,
    rates_end: float = 0.05,
    progress: Progress = silent,
) -> None:
    """Change tensors in place by Adam until the budget is spent, so that drawn views resemble the photographs.

    Args:
        course: What to train on.
        budget: What to spend.
        draw: Function from a camera to its image (H, W, 3) and a further loss.
        rates: Learning rate of each tensor at the start.
        rates_end: Factor on all rates at the end; they fall to it exponentially.
        progress: Called with stage "train".
    """
    groups = [{"params": [tensor], "lr": rate, "first": rate} for tensor, rate in rates.items()]
    adam = torch.optim.Adam(groups, eps=1e-15)
    step = 0
    while budget.step():
        turn, place = divmod(step, len(course.views))
        index = int(np.random.default_rng([0, turn]).permutation(len(course.views))[place])
        image, more = draw(course.views.cameras[index])
        loss = photometric_loss(image, torch.from_numpy(course.views.image(index))) + more
        adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        for group in adam.param_groups:
            group["lr"] = group["first"] * rates_end**budget.share
        adam.step()
        step += 1
        progress("train", round(100 * budget.share), 100)
