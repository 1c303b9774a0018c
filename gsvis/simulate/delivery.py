"""Define the interface of a delivery to one client, shared by the adaptive stream and the baselines.

A delivery is the server's side for one client. Poses and acknowledgements go in, parcels come out; time, in seconds, is
an argument. A parcel lists the ids that the client can draw from then on, independent of the format of its bytes, so
all systems are rendered and judged in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import ArrayLike, NDArray

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.stream.scene import StreamedScene
from gsvis.stream.session import Session

__all__ = ["Adaptive", "Delivery", "Parcel"]


@dataclass(frozen=True, eq=False)
class Parcel:
    """A unit of delivery; it counts when its last byte has arrived.

    Attributes:
        sequence: Number of the parcel, repeated in the acknowledgement.
        nbytes: Bytes on the wire.
        gaussians: Ids of Gaussians that can be drawn from then on.
        terms: Ids of terms that can be drawn from then on.
        dropped: Ids of Gaussians that are no longer shown.
        filling: Whether it only fills an idle link, because no view needs it yet.
    """

    sequence: int
    nbytes: int
    gaussians: NDArray[Any]
    terms: NDArray[Any]
    dropped: NDArray[Any]
    filling: bool = False


class Delivery(Protocol):
    """Interface of a delivery.

    Attributes:
        name: Name for reports.
        exact: Whether a view shows the original scene once it has all of the highest level; otherwise it shows the
            records.
    """

    name: str
    exact: bool

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Take the pose of the client, in a message that arrives at time t."""
        ...

    def on_ack(self, t: float, sequence: int) -> None:
        """Take the acknowledgement of everything up to this parcel, in a message that arrives at time t."""
        ...

    def next(self, t: float) -> Parcel | None:
        """Return what to send now; None to wait for a pose or an acknowledgement."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return facts for reports, ready for JSON."""
        ...


class Adaptive:
    """The adaptive stream of gsvis: the session of `gsvis.stream`, with the sizes of its messages.

    Args:
        scene: State that all clients share.
        view: Field of view of the client.
        config: Settings of planner and estimator; None means `AbrConfig()`.
        name: Name for reports.

    Attributes:
        session: The session.
    """

    exact = False

    def __init__(
        self,
        scene: StreamedScene,
        view: FieldOfView,
        config: AbrConfig | None = None,
        *,
        name: str = "gsvis",
    ) -> None:
        self.name = name
        self.config = config or AbrConfig()
        self.session = Session(scene, view, self.config)
        self._greeted = False

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Take a pose; see `Delivery`."""
        self.session.on_pose(t, position, quat)

    def on_ack(self, t: float, sequence: int) -> None:
        """Take an acknowledgement; see `Delivery`."""
        self.session.on_ack(t, sequence)

    def next(self, t: float) -> Parcel | None:
        """Return the next parcel; see `Delivery`. The first is WELCOME, which contains nothing to draw."""
        message = self.session.next_message(t) if self._greeted else self.session.welcome(t)
        self._greeted = True
        if message is None:
            return None
        batch = message.batch
        sets = batch.gaussians, batch.terms, batch.dropped
        return Parcel(message.sequence, len(message.data), *sets, filling=batch.filling)

    def describe(self) -> dict[str, Any]:
        """Return facts for reports; see `Delivery`."""
        c = self.config
        return {
            "policy": c.policy,
            "estimator": c.estimator,
            "predictor": c.predictor,
            "lead": c.lead,
            "ahead": c.ahead,
            "window": c.window,
            "piece": c.piece,
            "fill": c.fill,
        }
