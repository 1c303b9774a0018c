"""Classify a scene, so that eyes are placed where people look from: around an object, in rooms, or on the ground.

The result depends on figures that `_evidence.py` measures. This module knows no grid and no Gaussian.
docs/design/033-kinds-of-space.md says how the thresholds were chosen.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

__all__ = ["KINDS", "SURE", "Evidence", "Kind", "SpaceKind", "find_kind", "is_rooms", "with_surroundings"]

Kind = Literal["object", "rooms", "open place", "given"]

KINDS: dict[str, Kind] = {"object": "object", "rooms": "rooms", "open-place": "open place"}
"""Kinds that a user can state, by the word to type."""

SURE = 0.8
"""Least confidence at which a kind is used without a warning."""

ROOFED = 0.5  # least share of directions above that are stopped in rooms
SURROUNDED = 0.4  # least share of level directions that are stopped in an open place
WALKABLE = 0.05  # least footprint with ground that an eye can be above
CLOSED = 0.85  # least share of directions above that are stopped in what can be nothing but rooms
HEMMED = 0.5  # least share of level directions that are stopped in what can be nothing but an open place
TALL = 1.0  # least height, in sides, of a thing that has no room for an eye
TALLER = 2.0  # height in sides from which that is certain, unless more is seen from within
MORE = 0.15  # how much more of such a thing is seen from outside, at least
# confidences
_CLEAR = 0.95
_UNCLEAR = 0.6
FLAT = 0.15  # most height of ground without surroundings, in sides


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Figures that decide the kind of a scene. All but `flatness` are shares, in [0, 1].

    Args:
        seen_within: Share of the Gaussians that some eye in enclosed space sees; 0 without such a space.
        seen_outside: Share of the Gaussians that some eye around the scene sees.
        roofed: Share of directions within 45 degrees of up that end at something, averaged over eyes within.
        surrounded: Share of level directions that end at something, averaged over eyes above the ground, far Gaussians
            included. 0 in rooms, where it is not measured, and without ground.
        walkable: Share of the footprint of the scene with ground below possible eyes; 0 in rooms.
        flatness: Height of the scene over its narrower side.
    """

    seen_within: float
    seen_outside: float
    roofed: float
    surrounded: float
    walkable: float
    flatness: float


@dataclass(frozen=True)
class SpaceKind:
    """The kind of a scene, with reasons.

    Args:
        kind: "object", "rooms", "open place"; or "given" if the user gave the navigable space.
        reason: The reason, in a line.
        evidence: The figures behind it; None for a given space.
        eyes: Where eyes are, in a line.
        confidence: Confidence in the kind, in (0, 1]; 1 if given. Below `SURE`, eyes follow the rules of both kinds.
        other: The second likely kind; None if there is none.
        doubt: A line that says what the user should check; empty if nothing is doubtful.
    """

    kind: Kind
    reason: str
    evidence: Evidence | None = None
    eyes: str = ""
    confidence: float = 1.0
    other: Kind | None = None
    doubt: str = ""

    @property
    def sure(self) -> bool:
        """Whether the confidence is high enough to use the kind without a warning."""
        return self.confidence >= SURE

    def as_dict(self) -> dict[str, Any]:
        """Return the kind as plain numbers and strings, ready for JSON; `text` describes it in a line."""
        return {**asdict(self), "text": str(self)}

    def __str__(self) -> str:
        also = f" (or {self.other})" if self.other else ""
        return f"{self.kind}: {self.reason}{also}" + (f"; eyes {self.eyes}" if self.eyes else "")


def is_rooms(found: Evidence) -> bool:
    """Return whether a scene is rooms: something is overhead, and more is seen from within than from outside."""
    return found.roofed >= ROOFED and found.seen_within > 0.0 and found.seen_within >= found.seen_outside


def find_kind(found: Evidence) -> SpaceKind:
    """Return the kind of a scene by the evidence, with a confidence and the second likely kind.

    Rooms have something overhead, and more of them is seen from within than from outside. An open place has
    surroundings at eye height, or is only ground. Anything else is an object: nothing surrounds the eye, and little is
    seen from inside.

    Args:
        found: The evidence.
    """
    within = f"{found.seen_within:.0%}"
    outside = f"{found.seen_outside:.0%}"
    level = f"{found.surrounded:.0%} of level views"
    if is_rooms(found):
        reason = f"{within} of the Gaussians are seen from within, {outside} from outside"
        reason = f"{reason}, and {found.roofed:.0%} of views up end at a roof"
        return _weigh("rooms", reason, found, found.roofed >= CLOSED, "object")
    if found.walkable > 0.0 and found.surrounded >= SURROUNDED:
        clear = found.surrounded >= HEMMED and found.walkable >= WALKABLE
        clear = clear and found.seen_within >= found.seen_outside - MORE
        reason = f"{level} from the ground end at something, under an open sky"
        return _weigh("open place", reason, found, clear, "object")
    if found.walkable >= WALKABLE and found.flatness <= FLAT:
        reason = f"ground {1.0 / found.flatness:.0f} times as wide as what stands on it is high"
        return _weigh("open place", reason, found, False, "object")  # a plate lying flat looks the same
    reason = f"{outside} of the Gaussians are seen from outside, {within} from within"
    if found.walkable > 0.0:
        reason += f", and {1.0 - found.surrounded:.0%} of level views from its ground meet nothing"
    more = 0.0 if found.flatness >= TALLER else MORE
    clear = found.flatness >= TALL and found.seen_outside >= found.seen_within + more
    return _weigh("object", reason, found, clear, "open place")


def with_surroundings(found: Evidence, beyond: float) -> SpaceKind:
    """Return the kind of a scene whose Gaussians get larger away from its detail.

    Args:
        found: The evidence.
        beyond: Share of the Gaussians that lie around the detail.
    """
    reason = f"{beyond:.0%} of the Gaussians lie around its detail, larger the farther they are"
    return _weigh("open place", reason, found, False, "object")


def _weigh(kind: Kind, reason: str, found: Evidence, clear: bool, other: Kind) -> SpaceKind:
    """Return a kind: certain if the figures are clear, else with the second likely kind."""
    return SpaceKind(kind, reason, found, "", _CLEAR if clear else _UNCLEAR, None if clear else other)
