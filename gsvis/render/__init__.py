"""Render Gaussians: images, weights and gradients, with SH, RGB or SRBF colors, on the CPU or a GPU."""

from typing import TYPE_CHECKING, Any

from gsvis.render.fill import Fill, fill_around, measure_fill
from gsvis.render.metrics import flip, lpips, psnr, ssim
from gsvis.render.rasterizer import Rendering, rasterize
from gsvis.render.removal import RemovalEffects, removal_effects
from gsvis.render.weights import PixelContributors, ViewWeights, contributors, view_weights

if TYPE_CHECKING:
    from gsvis.render.rasterizer_torch import RenderingTensors
    from gsvis.render.tensors import GaussianTensors

__all__ = [
    "Fill",
    "GaussianTensors",
    "PixelContributors",
    "RemovalEffects",
    "Rendering",
    "RenderingTensors",
    "ViewWeights",
    "contributors",
    "fill_around",
    "flip",
    "lpips",
    "measure_fill",
    "psnr",
    "rasterize",
    "removal_effects",
    "ssim",
    "view_weights",
]


def __getattr__(name: str) -> Any:
    """Import the torch classes on first use."""
    if name in ("GaussianTensors", "RenderingTensors"):
        from gsvis._extras import require

        require(f"gsvis.render.{name}", "torch")
        if name == "GaussianTensors":
            from gsvis.render.tensors import GaussianTensors

            return GaussianTensors
        from gsvis.render.rasterizer_torch import RenderingTensors

        return RenderingTensors
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
