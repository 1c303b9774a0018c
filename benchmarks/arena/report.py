"""Tables of the arena, and paired differences of gsvis minus each other system with Student's 95% intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsvis.abr.qoe import paired_difference

__all__ = ["compare", "figures_of", "find_weak", "sizes_table", "streams_table", "summarize"]

COMPARED = ("qoe_20", "qoe_25", "psnr")
FIRSTS = ("first_20", "first_25")

WEAK_DB = 1.0
"""Loss of PSNR against plain 3DGS, dB, beyond which a copy is weak."""


def summarize(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the means of each system and class over its links.

    Args:
        rows: Sessions: `system`, `mbit`, `link`, and the figures of `Session.figures`.
    """
    keys = dict.fromkeys((row["mbit"], row["system"]) for row in rows)
    out = []
    for mbit, system in keys:
        mine = [row for row in rows if (row["mbit"], row["system"]) == (mbit, system)]
        found: dict[str, Any] = {"mbit": mbit, "system": system, "sessions": len(mine)}
        for name in (*COMPARED, "megabytes"):
            found[name] = float(np.mean([row[name] for row in mine]))
        for name in FIRSTS:
            times = [np.inf if row[name] is None else row[name] for row in mine]
            median = float(np.median(times))
            found[name] = median if np.isfinite(median) else None
        found["curve"] = np.mean([row["curve"] for row in mine], axis=0).round(3).tolist()
        out.append(found)
    return out


def compare(rows: Sequence[dict[str, Any]], ours: str) -> list[dict[str, Any]]:
    """Return the paired differences of ours minus each other system, by class.

    Raises:
        ValueError: If two systems did not play over the same links.
    """
    keys = dict.fromkeys((row["mbit"], row["system"]) for row in rows if row["system"] != ours)
    out = []
    for mbit, system in keys:
        pairs = [
            {row["link"]: row for row in rows if (row["mbit"], row["system"]) == (mbit, name)}
            for name in (ours, system)
        ]
        if list(pairs[0]) != list(pairs[1]):
            raise ValueError(f"rows: expected {system} over the links of {ours} at {mbit:g} Mbit/s, got others")
        found: dict[str, Any] = {"mbit": mbit, "system": system}
        for name in COMPARED:
            mine, theirs = ([row[name] for row in each.values()] for each in pairs)
            found[name] = paired_difference(mine, theirs).as_dict() if len(mine) > 1 else None
            found[f"{name}_ahead"] = sum(a > b for a, b in zip(mine, theirs, strict=True))
        out.append(found)
    return out


def find_weak(systems: Sequence[dict[str, Any]], plain: str) -> list[str]:
    """Return the names of copies whose PSNR with all of them falls far below that of plain 3DGS of the same run.

    No author reports such a loss, so a win over them says little.

    Args:
        systems: Trained systems.
        plain: Name of plain 3DGS; without it no copy is weak.
    """
    least = [each["psnr"] - WEAK_DB for each in systems if each["name"] == plain]
    return [each["name"] for each in systems if least and each["psnr"] < least[0]]


def sizes_table(systems: Sequence[dict[str, Any]]) -> str:
    """Return the trained systems as a table in Markdown: size and PSNR beside their authors' figures."""
    head = ("system", "Gaussians", "MB", "held-out PSNR, dB", "processor, s", "authors report for bonsai")
    lines = [_row(head), _row(["---"] * len(head))]
    for each in systems:
        lines.append(
            _row(
                [
                    each["name"],
                    f"{each['count']:,}",
                    f"{each['bytes'] / 1e6:.2f}",
                    f"{each['psnr']:.2f}",
                    f"{each['seconds']:.0f}",
                    each["published"] or "-",
                ]
            )
        )
    return "\n".join(lines)


def streams_table(
    means: Sequence[dict[str, Any]], differences: Sequence[dict[str, Any]], weak: Sequence[str] = ()
) -> str:
    """Return the sessions as a table in Markdown, by class; weak copies are marked."""
    head = ["Mbit/s", "system", "QoE (20 dB)", "QoE (25 dB)", "PSNR, dB", "20 dB, s", "25 dB, s"]
    head += ["gsvis minus it, QoE (20 dB)", "ahead on", "gsvis minus it, QoE (25 dB)", "gsvis minus it, dB"]
    lines = [_row(head), _row(["---"] * len(head))]
    for each in means:
        apart = [d for d in differences if (d["mbit"], d["system"]) == (each["mbit"], each["system"])]
        name = each["system"] + _mark(each, weak)
        cells = [f"{each['mbit']:g}", name, f"{each['qoe_20']:.3f}", f"{each['qoe_25']:.3f}"]
        cells += [f"{each['psnr']:.2f}", *(_seconds(each[name]) for name in FIRSTS)]
        intervals = [_interval(apart[0][name]) if apart else "" for name in COMPARED]
        ahead = f"{apart[0]['qoe_20_ahead']} of {each['sessions']}" if apart else ""
        cells += [intervals[0], ahead, *intervals[1:]]
        lines.append(_row(cells))
    return "\n".join(lines)


def figures_of(
    differences: Sequence[dict[str, Any]], weak: Sequence[str] = (), own: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Return the figures of the result: lower ends of the intervals, which should be above 0.

    Args:
        differences: Of ours and each other system.
        weak: Names of weak copies.
        own: Names of systems that are ours too: nothing is wanted of them.
    """
    return [
        {
            "name": f"{each['mbit']:g} Mbit/s: QoE ({least} dB) above {each['system']}{_mark(each, weak)}, lower end",
            "target": None if each["system"] in own else 0.0,
            "reached": each[f"qoe_{least}"]["low"],
            "unit": "",
            "better": "higher",
        }
        for least in (20, 25)
        for each in differences
        if each[f"qoe_{least}"] is not None
    ]


def _mark(each: dict[str, Any], weak: Sequence[str]) -> str:
    return " (weak copy)" if each["system"] in weak else ""


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f}"


def _interval(difference: dict[str, Any] | None) -> str:
    if difference is None:
        return ""
    return f"{difference['mean']:+.3f} ({difference['low']:.3f} to {difference['high']:.3f})"
