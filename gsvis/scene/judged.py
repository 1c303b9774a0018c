"""Compare what eyes of two rules see: builder's eyes, for which a result was made, and judge's eyes, which know not.

Figures are PSNR of images against the scene, dB, at most 100. A warning names what to do where judge's eyes see much
less than builder's eyes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["APART", "GOOD", "LEAST", "Judged"]

F64 = NDArray[np.float64]

LEAST = 35.0
"""dB below which a median is warned about, where images are to equal those of the scene."""

APART = 6.0
"""dB between the medians of the two rules from which there is a warning."""

GOOD = 50.0
"""dB of both medians from which a difference between them does not matter: nobody sees it."""

_ADVICE = "give --cameras, --up or --box if people stand elsewhere"


@dataclass(frozen=True, eq=False)
class Judged:
    """What eyes of two rules see.

    Attributes:
        builder: (B,) dB, at eyes drawn in navigable space.
        judge: (J,) dB, at judge's eyes: those drawn around the detail, then those given; (0,) where none is free.
        in_cells: (J,) bool, the judge's eyes that lie in a cell of the navigable space; None without a space. Of joined
            parts only the share is right.
        named: What gave the last of the judge's eyes, such as cameras of a file; empty if nothing did.
        given: Number of these.
        least: Median from which nothing is warned about, dB; 0 where images need not equal those of the scene.
    """

    builder: F64
    judge: F64
    in_cells: NDArray[np.bool_] | None
    named: str = ""
    given: int = 0
    least: float = LEAST

    @classmethod
    def joined(cls, records: Sequence[Mapping[str, Any]]) -> Judged:
        """Return what eyes see in all parts of a scene together.

        Args:
            records: What `as_dict` returned for each part. Given eyes of all parts stay apart from drawn ones.
        """
        builder = [value for record in records for value in record["psnr"]["builder"]]
        drawn = list[float]()
        given = list[float]()
        inside: list[NDArray[np.bool_]] = [np.zeros(0, bool)]
        names: dict[str, None] = {}
        for record in records:
            values = record["psnr"]["judge"]
            last = record["given"]["views"] if record["given"] else 0
            drawn += values[: len(values) - last]
            given += values[len(values) - last :]
            inside.append(np.arange(len(values)) < round((record["judge_eyes_in_cells"] or 0.0) * len(values)))
            if last:
                names[record["given"]["from"]] = None
        known = any(record["judge_eyes_in_cells"] is not None for record in records)
        return cls(
            np.array(builder, np.float64),
            np.array(drawn + given, np.float64),
            np.concatenate(inside) if known or not records else None,
            ", ".join(names),
            len(given),
        )

    @property
    def share_in_cells(self) -> float | None:
        """Share of the judge's eyes that lie in cells; None without such eyes or without cells."""
        return float(self.in_cells.mean()) if self.in_cells is not None and len(self.in_cells) else None

    @property
    def warning(self) -> str | None:
        """A sentence where the result is worse for judge's eyes than it should be; None where it is not."""
        if len(self.judge) == 0 or len(self.builder) == 0:
            return None
        named, theirs = min(self._groups(), key=lambda group: group[1])
        mine = float(np.median(self.builder))
        low = min(mine, theirs)
        if low >= self.least and not (abs(mine - theirs) > APART and low < GOOD):
            return None
        return (
            f"Warning: {named} see {theirs:.1f} dB in the median, eyes that it was made for {mine:.1f} dB"
            f"{self._where('of the judging eyes lie in cells')}: {_ADVICE}."
        )

    @property
    def line(self) -> str:
        """The figures as a line of text."""
        if len(self.judge) == 0:
            return "no eye around the detail is free: not checked by other eyes"
        low = np.percentile(self.judge, 5)
        least = self.judge.min()
        also = f", {self.given} of them of {self.named}" if self.given else ""
        return (
            f"{np.median(self.judge):.1f} dB in the median, 5th percentile {low:.1f}, worst {least:.1f},"
            f" in {len(self.judge)} views{also}{self._where('of the eyes in cells')}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, ready for JSON."""
        given = self.judge[len(self.judge) - self.given :]
        return {
            "views": len(self.builder) + len(self.judge),
            "builder": _spread(self.builder),
            "judge": _spread(self.judge),
            "given": {"from": self.named, **_spread(given)} if self.given else None,
            "all": _spread(np.concatenate([self.builder, self.judge])),
            "judge_eyes_in_cells": self.share_in_cells,
            "warning": self.warning,
            "line": self.line,
            "psnr": {"builder": _rounded(self.builder), "judge": _rounded(self.judge)},
        }

    def _where(self, text: str) -> str:
        share = self.share_in_cells
        return "" if share is None else f"; {share:.0%} {text}"

    def _groups(self) -> list[tuple[str, float]]:
        """Return name and median of each group of judge's eyes."""
        drawn, given = np.split(self.judge, [len(self.judge) - self.given])
        named = (("eyes around the detail of the scene", drawn), (f"eyes of {self.named}", given))
        return [(name, float(np.median(values))) for name, values in named if len(values)]


def _rounded(values: F64) -> list[float]:
    return [round(float(value), 2) for value in values]


def _spread(values: F64) -> dict[str, Any]:
    """Return number, mean, median, 5th percentile and worst; None where there are no values."""
    if len(values) == 0:
        return {"views": 0, "mean": None, "median": None, "p5": None, "worst": None}
    return {
        "views": len(values),
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p5": float(np.percentile(values, 5)),
        "worst": float(values.min()),
    }
