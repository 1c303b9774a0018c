"""Turn a scene into messages, and messages into a scene to draw, without sockets or clocks.

    scene = StreamedScene.open("scene.gsvis")                        # one for all clients
    session = Session(scene, FieldOfView.from_degrees(90, 70))           # one for a client
    receiver = Receiver(scene.header)                                # at the client
    session.on_pose(t, position, quat)
    message = session.next_message(t)
    received = receiver.receive(message.data)
    session.on_ack(t, received.sequence)
    gaussians, colors = receiver.scene()

Time, in seconds, is an argument. Scene frame and units. Sizes are bytes of messages, as a WebSocket carries them.
docs/streaming.md describes the messages.
"""

from gsvis.package.rounding import Quality
from gsvis.stream.receiver import Received, Receiver
from gsvis.stream.scene import StreamedScene
from gsvis.stream.session import Message, Session
from gsvis.stream.wire import PROTOCOL, Ack, Bye, Hello, PoseAt, Token, parse_client

__all__ = [
    "PROTOCOL",
    "Ack",
    "Bye",
    "Hello",
    "Message",
    "PoseAt",
    "Quality",
    "Received",
    "Receiver",
    "Session",
    "StreamedScene",
    "Token",
    "parse_client",
]


def __dir__() -> list[str]:
    return sorted(__all__)
