"""Simulate what a viewer sees while a scene arrives: deliveries over links along paths.

    stage = Stage(scene.contents)                                          # one per scene
    link = Link(load_trace("trace.csv"), round_trip=0.04)
    playback = play(Adaptive(scene, config.view), link, path, stage.size)  # when what arrives
    session, = watch(stage, [playback], path, config)                      # PSNR, latency, QoE

The adaptive stream and the baselines share one small interface, `Delivery`. Names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.simulate.baselines import MortonProgressive, WholeFile, morton_order
    from gsvis.simulate.delivery import Adaptive, Delivery, Parcel
    from gsvis.simulate.frames import Frame, Stage
    from gsvis.simulate.link import Link, Pipe
    from gsvis.simulate.playback import Playback, play
    from gsvis.simulate.viewing import Viewing, ViewingConfig, show_at, watch
    from gsvis.simulate.visits import Place, Visit, simulate_visits

__all__ = [
    "Adaptive",
    "Delivery",
    "Frame",
    "Link",
    "MortonProgressive",
    "Parcel",
    "Pipe",
    "Place",
    "Playback",
    "Stage",
    "Viewing",
    "ViewingConfig",
    "Visit",
    "WholeFile",
    "morton_order",
    "play",
    "show_at",
    "simulate_visits",
    "watch",
]

_HOMES = {
    "baselines": ("MortonProgressive", "WholeFile", "morton_order"),
    "delivery": ("Adaptive", "Delivery", "Parcel"),
    "frames": ("Frame", "Stage"),
    "link": ("Link", "Pipe"),
    "playback": ("Playback", "play"),
    "viewing": ("Viewing", "ViewingConfig", "show_at", "watch"),
    "visits": ("Place", "Visit", "simulate_visits"),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
