"""A real scene with floaters out to 2e4 units keeps its looks in 16 bytes a Gaussian."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.color.records import quantize
from gsvis.color.srbf import SrbfColors
from gsvis.io import load_scene
from gsvis.package import Contents, in_package_order, measure_cost
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.sh import SH_C0


@pytest.mark.realdata
@pytest.mark.slow
def test_rounding_costs_less_than_45_db_show(realdata: Path) -> None:
    g = load_scene(realdata / "scenes" / "nika_sh3" / "lod-meta.json", lod=2)
    space = NavigableSpace.from_scene(g, up="-y", resolution=96)
    cameras = space.sample_cameras(3, np.random.default_rng(3), width=240, height=180)
    levels = in_package_order(Levels.single(g))
    exact = SrbfColors.without_terms(np.maximum(0.5 + SH_C0 * levels.union.sh0[:, 0], 0.0))
    colors = quantize(exact, "wire")
    assert measure_cost(levels, exact, colors, cameras).psnr >= 45.0
    contents = Contents.from_levels(levels, colors)
    assert contents.records.shape[1] == 16
    assert len(contents.table) < len(g) / 128  # floaters cut chunks, but not many
