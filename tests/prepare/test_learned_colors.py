"""How much of a lesson is kept, by the mean and by the worst of views that were held out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gsvis.train.colors
from gsvis.color.records import quantize
from gsvis.color.srbf import SrbfColors
from gsvis.prepare import learned_colors
from gsvis.prepare.learned_colors import ColorMeasure, Learned, Lesson, learn_lesson
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from gsvis.train.colors import LearnConfig
from tests.color.samples import random_colors

ONE = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], np.zeros((1, 1, 3)))
FITTED = SrbfColors(
    "rgb",
    np.zeros((1, 3)),
    np.ones(1),
    np.zeros(2, int),
    np.zeros(0, int),
    np.zeros((0, 2)),
    np.zeros(0),
    np.zeros((0, 3)),
)


def learn(
    monkeypatch: pytest.MonkeyPatch, psnr_of: Callable[[float], list[float]], named: str = "renders"
) -> tuple[float, Learned]:
    """Return the kept change of a base color that learns 1, and what is said; `psnr_of` a change measures it."""

    class Measure:
        """Views whose PSNR follows the base color."""

        def __init__(self, *_: object) -> None:
            pass

        def psnr_of(self, *tried: SrbfColors | None, **_: Any) -> tuple[np.ndarray[Any, Any], ...]:
            return tuple(np.array(psnr_of(0.0 if each is None else float(each.base[0, 0]))) for each in tried)

    learned = replace(FITTED, base=np.ones((1, 3), np.float32))
    monkeypatch.setattr(gsvis.train.colors, "learn_colors", lambda *_, **__: learned)
    monkeypatch.setattr(learned_colors, "ColorMeasure", Measure)
    camera = Cameras.look_at([[0.0, -3.0, 0.0]], [[0.0, 0.0, 0.0]], up=[0, 0, 1], width=8, height=8, fov=60.0)
    lesson = Lesson(camera, camera, named, LearnConfig.for_renders(1))
    colors, about = learn_lesson(ONE, FITTED, lesson, lambda exact: exact)
    return float(colors.base[0, 0]), about


def test_all_is_kept_where_the_worst_view_loses_little(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, about = learn(monkeypatch, lambda x: [50.0 + x, 45.0 - 0.2 * x])
    assert (kept, about.share) == (1.0, 1.0)
    assert about.remark is None


def test_half_is_kept_where_all_costs_the_worst_view_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, about = learn(monkeypatch, lambda x: [50.0 + 4.0 * x, 45.0 - x * x])
    assert (kept, about.share) == (0.5, 0.5)
    assert about.psnr["learned"].tolist() == [52.0, 44.75]
    assert about.as_dict()["share"] == 0.5
    assert about.remark is None


def test_the_fit_stays_where_every_share_costs_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, about = learn(monkeypatch, lambda x: [50.0 + 9.0 * x, 45.0 - 2.0 * x])
    assert (kept, about.share) == (0.0, 0.0)
    assert about.remark == (
        "Learning from renders changed held-out views by +3.50 dB, the worst by -2.00 dB. They keep the fit."
    )


def test_a_lower_mean_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, about = learn(monkeypatch, lambda x: [50.0 - 2.0 * x, 45.0 + x])
    assert (kept, about.share) == (0.0, 0.0)


def test_photographs_are_learned_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, about = learn(monkeypatch, lambda x: [50.0 + 9.0 * x, 45.0 - 2.0 * x], "photographs")
    assert (kept, about.share) == (1.0, 1.0)


def test_colors_in_files_measure_the_same_to_the_bit(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(2), 60)
    colors = random_colors(np.random.default_rng(3), 60, "rgb")
    shown = np.arange(60) % 4 > 0
    cameras = Cameras.orbit((0, 0, 0), 12.0, 3, width=24, height=16)
    other = replace(colors, intensities=0.5 * colors.intensities)
    kept, filed = (
        ColorMeasure(g, shown, cameras, folder).psnr_of(colors, other, to_records=lambda c: quantize(c).dequantize())
        for folder in (None, tmp_path)
    )
    assert np.array_equal(kept, filed)
    assert not np.array_equal(kept[0], kept[1])
