"""The plain twin of `learn_colors`: draws everything by the rasterizer, and steps all rows by torch."""

from __future__ import annotations

from dataclasses import replace

import torch

from gsvis.color.evaluate_torch import SrbfTensors
from gsvis.color.srbf import MAX_DECAY, SrbfColors
from gsvis.render.rasterizer import rasterize
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.gaussians import Gaussians
from gsvis.train.colors import LearnConfig, view_of_step
from gsvis.train.images import PosedImages
from gsvis.train.loss import photometric_loss

__all__ = ["learn_colors_reference"]


def learn_colors_reference(g: Gaussians, colors: SrbfColors, views: PosedImages, config: LearnConfig) -> SrbfColors:
    """Return SRBF colors that show given images better, to rounding those of `learn_colors`.

    Args:
        g: N Gaussians.
        colors: Colors to begin with.
        views: Images to show, with their cameras.
        config: Options.
    """
    start = SrbfTensors.from_colors(colors, requires_grad=True)
    growth = torch.zeros_like(start.decays, requires_grad=True)
    rates = {
        start.base: config.base_rate,
        start.intensities: config.intensity_rate,
        start.centers: config.center_rate,
        growth: config.decay_rate,
    }
    adam = torch.optim.Adam([{"params": [each], "lr": rate} for each, rate in rates.items()], eps=1e-15)
    fall = torch.optim.lr_scheduler.ExponentialLR(adam, config.rates_end ** (1.0 / max(config.steps - 1, 1)))
    scene = GaussianTensors.from_gaussians(g)

    def grow() -> SrbfTensors:
        """Return the colors with their grown decays."""
        return replace(start, decays=(start.decays.detach() * growth.exp()).clamp(max=MAX_DECAY))

    for step in range(config.steps):
        index = view_of_step(step, len(views), config.seed)
        camera = views.cameras[index]
        image = rasterize(scene, camera, colors=grow(), antialiased=g.facts.antialiased).images[0]
        target = torch.from_numpy(views.image(index))
        if config.squared:
            loss = (image - target).square().mean()
        else:
            loss = photometric_loss(image, target, config.ssim_weight)
        adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
        fall.step()
    return grow().to_colors()
