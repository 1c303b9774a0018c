"""`color_scene`: one call for what `gsvis color` does, on a scene small enough to know the answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.color import FitConfig
from gsvis.color.storage import load_srbf
from gsvis.prepare import ColorConfig, ColorOutputs, ColorQualityConfig, color_scene
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

AROUND = NavigableSpace.from_box((3.0, -1.0, -1.0), (5.0, 1.0, 1.0), 4)
QUICK = ColorConfig(FitConfig(max_terms=2, mean_terms=None), ViewSampling(4, 24, 18))
HELD_OUT = ViewSampling(2, 24, 18, stream=1)


def scene(degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(3)
    n = 12
    return Gaussians(
        rng.normal(scale=0.5, size=(n, 3)), [[1, 0, 0, 0]] * n, np.full((n, 3), 0.2), np.full(n, 0.8),
        rng.normal(scale=0.5, size=(n, 1, 3)), rng.normal(scale=0.2, size=(n, (degree + 1) ** 2 - 1, 3)),
    )  # fmt: skip


def stages_of(found: list[str]) -> Any:
    return lambda stage, done, total: found.append(stage) if stage not in found else None


def test_what_is_returned_is_what_is_written(tmp_path: Path) -> None:
    out, stages = tmp_path / "a.srbf.arrow", list[str]()
    outputs = ColorOutputs(epsilon=0.05, held_out=HELD_OUT, quality=ColorQualityConfig((), (), flip=False))
    fitted = color_scene(scene(), AROUND, out, outputs, config=QUICK, progress=stages_of(stages))
    _, written = load_srbf(out)
    assert np.array_equal(written.intensities, fitted.colors.intensities)
    assert np.array_equal(written.base, fitted.colors.base)
    assert fitted.file_bytes == out.stat().st_size
    assert fitted.epsilon == 0.05
    assert fitted.calibration is None
    assert fitted.quality is not None
    assert stages.index("fit") < stages.index("records")
    assert list(tmp_path.iterdir()) == [out]  # kept work is removed


def test_nothing_is_compared_unless_it_is_asked_for(tmp_path: Path) -> None:
    fitted = color_scene(scene(), AROUND, tmp_path / "a.srbf.arrow", config=QUICK)
    assert fitted.quality is None
    assert fitted.epsilon is None
    assert fitted.cell_shares is None


def test_without_terms_epsilon_is_the_fallback(tmp_path: Path) -> None:
    outputs = ColorOutputs(calibrate=True, fallback=0.03, held_out=HELD_OUT)
    fitted = color_scene(scene(0), None, tmp_path / "a.srbf.arrow", outputs, config=QUICK)
    assert fitted.colors.num_terms == 0
    assert fitted.epsilon == 0.03
    assert fitted.calibration is None
    assert fitted.quality is None  # nowhere to look from


def test_of_levels_the_highest_is_drawn(tmp_path: Path) -> None:
    g = scene()
    first, last = np.array([0] * 4 + [1] * 8, np.uint8), np.array([0] * 2 + [1] * 10, np.uint8)
    fitted = color_scene(Levels(g, first, last, ("low", "high")), AROUND, tmp_path / "a.srbf.arrow", config=QUICK)
    assert len(fitted.colors) == 12
    assert fitted.shown is not None
    assert fitted.shown.tolist() == [False] * 2 + [True] * 10
    assert len(fitted.drawn[0]) == len(fitted.drawn[1]) == 10


def test_an_interruption_says_what_is_kept_and_resumes(tmp_path: Path) -> None:
    out = tmp_path / "a.srbf.arrow"

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "fit":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"kept in .*run the same command to resume"):
        color_scene(scene(), AROUND, out, config=QUICK, progress=stop)
    assert not out.exists()
    stages = list[str]()
    again = color_scene(scene(), AROUND, out, config=QUICK, progress=stages_of(stages))
    assert "importance" not in stages
    fresh = color_scene(scene(), AROUND, tmp_path / "b.srbf.arrow", config=QUICK)
    assert np.array_equal(again.colors.intensities, fresh.colors.intensities)


def test_an_interruption_after_the_file_says_that_it_is_written(tmp_path: Path) -> None:
    out = tmp_path / "a.srbf.arrow"

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "colors":
            raise KeyboardInterrupt

    outputs = ColorOutputs(held_out=HELD_OUT, quality=ColorQualityConfig((), (), flip=False))
    with pytest.raises(KeyboardInterrupt, match=r"a\.srbf\.arrow is written"):
        color_scene(scene(), AROUND, out, outputs, config=QUICK, progress=stop)
    assert len(load_srbf(out)[1]) == 12


def test_an_unknown_precision_is_refused_before_work() -> None:
    with pytest.raises(ValueError, match="precision: expected one of"):
        replace(ColorOutputs(), precision="tiny")
