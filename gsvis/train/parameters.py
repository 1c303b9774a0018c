"""Hold trainable values: raw values of Gaussians, their Adam moments, and edits of rows that keep both consistent.

Raw values are unbounded: `log_scales`, `logit_opacities`, quaternions of any length; colors are SH. The first `frozen`
rows are rendered but never changed. Nothing here renders or chooses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsvis.render.tensors import GaussianTensors
from gsvis.scene.gaussians import Gaussians
from gsvis.train._kernels.adam import adam_step

__all__ = ["NAMES", "Parameters"]

NAMES = ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN")

_MOST_LOGIT = 16.0  # opacity 1 - 1e-7, the largest below 1 in float32
_BETAS = (0.9, 0.999)
_EPS = 1e-15


@dataclass(frozen=True, eq=False)
class _Active:
    """Activated values of N Gaussians on the CPU; those of frozen rows are found once.

    Attributes:
        scales: (N, 3).
        opacities: (N,).
        frozen: Number of first rows that never change.
    """

    scales: Tensor
    opacities: Tensor
    frozen: int

    @classmethod
    def of(cls, log_scales: Tensor, logits: Tensor, frozen: int) -> _Active:
        """Return the activated values of raw ones."""
        with torch.no_grad():
            return cls(log_scales.exp(), logits.sigmoid(), frozen)


class _Activate(torch.autograd.Function):
    """Activate the rows that are not frozen; only these get gradients."""

    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, logits: Tensor, active: _Active) -> tuple[Tensor, Tensor]:
        """Return scales and opacities, which share the memory of `active`."""
        own = slice(active.frozen, None)
        torch.exp(log_scales[own], out=active.scales[own])
        torch.sigmoid(logits[own], out=active.opacities[own])
        ctx.active = active
        return active.scales.detach(), active.opacities.detach()

    @staticmethod
    def backward(ctx: Any, by_scales: Tensor, by_opacities: Tensor) -> tuple[Tensor, Tensor, None]:
        """Return the gradients by the raw values; memory of frozen rows is never touched."""
        active: _Active = ctx.active
        own = slice(active.frozen, None)
        by_log_scales = _zeros_of(active.scales)
        by_log_scales[own] = by_scales[own] * active.scales[own]
        by_logits = _zeros_of(active.opacities)
        share = active.opacities[own]
        by_logits[own] = by_opacities[own] * (1.0 - share) * share
        return by_log_scales, by_logits, None


@dataclass(eq=False, repr=False)
class Parameters:
    """N Gaussians in training.

    Attributes:
        values: Raw tensors by name: means (N, 3), log_scales (N, 3), quats (N, 4), logit_opacities (N,), sh0 (N, 1,
            3), shN (N, K-1, 3); leaves that collect gradients.
        first: First moments of Adam, shaped as the values.
        second: Second moments of Adam, shaped as the values.
        frozen: Number of first rows that never change.
        steps: Adam steps taken.
    """

    values: dict[str, Tensor]
    first: dict[str, Tensor]
    second: dict[str, Tensor]
    frozen: int = 0
    steps: int = 0
    _active: _Active | None = field(default=None, init=False)

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians, *, frozen: int = 0) -> Parameters:
        """Return the raw values of a scene, with moments 0, on the CPU."""
        opacities = torch.tensor(gaussians.opacities)
        raw = {
            "means": torch.tensor(gaussians.means),
            "log_scales": torch.tensor(gaussians.scales).log(),
            "quats": torch.tensor(gaussians.quats),
            "logit_opacities": torch.logit(opacities).clamp(-_MOST_LOGIT, _MOST_LOGIT),
            "sh0": torch.tensor(gaussians.sh0),
            "shN": torch.tensor(gaussians.shN),
        }
        values = {name: raw[name].requires_grad_() for name in NAMES}
        first, second = ({name: _zeros_of(v) for name, v in values.items()} for _ in "12")
        return cls(values, first, second, frozen)

    def __len__(self) -> int:
        return len(self.values["means"])

    def activate(self) -> GaussianTensors:
        """Return activated tensors for a rasterizer; gradients flow back to the raw values that may change.

        The tensors hold until the next call.
        """
        v = self.values
        if self.frozen == 0 or v["means"].device.type != "cpu":
            scales = v["log_scales"].exp()
            opacities = v["logit_opacities"].sigmoid()
        else:
            if self._active is None or len(self._active.opacities) != len(self):
                self._active = _Active.of(v["log_scales"], v["logit_opacities"], self.frozen)
            scales, opacities = _Activate.apply(v["log_scales"], v["logit_opacities"], self._active)  # type: ignore[no-untyped-call]
        return GaussianTensors(v["means"], v["quats"], scales, opacities, v["sh0"], v["shN"])

    def gaussians(self) -> Gaussians:
        """Return a copy of the current scene in NumPy."""
        with torch.no_grad():
            now = self.activate()
            return Gaussians(**{name: part.cpu().numpy().copy() for name, part in vars(now).items()})

    def adam_step(self, rates: Mapping[str, float]) -> None:
        """Take one step of Adam along the collected gradients, then clear them; frozen rows do not change.

        Args:
            rates: Learning rate of each name.

        Raises:
            torch.OutOfMemoryError: If the memory of a device does not suffice; nothing has changed then.

        References:
            Kingma and Ba, "Adam: a method for stochastic optimization", ICLR 2015, algorithm 1.
        """
        scratch = self._scratch()
        self.steps += 1
        beta1, beta2 = _BETAS
        root = math.sqrt(1.0 - beta2**self.steps)
        with torch.no_grad():
            for name, value in self.values.items():
                gradient = value.grad
                value.grad = None
                if gradient is None or value.numel() == 0:
                    continue
                rate = rates[name] / (1.0 - beta1**self.steps)
                value = value[self.frozen :]
                gradient = gradient[self.frozen :]
                first = self.first[name][self.frozen :]
                second = self.second[name][self.frozen :]
                if scratch is None:
                    _adam_cpu(value, gradient, first, second, rate, root)
                else:
                    adam_reference(value, gradient, first, second, rate, root, scratch)

    def _scratch(self) -> Tensor | None:
        """Return room for a step on a device, so that no memory is needed once it has begun; None on the CPU."""
        device = next(iter(self.values.values())).device
        if device.type == "cpu":
            return None
        return torch.empty(max(value[self.frozen :].numel() for value in self.values.values()), device=device)

    def forget_gradients(self) -> None:
        """Drop the collected gradients."""
        for value in self.values.values():
            value.grad = None

    def copy(self) -> Parameters:
        """Return other parameters with the same tensors: edits of rows change only one of both."""
        return Parameters(dict(self.values), dict(self.first), dict(self.second), self.frozen, self.steps)

    def move(self, device: str) -> None:
        """Move all values to a device; gradients are dropped.

        Raises:
            torch.OutOfMemoryError: If they do not fit. Some may lie there then; another call moves all.
        """
        self._active = None
        for store in (self.values, self.first, self.second):
            store.update({name: each.detach().to(device) for name, each in store.items()})
        for value in self.values.values():
            value.requires_grad_()

    def keep(self, rows: Tensor) -> None:
        """Keep only the rows of a mask or an index, with their moments; it must begin with the frozen rows."""
        for moments in (self.first, self.second):
            moments.update({name: m[rows].contiguous() for name, m in moments.items()})
        for name, value in self.values.items():
            self.values[name] = value.detach()[rows].contiguous().requires_grad_()

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Append rows of raw values, with moments 0."""
        for name, new in rows.items():
            nothing = torch.zeros_like(new)
            for moments in (self.first, self.second):
                moments[name] = torch.cat([moments[name], nothing])
            self.values[name] = torch.cat([self.values[name].detach(), new.detach()]).requires_grad_()

    def replace(self, name: str, rows: Tensor | slice, values: Tensor) -> None:
        """Replace raw values, and set their moments to 0."""
        with torch.no_grad():
            self.values[name][rows] = values
        self.first[name][rows] = 0.0
        self.second[name][rows] = 0.0

    def raise_sh_degree(self, degree: int) -> None:
        """Extend SH to a degree with zeros; do nothing if it is high enough."""
        have = self.values["shN"].shape[1]
        want = (degree + 1) ** 2 - 1
        if want <= have:
            return
        for store in (self.values, self.first, self.second):
            held = store["shN"].detach()
            store["shN"] = torch.cat([held, held.new_zeros(len(held), want - have, 3)], dim=1).contiguous()
        self.values["shN"].requires_grad_()


