"""The configuration of planner and session: how a stream adapts to its viewer and link. Seconds, bytes, radians."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsvis import _check
from gsvis.abr.estimate import ESTIMATORS
from gsvis.abr.policies import POLICIES, UtilityConfig
from gsvis.abr.predict import PREDICTORS
from gsvis.scene.levels import PREVIEW

__all__ = ["AbrConfig"]


@dataclass(frozen=True)
class AbrConfig:
    """How a stream adapts.

    Attributes:
        policy: One of `POLICIES`.
        estimator: One of `ESTIMATORS`.
        predictor: One of `PREDICTORS`.
        lead: Seconds ahead to predict the pose for. A Gaussian in view now or then counts as in view; 0 means now only.
        turn: Radians by which the head must turn before records are ranked again; at most the margin of the view.
        ahead: Seconds ahead to predict the cell for: what it sees goes before what only other neighbors see. Terms are
            sent for the eyes now and in `lead` seconds alone. 0 means no cell ahead.
        epsilon: How much a term must change the image to be sent for a pose, as a multiple of the package's epsilon. It
            is the change of the color (equation 7) times the blending weight of the Gaussian, times the root of its
            solid angle over that of a square of 6 mrad. Their squares add up to the squared error of the image.
        first_epsilon: The same for a first pass over the view, so that details of colors do not hold up geometry. What
            is in view only by its margin gets no more than that.
        strong: Falling multiples of the package's epsilon. In the first pass of the policy "utility", terms that change
            the image by as much go among the geometry that gains as much: see `UtilityConfig.change`. At most six.
        parallax: Radians by which the direction to a Gaussian changes before its terms are checked again.
        picture: A view begins with the levels of at most this share of the Gaussians, also where the highest level
            arrives soon. What belongs to them alone is sent in view only. 0 means that there is no such level.
        replaced: A Gaussian is dropped when its replacements are held, or this share of their area, in (0, 1].
        covered: The same share for a Gaussian of these levels alone, which is much larger than its replacements.
        fill: Whether an idle link gets what the view does not need: the terms of what is out of view, then the rest of
            the scene by distance to the nearest cell that sees it.
        move: Share of the side of a cell by which the head must move before records are ranked again.
        horizon: Seconds within which the highest level of a cell should arrive for the bandwidth to count as high.
            Lower levels are left out then; a view begins sooner with them.
        window: Seconds of data that may be in flight; if messages are longer than `piece`, at least two of them may.
        piece: Seconds that the link should take for one message. A client shows a message only when it is complete.
        begin: Bytes of a session until which messages are small: a quarter of what has been sent, or 4,096 bytes. So
            the first picture comes sooner on a slow link.
        start_rate: Bytes of messages a second, assumed before the first acknowledgement.
        utility: Factors of the policy "utility".
    """

    policy: str = "utility"
    estimator: str = "harmonic"
    predictor: str = "kalman"
    lead: float = 0.25
    ahead: float = 1.0
    epsilon: float = 0.17
    first_epsilon: float = 0.3
    strong: tuple[float, ...] = (6.0, 2.0, 0.7)
    parallax: float = 0.03
    picture: float = PREVIEW
    replaced: float = 0.4
    covered: float = 0.6
    fill: bool = True
    turn: float = 0.087
    move: float = 0.1
    horizon: float = 0.25
    window: float = 0.3
    piece: float = 0.05
    begin: float = 16384.0
    start_rate: float = 250e3
    utility: UtilityConfig = field(default_factory=UtilityConfig)

    def __post_init__(self) -> None:
        _check.one_of("policy", self.policy, POLICIES)
        _check.one_of("estimator", self.estimator, ESTIMATORS)
        _check.one_of("predictor", self.predictor, PREDICTORS)
        for name in ("lead", "ahead", "parallax", "turn", "move"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name}: expected a finite number >= 0, got {getattr(self, name)!r}")
        falls = list(self.strong) == sorted(set(self.strong), reverse=True)
        if not (falls and len(self.strong) <= 6 and all(0 < change < np.inf for change in self.strong)):
            raise ValueError(f"strong: expected at most six falling numbers > 0, got {self.strong!r}")
        if not self.begin >= 0:
            raise ValueError(f"begin: expected bytes >= 0, got {self.begin!r}")
        if not 0 <= self.picture <= 1:
            raise ValueError(f"picture: expected a share in [0, 1], got {self.picture!r}")
        for name in ("replaced", "covered"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a share in (0, 1], got {getattr(self, name)!r}")
        for name in ("epsilon", "first_epsilon", "horizon", "window", "piece", "start_rate"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {getattr(self, name)!r}")
