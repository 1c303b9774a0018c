"""Load kernels before work begins, or compile them once after an installation, so that progress shows this time."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from gsvis.cli.terminal import Status
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

if TYPE_CHECKING:
    from gsvis.prepare.colors import ColorConfig
    from gsvis.pvs.config import PvsConfig
    from gsvis.train.levels import LevelsConfig

__all__ = ["warm_colors", "warm_levels", "warm_sets"]


def warm_levels(config: LevelsConfig, status: Status) -> None:
    """Load or compile the kernels that train levels."""
    from gsvis.scene.cameras import Cameras
    from gsvis.train.images import render_views
    from gsvis.train.levels import LevelsConfig, train_levels

    status("kernels", 0, 1)
    rng = np.random.default_rng(0)
    few = Gaussians(
        rng.normal(size=(12, 3)), [[1, 0, 0, 0]] * 12, np.full((12, 3), 0.3), [0.5] * 12, [[[1, 1, 1]]] * 12
    )
    views = render_views(few, Cameras.orbit((0.0, 0.0, 0.0), 4.0, 2, width=16, height=16))
    train_levels(few, views, replace(LevelsConfig(iterations=1), backend=config.backend))
    status("kernels", 1, 1)


def warm_sets(config: PvsConfig, status: Status) -> None:
    """Load or compile the kernels that find visible sets."""
    if config.method == "hybrid":  # other methods need libraries that may take too much memory in this process
        from gsvis.pvs.cell_view import Finder
        from gsvis.scene.levels import Levels

        status("kernels", 0, 1)
        one = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.4], np.zeros((1, 1, 3)))
        Finder(Levels.single(one), replace(config, size=4)).warm()
        status("kernels", 1, 1)


def warm_colors(config: ColorConfig, status: Status) -> None:
    """Load or compile the kernels that fit colors."""
    from gsvis.color.activation import Activation
    from gsvis.color.evaluate import evaluate
    from gsvis.prepare.colors import ColorConfig, prepare_colors
    from gsvis.prepare.fitted_colors import round_colors
    from gsvis.scene.view_sampling import ViewSampling

    status("kernels", 0, 1)
    bands = np.linspace(-0.3, 0.3, 9).reshape(1, 3, 3)
    one = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], np.zeros((1, 1, 3)), bands)
    around = NavigableSpace.from_box((3, 3, 3), (4, 4, 4), 1)
    quick = ColorConfig(replace(config.fit, mean_terms=None, max_terms=1), ViewSampling(1, 16, 12))
    colors = round_colors(prepare_colors(one, around, quick).fit.colors, "wire")
    evaluate(colors, one.means, (4.0, 0.0, 0.0))
    Activation(colors, one.means, 0.01).contributions((4.0, 0.0, 0.0))
    status("kernels", 1, 1)