def _zeros_of(value: Tensor) -> Tensor:
    """Return zeros of the same shape; those of frozen rows are never touched and take no memory."""
    return torch.from_numpy(np.zeros(tuple(value.shape), np.float32))


def _adam_cpu(value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, root: float) -> None:
    """Take one Adam step with the kernel."""
    flat = (t.reshape(-1).numpy() for t in (value, gradient.contiguous(), first, second))
    adam_step(*flat, rate, *_BETAS, _EPS, root)


def adam_reference(
    value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, root: float, scratch: Tensor
) -> None:
    """Take the same step in torch, on any device; the slow twin of the kernel.

    Args:
        value: Raw values, changed in place, as the moments are.
        gradient: The gradient by them.
        first: First moments.
        second: Second moments.
        rate: Learning rate, corrected for the first steps.
        root: Correction of the root of second moments.
        scratch: Room for at least as many numbers, which is overwritten.
    """
    beta1, beta2 = _BETAS
    first.lerp_(gradient, 1.0 - beta1)
    second.mul_(beta2).addcmul_(gradient, gradient, value=1.0 - beta2)
    spread = scratch[: second.numel()].view(second.shape)
    torch.sqrt(second, out=spread)
    value.addcdiv_(first, spread.div_(root).add_(_EPS), value=-rate)
