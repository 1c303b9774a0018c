"""The scheduler: poses and acknowledgements in, batches out. One object drives the simulator and the server.

A state machine without a clock: time, in seconds, is an argument. For each client one `Scheduler`; the candidates of a
scene are shared (`CandidateStore`). Scene frame and units. Batches are counted in bytes of records; what is on its way
and how fast the link is, in bytes of the wire, which the owner of the scheduler tells.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr.candidates import CandidateStore
from gsvis.abr.classes import FieldOfView
from gsvis.abr.estimate import ESTIMATORS, ThroughputEstimator, estimator
from gsvis.abr.holdings import Holdings
from gsvis.abr.planner import Batch, Planner
from gsvis.abr.policies import POLICIES, UtilityConfig, regime_of
from gsvis.abr.predict import PREDICTORS, Pose, PosePredictor, predictor

__all__ = ["Scheduler", "SchedulerConfig"]

F64 = NDArray[np.float64]

_REACH = 0.4  # seconds of data that are ranked at a time: most views last no longer


@dataclass(frozen=True)
class SchedulerConfig:
    """How a scheduler decides.

    Attributes:
        policy: One of `POLICIES`.
        estimator: One of `ESTIMATORS`.
        predictor: One of `PREDICTORS`.
        lead: Seconds ahead for which the pose is predicted; what is in view now or then counts as in view. 0: only now.
        turn: Radians by which the head turns before records are ranked again; not more than the margin of the view.
        move: Share of the side of a cell by which it moves before they are.
        horizon: Seconds within which the highest level of a cell should arrive for the bandwidth to count as high.
        window: Seconds of data that may be under way.
        piece: Seconds that the link should take for one message: nothing in it is shown before all of it is there.
        start_rate: Bytes of the wire a second that are believed before the first acknowledgement.
        utility: Factors of the policy "utility".
    """

    policy: str = "utility"
    estimator: str = "harmonic"
    predictor: str = "kalman"
    lead: float = 0.25
    turn: float = 0.087
    move: float = 0.1
    horizon: float = 3.0
    window: float = 0.3
    piece: float = 0.05
    start_rate: float = 250e3
    utility: UtilityConfig = field(default_factory=UtilityConfig)

    def __post_init__(self) -> None:
        _check.one_of("policy", self.policy, POLICIES)
        _check.one_of("estimator", self.estimator, ESTIMATORS)
        _check.one_of("predictor", self.predictor, PREDICTORS)
        for name in ("lead", "turn", "move"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name}: expected a finite number >= 0, got {getattr(self, name)!r}")
        for name in ("horizon", "window", "piece", "start_rate"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {getattr(self, name)!r}")


class Scheduler:
    """What one client gets next.

    Args:
        store: Candidates of the scene, shared by all clients.
        view: What the client shows; its margin should be a few degrees.
        config: None means `SchedulerConfig()`.
        holdings: What the client holds already, when it comes back; None is nothing.
        throughput: An estimator instead of the one the config names.
        poses: A predictor instead of the one the config names.

    Attributes:
        holdings: What has been sent.
        outstanding: Bytes of the wire sent and not acknowledged.
        wire_bytes: Bytes of the wire sent.
        sent_bytes: Bytes of the records of all batches.
        regime: What the bandwidth allows, of `REGIMES`; None before the first batch.
        cell: The cell of the viewer; -1 before the first pose.
        plans: How often records were ranked for a new view.
    """

    def __init__(
        self,
        store: CandidateStore,
        view: FieldOfView,
        config: SchedulerConfig | None = None,
        *,
        holdings: Holdings | None = None,
        throughput: ThroughputEstimator | None = None,
        poses: PosePredictor | None = None,
    ) -> None:
        self.config = config or SchedulerConfig()
        self.store, self.view = store, view
        self._planner = Planner(store, self.config.policy, holdings=holdings, utility=self.config.utility)
        self._throughput = throughput or estimator(self.config.estimator, self.config.start_rate)
        self._poses = poses or predictor(self.config.predictor)
        self._now: Pose | None = None
        self._time = -np.inf
        self._aimed: tuple[int, Pose, Pose, str] | None = None
        self.outstanding, self.wire_bytes, self.sent_bytes = 0.0, 0.0, 0.0
        self.regime: str | None = None
        self.cell, self.plans = -1, 0

    @property
    def holdings(self) -> Holdings:
        """What has been sent to the client."""
        return self._planner.holdings

    @property
    def rate(self) -> float:
        """Estimated throughput, bytes of the wire a second."""
        return self._throughput.estimate()

    @property
    def record_rate(self) -> float:
        """Estimated throughput, bytes of records a second: the rate less what the wire has added so far."""
        share = self.sent_bytes / self.wire_bytes if self.wire_bytes > 0 else 1.0
        return self.rate * min(share, 1.0) if share > 0 else self.rate

    @property
    def done(self) -> bool:
        """Whether nothing is left to be sent for the view of the last batch."""
        return self._planner.done

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """The client is here at time t; a pose older than the last one is passed over.

        Args:
            t: Seconds.
            position: (3,) scene frame.
            quat: (4,) wxyz, world from camera, any length but 0.

        Raises:
            ValueError: If something is not finite, or no rotation; nothing has changed then.
        """
        pose = Pose.of(position, quat)
        if not np.isfinite(t):
            raise ValueError(f"t: expected finite seconds, got {t!r}")
        if t <= self._time:
            return
        self._poses.observe(t, pose.position, pose.quat)
        self._now, self._time, self.cell = pose, t, self.store.index.cell_of(pose.position)

    def on_sent(self, t: float, size: float) -> None:
        """A message is on its way.

        Args:
            t: Seconds; not looked at, for the record of who calls.
            size: Bytes of the wire.
        """
        self.outstanding += size
        self.wire_bytes += size

    def on_ack(self, t: float, size: float, seconds: float = 0.0) -> None:
        """The client has received so many bytes, for which the link took so long.

        Args:
            t: Seconds; not looked at, for the record of who calls.
            size: Bytes of the wire, as told to `on_sent`.
            seconds: From the first byte's departure, or the end of the transfer before, to the last byte's arrival; 0
                where nobody knows, or `on_transfer` tells: bytes are then acknowledged, and say nothing of the link.
        """
        if seconds > 0:
            self.on_transfer(size, seconds)
        self.outstanding = max(0.0, self.outstanding - size)

    def on_transfer(self, size: float, seconds: float) -> None:
        """The link took so long for so many bytes of the wire, however they were acknowledged."""
        self._throughput.observe(size, seconds)

    def allowance(self) -> float:
        """Bytes of the wire that may be sent now, so that no more than `window` seconds of data are under way."""
        return max(0.0, self.rate * self.config.window - self.outstanding)

    def next_batch(self, t: float, budget: float) -> Batch:
        """The next records for the client, of at most `budget` bytes; nothing before the first pose.

        They count as held from now on: whoever loses them on the way begins again with `holdings` of the client. They
        do not count as being under way: `on_sent` is told when they are, and how large they are then.
        """
        self._aim(t)
        batch = self._planner.take(budget)
        self.sent_bytes += batch.bytes
        return batch

    def _aim(self, t: float) -> None:
        if self._now is None:
            return
        config, now = self.config, self._now
        then = self._poses.predict(max(t, self._time) + config.lead) if config.lead > 0 else now
        candidates = self.store.of(self.cell)
        self.regime = regime_of(self.record_rate, candidates.level_bytes, config.horizon, self.regime)
        if self._aimed is not None:
            cell, was, was_then, regime = self._aimed
            near = self._near(now, was) and self._near(then, was_then)
            if cell == self.cell and regime == self.regime and near:
                return
        poses = (now,) if config.lead <= 0 else (now, then)
        planes = np.stack([self.view.planes(pose.position, pose.quat) for pose in poses])
        self._planner.reach = _REACH * self.record_rate
        self._planner.aim(self.cell, now.position, planes, self.regime)
        self._aimed = self.cell, now, then, self.regime
        self.plans += 1

    def _near(self, a: Pose, b: Pose) -> bool:
        still = a.distance_to(b) <= self.config.move * self.store.index.grid.cell_size
        return still and a.turn_to(b) <= self.config.turn
