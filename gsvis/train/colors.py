"""Learn colors by gradient: base colors and terms of SRBF colors, or SH, of Gaussians whose geometry stays fixed.

The targets are photographs, or renders of the scene itself. A step draws one view, compares it, and updates the colors
with Adam. Images, frames and cameras are those of `PosedImages`. This module writes no file and starts no fit: it takes
colors that `gsvis.color.fit_srbf` found.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsvis import _check
from gsvis.color.evaluate_torch import SrbfTensors
from gsvis.color.srbf import MAX_DECAY, SrbfColors, spherical_coordinates, unit_vectors
from gsvis.progress import Progress, silent
from gsvis.render.rasterizer import rasterize
from gsvis.render.tensors import GaussianTensors
from gsvis.render.weights import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.images import PosedImages
from gsvis.train.loss import photometric_loss

__all__ = ["LearnConfig", "learn_colors", "learn_sh"]


@dataclass(frozen=True)
class LearnConfig:
    """Options of learning colors.

    Attributes:
        steps: Number of steps, one view each; 0 leaves the colors as they are.
        base_rate: Learning rate of base colors, and of the constant of SH.
        intensity_rate: Learning rate of intensities.
        center_rate: Learning rate of the angles of centers, radians.
        decay_rate: Learning rate of the logarithms of decays.
        sh_rate: Learning rate of the other coefficients of SH, for `learn_sh`.
        rates_end: Factor on all rates at the last step; they fall to it exponentially.
        ssim_weight: Share of SSIM in the loss; the rest is the mean absolute difference.
        squared: Whether the loss is the mean squared difference instead, which suits renders as targets.
        seed: Seed of the order of views.

    Raises:
        ValueError: If a value is out of range.
    """

    steps: int = 300
    base_rate: float = 5e-3
    intensity_rate: float = 5e-3
    center_rate: float = 1e-2
    decay_rate: float = 1e-2
    sh_rate: float = 1.25e-4
    rates_end: float = 0.1
    ssim_weight: float = 0.2
    squared: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "seed"):
            _check.positive_int(name, getattr(self, name), at_least=0)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_rate") and not 0.0 <= value < math.inf:
                raise ValueError(f"{field.name}: expected a finite number of at least 0, got {value!r}")
        if not 0.0 < self.rates_end <= 1.0:
            raise ValueError(f"rates_end: expected a factor in (0, 1], got {self.rates_end!r}")
        if not 0.0 <= self.ssim_weight <= 1.0:
            raise ValueError(f"ssim_weight: expected a share in [0, 1], got {self.ssim_weight!r}")

    @classmethod
    def for_renders(cls, steps: int = 300, seed: int = 0) -> LearnConfig:
        """Return options for renders of the scene, which the fitted colors resemble already: small steps, squares."""
        return cls(
            steps=steps,
            base_rate=2e-4,
            intensity_rate=5e-4,
            center_rate=4e-3,
            decay_rate=1e-2,
            squared=True,
            seed=seed,
        )


def learn_colors(
    g: Gaussians,
    colors: SrbfColors,
    views: PosedImages,
    config: LearnConfig | None = None,
    *,
    shown: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
) -> SrbfColors:
    """Return SRBF colors that show given images better. Geometry and number of terms stay the same.

    Gaussians that no view shows keep their colors.

    Args:
        g: N Gaussians.
        colors: Colors to begin with, N Gaussians with T terms.
        views: Images to show, with their cameras.
        config: Options; None means `LearnConfig()`.
        shown: (N,) bool, the Gaussians to draw, such as those of the highest of several levels; None means all.
        progress: Called with every step; stage "learn".

    Raises:
        ValueError: If lengths differ, or there are no views.
    """
    config = config or LearnConfig()
    _check.same_length(g=g.means, colors=colors.base)
    if config.steps == 0 or len(colors) == 0:
        return colors
    ids = np.arange(len(g)) if shown is None else np.flatnonzero(shown)
    if len(ids) == 0:
        return colors
    start = SrbfTensors.from_colors(colors[ids], requires_grad=True)
    growth = torch.zeros_like(start.decays, requires_grad=True)  # logarithms, so that no growth changes no bit
    scene = g.without_harmonics()[ids]

    def draw(camera: Cameras) -> Tensor:
        """Return the image of one camera; what it does not blend is neither drawn nor evaluated."""
        some = _blended(scene, camera)
        tensors = GaussianTensors.from_gaussians(scene[some])
        part = _select(start, growth, some)
        return rasterize(tensors, camera, colors=part, antialiased=g.facts.antialiased).images[0]

    rates = {
        start.base: config.base_rate,
        start.intensities: config.intensity_rate,
        start.centers: config.center_rate,
        growth: config.decay_rate,
    }
    _descend(rates, draw, views, config, progress)
    return _put_back(colors, ids, replace(start, decays=_grow(start.decays, growth)))


def _grow(decays: Tensor, growth: Tensor) -> Tensor:
    """Return decays (T,) times the exponential of their growth (T,)."""
    return (decays.detach() * growth.exp()).clamp(max=MAX_DECAY)


def _blended(g: Gaussians, camera: Cameras) -> NDArray[np.int64]:
    """Return the Gaussians that a camera's image blends, ascending; the first if there is none."""
    found = np.flatnonzero(view_weights(g, camera).largest[0])
    return found if len(found) else np.zeros(1, np.int64)


