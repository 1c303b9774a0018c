"""Tables 1 to 3: what stands in them comes from the run, and they say what it was measured against."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from paper.study import Likeness
from paper.tables import figures_of, tables

DB = {"hsl": 31.0, "ours": 41.0, "hsl-l": 29.0, "yuv": 28.0, "hsv": 27.0}


def study(**other: Any) -> SimpleNamespace:
    """Return a study of ten Gaussians: nine in the highest level, four in the one below, three in both."""
    low, high = np.arange(10) < 4, np.arange(10) > 0
    return SimpleNamespace(
        level=lambda k: (None, high if k == -1 else low),
        walk_terms=SimpleNamespace(gaussians=np.array([0.25, 0.5]), terms=np.array([0.125, 0.5])),
        variant_likeness=lambda name: Likeness(DB[name], 0.9, None, other.get("lpips")),
        **{"by_photographs": False, **other},
    )


def test_tables_come_from_the_run() -> None:
    text = tables(study())
    assert "| gsvis, in this run | yes: 25.0% of all | yes: 12.5% of all SRBFs | yes: 66.7% |" in text
    assert "75.0% of what it has stay" in text
    assert (
        "| HSL by OMP, the paper's | 0.9000 | 31.00 dB | - | - |  |  | -0.21 dB, mean of seven scenes | +0.0015 |"
        in text
    )
    assert "| hsv | 0.9000 | 27.00 dB | - | - |  |  | -1.15 dB | +0.0091 |" in text
    assert "LPIPS was not measured" in text
    assert "the scene's own images" in text


def test_photographs_show_what_colors_lose() -> None:
    text = tables(study(by_photographs=True, scene_likeness=Likeness(31.5, 0.95, 0.1, 0.2), lpips=0.25))
    assert "| SH, the scene itself | 0.9500 | 31.50 dB | 0.2000 | 0.1000 |  |  |  |  |" in text
    assert "| hsv | 0.9000 | 27.00 dB | 0.2500 | - | -4.50 dB | +0.0500 | -1.15 dB | +0.0091 |" in text
    assert "LPIPS was not measured" not in text
    assert "no training saw" in text


def test_the_result_says_what_is_lost_of_photographs_or_how_near_harmonics_are() -> None:
    near = {figure["name"]: figure["reached"] for figure in figures_of(study())}
    assert near["hsl: PSNR against SH"] == 31.0
    by_photographs = study(by_photographs=True, scene_likeness=Likeness(31.5, 0.95, None))
    lost = {figure["name"]: figure["reached"] for figure in figures_of(by_photographs)}
    assert lost["hsl: PSNR less than SH"] == 0.5
