"""Find epsilon of a scene by its own images: the staircase of the paper, with FLIP in place of a person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from gsvis.color.epsilon import FLIP_JND, EpsilonCalibration, MetricObserver, calibrate_epsilon
from gsvis.color.srbf import SrbfColors
from gsvis.prepare.approximations import Approximations, flip_difference
from gsvis.progress import Progress, silent
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

if TYPE_CHECKING:
    from gsvis.color.epsilon import Observer

__all__ = ["OBSERVED", "Epsilon", "calibrate_by_flip"]

OBSERVED = ViewSampling(4, stream=2)
"""Views in which the model observer looks for differences; stream 0 is that of the fit, 1 that of held-out views."""


@dataclass(frozen=True)
class Epsilon:
    """Epsilon of a package, and where it comes from.

    Attributes:
        value: Contribution above which a term is active.
        staircase: The trials that found it; None if it was given.
    """

    value: float
    staircase: dict[str, Any] | None = None

    @classmethod
    def from_staircase(cls, found: EpsilonCalibration) -> Epsilon:
        """Return the result of a staircase."""
        return cls(found.epsilon, found.as_dict())


def calibrate_by_flip(
    scene: Gaussians | Levels,
    space: NavigableSpace | None,
    drawn: tuple[Gaussians, SrbfColors],
    views: ViewSampling = OBSERVED,
    *,
    progress: Progress = silent,
) -> EpsilonCalibration | None:
    """Return the epsilon at which the model observer FLIP notices missing terms in 75% of its trials.

    Args:
        scene: The scene or its levels, which say where views are drawn.
        space: The navigable space.
        drawn: The Gaussians that the images show, and their colors.
        views: Views of the observer.
        progress: Called with stage "epsilon".

    Returns:
        The result of the staircase; None if there are no terms or no viewpoints.

    Raises:
        BackendError: If the package flip-evaluator is missing.

    References:
        SRBF-Gaussian, section 6.2.
    """
    if drawn[1].num_terms == 0 or space is None:
        return None
    progress("epsilon", 0, 1)
    images = {"views": views.count, "width": views.width, "height": views.height, "fov": views.fov, "seed": views.seed}
    pictures = Approximations(*drawn, views.cameras(scene, space))
    observer = MetricObserver(flip_difference(pictures), FLIP_JND, images=images)
    calibration = calibrate_epsilon(cast("Observer", observer))
    progress("epsilon", 1, 1)
    return calibration
