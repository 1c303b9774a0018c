"""Read and write facts about a scene in the comments of a PLY: whether it is antialiased, and its up axis.

Programs agree on two lines: `SplatRenderMode: mip` for antialiased scenes (Brush, splat-transform, gsplat), in
Postshot `antialiased 1`; and `Vertical Axis: z` (nerfstudio), in Brush also as three numbers. The last line of a kind
counts. gsvis adds its own line, `gsvis facts {...}`, for facts that other programs do not state; it takes precedence.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsvis.io.facts import parse_facts, spell_facts
from gsvis.scene.facts import SceneFacts

__all__ = ["comments_of", "facts_of"]

_OWN = "gsvis facts "
_MODE = re.compile(r"splatrendermode\s*[:=]?\s*(\w+)", re.IGNORECASE)
_FLAG = re.compile(r"anti-?aliased\s*[:=]?\s*(0|1|true|false|yes|no)", re.IGNORECASE)
_TRAINED = re.compile(r"train_flags\b.*\banti-?aliasing\b", re.IGNORECASE)
_UP = re.compile(
    r"(?P<name>vertical[\s_-]*axis|up[\s_-]*(?:axis|vector|direction)?|axis[\s_-]*up)(?:\s*[:=]\s*|\s+)(?P<value>\S.*?)"
    r"|(?P<letter>[+-]?[xyz])[\s_-]*(?:is[\s_-]*)?up",
    re.IGNORECASE,
)
_AXIS = re.compile(r"(?P<sign>[+-]|neg(?:ative)?[\s_-]?|pos(?:itive)?[\s_-]?|minus[\s_-]?|plus[\s_-]?)?(?P<axis>[xyz])")
_BRUSH = "exported from brush"


def facts_of(comments: Sequence[str]) -> SceneFacts:
    """Return the facts that the comments state; other facts keep their defaults.

    Args:
        comments: The text of each comment, in file order.
    """
    lines = [line.strip() for line in comments]
    own = [line.removeprefix(_OWN) for line in lines if line.startswith(_OWN)]
    facts = parse_facts(own[-1]) if own else SceneFacts()
    from_brush = any(line.lower() == _BRUSH for line in lines)
    for line in lines:
        found = _antialiased(line)
        facts = facts if found is None or own else replace(facts, antialiased=found)
        if facts.up is not None and own:
            continue
        up = _up_of(line, from_brush)
        if up is not None:
            facts = replace(facts, up=up, up_source=f"comment {line[:80]}")
    return facts


def comments_of(facts: SceneFacts) -> list[str]:
    """Return the comments that state the facts; none if all facts have their defaults."""
    lines = []
    if facts.antialiased:
        lines.append("SplatRenderMode: mip")
    if facts.up is not None:
        lines.append("Vertical axis: " + " ".join(f"{value:.9g}" for value in facts.up))
    own = spell_facts(facts)
    return [*lines, _OWN + own] if own else lines


def _antialiased(line: str) -> bool | None:
    """Return whether a comment states that the scene is antialiased; None if it does not say."""
    mode = _MODE.fullmatch(line)
    if mode:
        return mode[1].lower() in ("mip", "antialiased")
    flag = _FLAG.fullmatch(line)
    if flag:
        return flag[1].lower() in ("1", "true", "yes")
    return True if _TRAINED.fullmatch(line) else None


def _up_of(line: str, from_brush: bool) -> tuple[float, float, float] | None:
    """Return the up axis that a comment states; None if it states none.

    Brush writes `Vertical axis: y` if it does not know the axis, so that line of Brush states nothing.
    """
    found = _UP.fullmatch(line)
    if not found:
        return None
    value = (found["letter"] or found["value"]).strip().strip("\"'()[]").lower()
    axis = _AXIS.fullmatch(value.removesuffix("-up").removesuffix("up").strip())
    if axis:
        if from_brush and value == "y":
            return None
        sign = -1.0 if (axis["sign"] or "+")[0] in "-nm" else 1.0
        x, y, z = (sign * (np.arange(3) == "xyz".index(axis["axis"])) + 0.0).tolist()
        return x, y, z
    try:
        numbers = np.array([float(word) for word in re.split(r"[\s,;]+", value)])
    except ValueError:
        return None
    length = float(np.linalg.norm(numbers)) if numbers.shape == (3,) else 0.0
    if not 1e-6 < length < 1e6:
        return None
    x, y, z = (float(number) + 0.0 for number in numbers / length)
    return x, y, z
