"""Densify a scene in training: clone, split, prune, reset opacities.

The default rules of 3DGS, and the gentler ones of SRBF-Gaussian for levels with frozen rows (`split=False`,
`most_share`). They depend on the mean length of the loss's gradient by projected centers, in half image sizes.

References:
    Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering", TOG 2023, section 5.2.
    SRBF-Gaussian, section 6.1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsvis.render.tensors import rotations_from_quats
from gsvis.train.config import DensifyConfig
from gsvis.train.parameters import Parameters

__all__ = ["Densifier", "DensifyConfig"]

_FAINT = math.log(0.05 / 0.95)  # initial logit of the clone of a frozen Gaussian, whose own opacity cannot change
_SMALLER = 1.6  # ratio of a split Gaussian's size to that of its two parts


class Densifier:
    """Sum gradients between changes, and add and remove Gaussians.

    Args:
        config: The rules.
        extent: Size of the scene in its units, the distance of cameras from their middle.
        parameters: Trained values; `refine` edits them in place.

    Attributes:
        total: (N,) summed length of gradients.
        seen: (N,) float, the number of views with a gradient for each Gaussian.
    """

    def __init__(self, config: DensifyConfig, extent: float, parameters: Parameters) -> None:
        self.config = config
        self.extent = extent
        self.parameters = parameters
        self._reset_sums()

    def _reset_sums(self) -> None:
        """Reset the sums."""
        like = self.parameters.values["logit_opacities"].detach()
        self.total = torch.zeros_like(like)
        self.seen = torch.zeros_like(like)

    def observe(self, gradient: Tensor, width: int, height: int) -> None:
        """Add the gradient (N, 2) of one view's loss by projected centers in pixels."""
        self.add(self.lengths(gradient, width, height))

    def lengths(self, gradient: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
        """Return what `add` takes: lengths (N,) in half image sizes of a gradient (N, 2), and 1 for each above 0."""
        length = torch.hypot(gradient[:, 0] * (0.5 * width), gradient[:, 1] * (0.5 * height))
        return length, (length > 0).to(length)

    def add(self, lengths: tuple[Tensor, Tensor]) -> None:
        """Add the lengths of one view's gradient; needs no memory."""
        self.total += lengths[0]
        self.seen += lengths[1]

    def move(self, device: str) -> None:
        """Move the sums to a device."""
        self.total = self.total.to(device)
        self.seen = self.seen.to(device)

    def refine(self, step: int, generator: torch.Generator) -> tuple[int, int]:
        """Change the Gaussians if this step requires it.

        Args:
            step: Steps taken, from 1.
            generator: Random numbers for the positions of split parts.

        Returns:
            Number of added and number of pruned Gaussians.
        """
        c = self.config
        if c.reset_every and step % c.reset_every == 0 and step <= c.stop:
            self._reset()
        if step <= c.start or step > c.stop or step % c.every:
            return 0, 0
        with torch.no_grad():
            before = len(self.parameters)
            removed = self._grow(generator)
            grown = len(self.parameters)
            prune = torch.cat([removed, removed.new_zeros(grown - before)])
            split = int(prune.sum())
            prune |= self._is_spent(step)
            prune[: self.parameters.frozen] = False
            self.parameters.keep(~prune)
            self._reset_sums()
        return grown - before - split, int(prune.sum()) - split

    def _grow(self, generator: torch.Generator) -> Tensor:
        """Append clones and parts; return the mask (N before) of split Gaussians, which must be removed."""
        c = self.config
        p = self.parameters
        mean = self.total / self.seen.clamp(min=1.0)
        chosen = mean > c.threshold
        room = max(min(int(c.most_share * len(p)), c.most_count - len(p)), 0)
        if int(chosen.sum()) > room:
            largest = torch.argsort(mean, descending=True, stable=True)[:room]
            among = torch.zeros_like(chosen)
            among[largest] = True
            chosen &= among
        large = p.values["log_scales"].detach().amax(dim=1) > math.log(c.small * self.extent)
        split = chosen & large if c.split else torch.zeros_like(chosen)
        split[: p.frozen] = False  # frozen Gaussians are cloned instead
        cloned = {name: value.detach()[chosen & ~split] for name, value in p.values.items()}
        standing = int((chosen & ~split)[: p.frozen].sum())
        cloned["logit_opacities"][:standing] = cloned["logit_opacities"][:standing].clamp(max=_FAINT)
        parts = self._parts(split, generator)
        p.append({name: torch.cat([cloned[name], parts[name]]) for name in cloned})
        return split

    def _parts(self, split: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """Return two smaller Gaussians for each Gaussian of a mask, drawn from its distribution."""
        rows = {name: value.detach()[split] for name, value in self.parameters.values.items()}
        parts = {name: torch.cat([value, value]) for name, value in rows.items()}
        normal = torch.randn(parts["means"].shape, generator=generator).to(parts["means"])
        offsets = normal * parts["log_scales"].exp()
        parts["means"] = parts["means"] + torch.einsum("nij,nj->ni", rotations_from_quats(parts["quats"]), offsets)
        parts["log_scales"] = parts["log_scales"] - math.log(_SMALLER)
        return parts

    def _is_spent(self, step: int) -> Tensor:
        """Return the mask of Gaussians that are too faint or too large."""
        c = self.config
        values = self.parameters.values
        spent = values["logit_opacities"].detach().sigmoid() < c.least_opacity
        if c.reset_every and step > c.reset_every:
            spent |= values["log_scales"].detach().amax(dim=1) > math.log(c.largest * self.extent)
        return spent

    def _reset(self) -> None:
        """Lower all opacities to twice the pruning threshold; important Gaussians recover."""
        p = self.parameters
        rows = slice(p.frozen, None)
        most = math.log(2.0 * self.config.least_opacity / (1.0 - 2.0 * self.config.least_opacity))
        p.replace("logit_opacities", rows, p.values["logit_opacities"].detach()[rows].clamp(max=most))