def _select(colors: SrbfTensors, growth: Tensor, ids: NDArray[np.int64]) -> SrbfTensors:
    """Return the grown colors of some Gaussians (M,), with gradients by `colors` and `growth`."""
    some = torch.from_numpy(ids)
    counts = colors.offsets.diff()[some]
    offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    moves = torch.repeat_interleave(colors.offsets[some] - offsets[:-1], counts)
    terms = moves + torch.arange(len(moves))
    return SrbfTensors(
        colors.variant,
        base=colors.base.index_select(0, some),
        scales=colors.scales[some],
        offsets=offsets,
        functions=colors.functions[terms],
        centers=colors.centers.index_select(0, terms),
        decays=_grow(colors.decays[terms], growth.index_select(0, terms)),
        intensities=colors.intensities.index_select(0, terms),
    )


def _put_back(colors: SrbfColors, ids: NDArray[np.int64], learned: SrbfTensors) -> SrbfColors:
    """Return colors in which those of some Gaussians, ascending ids, are the learned ones."""
    base = colors.base.copy()
    base[ids] = learned.base.detach().numpy()
    member = np.zeros(len(colors), bool)
    member[ids] = True
    terms = member[colors.gaussian_ids]
    angles = learned.centers.detach().numpy().copy()
    moved = (angles != colors.centers[terms]).any(axis=1)
    angles[moved] = spherical_coordinates(unit_vectors(angles[moved]))
    parts = {"centers": angles, "decays": learned.decays.detach().numpy()}
    parts["intensities"] = learned.intensities.detach().numpy()
    whole = {name: getattr(colors, name).copy() for name in parts}
    for name, values in parts.items():
        whole[name][terms] = values
    return replace(colors, base=base, **whole)


def learn_sh(
    g: Gaussians, views: PosedImages, config: LearnConfig | None = None, *, progress: Progress = silent
) -> Gaussians:
    """Return the same Gaussians with SH colors that show given images better, the baseline of `learn_colors`.

    Args:
        g: N Gaussians.
        views: Images to show, with their cameras.
        config: Options; None means `LearnConfig()`.
        progress: Called with every step; stage "learn".

    Raises:
        ValueError: If there are no views.
    """
    config = config or LearnConfig()
    if config.steps == 0 or len(g) == 0:
        return g
    start = GaussianTensors.from_gaussians(g)
    sh0 = start.sh0.clone().requires_grad_()
    shN = start.shN.clone().requires_grad_()
    scene = replace(start, sh0=sh0, shN=shN)

    def draw(camera: Cameras) -> Tensor:
        """Return the image of one camera."""
        return rasterize(scene, camera, antialiased=g.facts.antialiased).images[0]

    _descend({sh0: config.base_rate, shN: config.sh_rate}, draw, views, config, progress)
    return Gaussians(g.means, g.quats, g.scales, g.opacities, sh0.detach().numpy(), shN.detach().numpy(), facts=g.facts)


def _descend(
    rates: dict[Tensor, float],
    draw: Callable[[Cameras], Tensor],
    views: PosedImages,
    config: LearnConfig,
    progress: Progress,
) -> None:
    """Change tensors in place, step by step, until drawn views resemble the images.

    Args:
        rates: Learning rate of each tensor at the first step.
        draw: Function from a camera to its image (H, W, 3).
        views: Images and cameras.
        config: Steps, loss and seed.
        progress: Called with every step; stage "learn".
    """
    if len(views) == 0:
        raise ValueError("views: expected at least one image to learn from, got none")
    adam = torch.optim.Adam([{"params": [each], "lr": rate} for each, rate in rates.items()], eps=1e-15)
    fall = torch.optim.lr_scheduler.ExponentialLR(adam, config.rates_end ** (1.0 / max(config.steps - 1, 1)))
    progress("learn", 0, config.steps)
    for step in range(config.steps):
        turn, place = divmod(step, len(views))
        index = int(np.random.default_rng([config.seed, turn]).permutation(len(views))[place])
        image = draw(views.cameras[index])
        target = torch.from_numpy(views.image(index))
        if config.squared:
            loss = (image - target).square().mean()
        else:
            loss = photometric_loss(image, target, config.ssim_weight)
        adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
        fall.step()
        progress("learn", step + 1, config.steps)
