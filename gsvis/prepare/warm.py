"""Load kernels before work begins, or compile them once after an installation, so that progress shows this time.

Each function runs the work once on a scene of a few Gaussians, as stage "kernels".
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from gsvis.progress import Progress
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

if TYPE_CHECKING:
    from gsvis.prepare.colors import ColorConfig
    from gsvis.pvs.config import PvsConfig
    from gsvis.train.levels import LevelsConfig
    from gsvis.train.trainer import TrainConfig

__all__ = ["warm_analysis", "warm_colors", "warm_levels", "warm_rendering", "warm_sets", "warm_training"]


def warm_rendering(backend: str, progress: Progress) -> None:
    """Load or compile the kernels that render."""
    from gsvis.render.rasterizer import rasterize

    progress("kernels", 0, 1)
    if backend == "cpu":
        one, camera = _one_and_camera()
        rasterize(one, camera, backend="cpu")
    progress("kernels", 1, 1)


def warm_analysis(progress: Progress) -> None:
    """Load or compile the kernels that analyze a scene."""
    from gsvis.raycast.analysis import AnalysisConfig, analyze

    progress("kernels", 0, 1)
    one, camera = _one_and_camera()
    around = NavigableSpace.from_box((3, 3, 3), (4, 4, 4), 1)
    analyze(one, camera, AnalysisConfig(traced_sample=1), navigable=around)
    progress("kernels", 1, 1)


def _one_and_camera() -> tuple[Gaussians, Cameras]:
    """Return a scene of one Gaussian, and a camera of one pixel that sees it."""
    one = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], np.zeros((1, 1, 3)))
    return one, Cameras.look_at([[4.0, 0.0, 0.0]], (0.0, 0.0, 0.0), width=1, height=1)


def warm_training(config: TrainConfig, progress: Progress) -> None:
    """Load or compile the kernels that train a scene on photographs."""
    from gsvis.scene.points import PointCloud
    from gsvis.train.images import PosedImages
    from gsvis.train.initial import gaussians_from_points
    from gsvis.train.trainer import Trainer

    progress("kernels", 0, 1)
    around = Cameras.orbit((0.0, 0.0, 0.0), 4.0, 2, width=16, height=16)
    views = PosedImages(around, np.zeros((2, 16, 16, 3), np.uint8))
    brief = replace(config, iterations=1, densify=None, evaluate_every=0)
    Trainer(views, gaussians_from_points(PointCloud(np.eye(3))), brief, held_out=views[:1]).run()
    progress("kernels", 1, 1)


def warm_levels(config: LevelsConfig, progress: Progress) -> None:
    """Load or compile the kernels that train levels."""
    from gsvis.train.images import render_views
    from gsvis.train.levels import LevelsConfig, train_levels

    progress("kernels", 0, 1)
    rng = np.random.default_rng(0)
    few = Gaussians(
        rng.normal(size=(12, 3)), [[1, 0, 0, 0]] * 12, np.full((12, 3), 0.3), [0.5] * 12, [[[1, 1, 1]]] * 12
    )
    views = render_views(few, Cameras.orbit((0.0, 0.0, 0.0), 4.0, 2, width=16, height=16))
    train_levels(few, views, replace(LevelsConfig(iterations=1), backend=config.backend))
    progress("kernels", 1, 1)


def warm_sets(config: PvsConfig, progress: Progress) -> None:
    """Load or compile the kernels that find visible sets."""
    if config.method == "hybrid":  # other methods need libraries that may take too much memory in this process
        from gsvis.pvs.cell_view import Finder
        from gsvis.scene.levels import Levels

        progress("kernels", 0, 1)
        one = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.4], np.zeros((1, 1, 3)))
        Finder(Levels.single(one), replace(config, size=4)).warm()
        progress("kernels", 1, 1)


def warm_colors(config: ColorConfig, progress: Progress) -> None:
    """Load or compile the kernels that fit colors."""
    from gsvis.color.activation import Activation
    from gsvis.color.evaluate import evaluate
    from gsvis.prepare.colors import ColorConfig, prepare_colors
    from gsvis.prepare.fitted_colors import round_colors
    from gsvis.scene.view_sampling import ViewSampling

    progress("kernels", 0, 1)
    bands = np.linspace(-0.3, 0.3, 9).reshape(1, 3, 3)
    one = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], np.zeros((1, 1, 3)), bands)
    around = NavigableSpace.from_box((3, 3, 3), (4, 4, 4), 1)
    quick = ColorConfig(replace(config.fit, mean_terms=None, max_terms=1), ViewSampling(1, 16, 12))
    colors = round_colors(prepare_colors(one, around, quick).fit.colors, "wire")
    evaluate(colors, one.means, (4.0, 0.0, 0.0))
    Activation(colors, one.means, 0.01).contributions((4.0, 0.0, 0.0))
    progress("kernels", 1, 1)
