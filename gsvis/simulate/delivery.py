"""How a scene reaches a client: one small interface, behind which stand the adaptive stream and the baselines.

A delivery is the server's side for one client. Poses and acknowledgements go in, parcels come out; time, in seconds, is
an argument. Whatever bytes a parcel has, it names what the client can draw from then on by ids of the package, so that
all systems are drawn, and judged, alike.
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
    """What goes to the client at once; it counts when its last byte has arrived.

    Attributes:
        sequence: Its number, which the acknowledgement gives back.
        nbytes: Bytes on the wire.
        gaussians: Ids of Gaussians that can be drawn from then on.
        terms: Ids of terms.
        dropped: Ids of Gaussians that are shown no more.
    """

    sequence: int
    nbytes: int
    gaussians: NDArray[Any]
    terms: NDArray[Any]
    dropped: NDArray[Any]


class Delivery(Protocol):
    """What a system has to be able to do.

    Attributes:
        name: What reports call it.
        exact: Whether what it shows is the full scene itself once all of it is there; if not, it is the records.
    """

    name: str
    exact: bool

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """The client is here, says a message that arrives at time t."""
        ...

    def on_ack(self, t: float, sequence: int) -> None:
        """The client has received everything up to this parcel, says a message that arrives at time t."""
        ...

    def next(self, t: float) -> Parcel | None:
        """What to send now; None to wait for a pose or an acknowledgement."""
        ...

    def describe(self) -> dict[str, Any]:
        """Facts for reports, ready for JSON."""
        ...


class Adaptive:
    """What gsvis serves: the session of `gsvis.stream`, with the bytes of its messages.

    Args:
        scene: What all clients share.
        view: What the client shows.
        config: How the scheduler decides; None means `AbrConfig()`.
        name: What reports call it.

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
        self.name, self.config = name, config or AbrConfig()
        self.session = Session(scene, view, self.config)
        self._greeted = False

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """See `Delivery`."""
        self.session.on_pose(t, position, quat)

    def on_ack(self, t: float, sequence: int) -> None:
        """See `Delivery`."""
        self.session.on_ack(t, sequence)

    def next(self, t: float) -> Parcel | None:
        """See `Delivery`; the first parcel is WELCOME, which nothing can be drawn from."""
        message = self.session.next_message(t) if self._greeted else self.session.welcome(t)
        self._greeted = True
        if message is None:
            return None
        batch = message.batch
        return Parcel(message.sequence, len(message.data), batch.gaussians, batch.terms, batch.dropped)

    def describe(self) -> dict[str, Any]:
        """See `Delivery`."""
        c = self.config
        return {"policy": c.policy, "estimator": c.estimator, "predictor": c.predictor, "lead": c.lead,
                "window": c.window, "piece": c.piece}  # fmt: skip
