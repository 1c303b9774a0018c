"""A server of packages and a client over real sockets: the session of the simulator behind WebSockets.

    with open_scenes(["scene.gsvis"]) as scenes, Server(scenes).running() as url:
        client = fetch(url, FieldOfView.from_degrees(90, 70), path.at, seconds=5.0)
    gaussians, colors = client.receiver.scene()

docs/serving.md explains how to operate it.
"""

from gsvis.serve.app import AppConfig, build_app
from gsvis.serve.client import ClientConfig, StreamClient, fetch
from gsvis.serve.clock import Clock, ManualClock
from gsvis.serve.limits import Limits
from gsvis.serve.log_lines import JsonLines, TextLines
from gsvis.serve.metrics import Metrics
from gsvis.serve.scenes import Scenes, ServedScene, open_scenes
from gsvis.serve.server import Address, Server

__all__ = [
    "Address",
    "AppConfig",
    "ClientConfig",
    "Clock",
    "JsonLines",
    "Limits",
    "ManualClock",
    "Metrics",
    "Scenes",
    "ServedScene",
    "Server",
    "StreamClient",
    "TextLines",
    "build_app",
    "fetch",
    "open_scenes",
]


def __dir__() -> list[str]:
    return sorted(__all__)
