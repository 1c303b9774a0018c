"""Rendering: images, weights and gradients of Gaussians, colored by SH, RGB or SRBF, on the CPU and elsewhere."""

from gsvis.render.metrics import flip, lpips, psnr, ssim
from gsvis.render.rasterizer import Rendering, rasterize
from gsvis.render.removal import RemovalEffects, removal_effects
from gsvis.render.tensors import GaussianTensors
from gsvis.render.weights import PixelContributors, ViewWeights, contributors, view_weights

__all__ = [
    "GaussianTensors",
    "PixelContributors",
    "RemovalEffects",
    "Rendering",
    "ViewWeights",
    "contributors",
    "flip",
    "lpips",
    "psnr",
    "rasterize",
    "removal_effects",
    "ssim",
    "view_weights",
]


def __dir__() -> list[str]:
    return sorted(__all__)
