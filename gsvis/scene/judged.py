"""Compare quality at two kinds of eyes: builder's eyes, for which a result was made, and independent judge's eyes.

Figures are the PSNR of images against the scene, dB, at most 100. If quality at judge's eyes is much lower, a warning
names a remedy.
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
"""Median in dB below which there is a warning, if images should equal those of the scene."""

APART = 6.0
"""Difference between the two medians in dB from which there is a warning."""

GOOD = 50.0
"""Median in dB from which differences are invisible and cause no warning."""

_ADVICE = "give --cameras, --up or --box if people stand elsewhere"


@dataclass(frozen=True, eq=False)
class Judged:
    """Quality at builder's and judge's eyes.

    Attributes:
        builder: (B,) dB, at eyes drawn in navigable space.
        judge: (J,) dB, at judge's eyes: first those drawn around the detail, then given ones; (0,) if none is free.
        in_cells: (J,) bool, whether judge's eyes lie in a cell of the navigable space; None without a space. For joined
            parts only its mean is meaningful.
        named: Source of the given eyes, such as cameras of a file; empty without given eyes.
        given: Number of given eyes.
        least: Median in dB from which there is no warning; 0 if images need not equal those of the scene.
    """

    builder: F64
    judge: F64
    in_cells: NDArray[np.bool_] | None
    named: str = ""
    given: int = 0
    least: float = LEAST

    @classmethod
    def joined(cls, records: Sequence[Mapping[str, Any]]) -> Judged:
        """Return the quality in all parts of a scene together.

        Args:
            records: Result of `as_dict` for each part. Given eyes of all parts stay separate from drawn ones.
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
        """Share of the judge's eyes that lie in cells; None without judge's eyes or cells."""
        return float(self.in_cells.mean()) if self.in_cells is not None and len(self.in_cells) else None

    @property
    def warning(self) -> str | None:
        """A warning if quality at judge's eyes is too low; None if it is not."""
        if len(self.judge) == 0 or len(self.builder) == 0:
            return None
        named, theirs = min(self._group_medians(), key=lambda group: group[1])
        mine = float(np.median(self.builder))
        low = min(mine, theirs)
        if low >= self.least and not (abs(mine - theirs) > APART and low < GOOD):
            return None
        return (
            f"Warning: median quality is {theirs:.1f} dB at {named}, and {mine:.1f} dB at the eyes it was made for"
            f"{self._spell_share_in_cells('of the judging eyes lie in cells')}: {_ADVICE}."
        )

    @property
    def line(self) -> str:
        """The figures as a line of text."""
        if len(self.judge) == 0:
            return "not checked: no viewpoint around the detail is free"
        low = np.percentile(self.judge, 5)
        least = self.judge.min()
        also = f", {self.given} of them of {self.named}" if self.given else ""
        return (
            f"{np.median(self.judge):.1f} dB in the median, 5th percentile {low:.1f}, worst {least:.1f},"
            f" in {len(self.judge)} views{also}{self._spell_share_in_cells('of the eyes in cells')}"
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

    def _spell_share_in_cells(self, text: str) -> str:
        """Return the share of eyes in cells as text; empty without it."""
        share = self.share_in_cells
        return "" if share is None else f"; {share:.0%} {text}"

    def _group_medians(self) -> list[tuple[str, float]]:
        """Return name and median of each group of judge's eyes."""
        drawn, given = np.split(self.judge, [len(self.judge) - self.given])
        named = (("eyes around the detail of the scene", drawn), (f"eyes of {self.named}", given))
        return [(name, float(np.median(values))) for name, values in named if len(values)]


def _rounded(values: F64) -> list[float]:
    """Return values rounded for JSON."""
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
