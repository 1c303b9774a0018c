"""The simulation that a report is about, and the content of its `report.json`."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from gsvis.simulate.frames import CONTENT_DB
from gsvis.simulate.link import Link
from gsvis.simulate.visits import Visit

__all__ = ["Simulation", "session_document", "titled"]


@dataclass(frozen=True, eq=False)
class Simulation:
    """Consecutive visits over one link.

    Attributes:
        visits: The visits, in order.
        link: The link at the start of the first visit.
        command: The exact command that makes this report again.
        version: Version of gsvis.
        parameters: All parameters by name.
        seconds: Duration of each stage, by name.
        walk: What the path is: a recording only if its file says so.
        bandwidth: What the link is: a recording only if its file says so.
    """

    visits: tuple[Visit, ...]
    link: Link
    command: str
    version: str
    parameters: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    walk: str = "a path"
    bandwidth: str = "a link"

    @property
    def title(self) -> str:
        """Names of the scenes, and which of them are compared with their own package alone."""
        return ", then ".join(dict.fromkeys(titled(visit.title, visit.against) for visit in self.visits))


def titled(name: str, against: str) -> str:
    """Return the name of a scene for a title, with what it is compared with if that is not the scene.

    Args:
        name: Name of the scene.
        against: As `Visit.against`.
    """
    return f"{name} against {against}" if against else name


def session_document(simulation: Simulation) -> dict[str, Any]:
    """Return the content of `report.json`.

    Args:
        simulation: The simulation.
    """
    link = simulation.link
    config = simulation.visits[0].sessions[0].config
    end = config.seconds * len(simulation.visits)
    return {
        "format": "gsvis-simulation",
        "version": 1,
        "title": f"Streaming {simulation.title}",
        "gsvis": simulation.version,
        "command": simulation.command,
        "parameters": simulation.parameters,
        "config": asdict(config),
        "link": {
            "trace": link.trace.name,
            "kind": simulation.bandwidth,
            "round_trip": link.round_trip,
            "mean_mbit_per_s": link.trace.bytes_between(0.0, end) * 8e-6 / end,
        },
        "walk": simulation.walk,
        "visits": [
            {
                "title": titled(visit.title, visit.against),
                "scene": {"name": visit.title, **visit.scene},
                "path": visit.path,
                "compared_with": visit.compared_with,
                "against_itself": bool(visit.against),
                "against": visit.against,
                "remark": visit.remark,
                "views": {
                    "compared": len(visit.sessions[0].content),
                    "with_content": int(visit.sessions[0].content.sum()),
                    "content": f"black is worse than {CONTENT_DB:g} dB against the full scene; figures are of these",
                },
                "systems": [session.as_dict() for session in visit.sessions],
            }
            for visit in simulation.visits
        ],
    }
