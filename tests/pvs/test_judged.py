"""A wrong guess of eyes is noticed: judge's eyes do not come from the space that made the sets."""

from __future__ import annotations

import numpy as np

from gsvis.pvs import PvsConfig, build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.judged import judge_sets
from gsvis.scene.levels import as_levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from tests.scene.test_judging import platform

VIEWS = ViewSampling(8, 64, 48)


def judge(low, high, tmp_path):
    g = platform(count=4000)  # dense: most of it hides what lies below
    space = NavigableSpace.from_box(low, high, 8)
    grid = CellGrid.over(space, max_cells=4)
    config = PvsConfig(size=128, lower_size=128, rays=256, max_inner=1)
    with build_pvs(g, grid, space, tmp_path / "sets", config) as store:
        return judge_sets(as_levels(g), space, store, VIEWS)


def test_eyes_a_hundred_units_away_are_noticed(tmp_path) -> None:
    found = judge([100, 100, 100], [110, 110, 110], tmp_path)
    assert found.share_in_cells == 0.0
    assert found.warning is not None
    assert "--cameras" in found.warning
    record = found.as_dict()
    assert record["views"] == 16
    assert record["builder"]["views"] == record["judge"]["views"] == 8
    assert record["judge"]["worst"] <= record["judge"]["p5"] <= record["judge"]["median"]


def test_the_right_eyes_raise_no_warning(tmp_path) -> None:
    found = judge([-12, -12, -8], [12, 12, 10], tmp_path)
    assert found.warning is None
    assert found.share_in_cells > 0.5
    assert np.median(found.judge) > 35.0
