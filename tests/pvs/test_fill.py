"""The overdraw of cells: sampled against exact, and what a package states of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.pvs.fill import describe_overdraw, fill_of_cells, read_overdraw, sample_fill_of_cells
from gsvis.render.fill import SampledFill
from tests.stream.worlds import package_of


def test_sampled_cells_have_about_the_fill_of_cells(tmp_path: Path) -> None:
    with package_of(tmp_path / "room.gsvis", 2000) as package:
        levels = package.contents.levels()
        store = package.visibility
        exact = fill_of_cells(levels, store, np.arange(len(store)))
        found = sample_fill_of_cells(levels, store)
    np.testing.assert_allclose(found.mean, exact.mean, rtol=0.02)
    np.testing.assert_allclose(found.splats, exact.splats, rtol=0.05)
    assert (found.worst <= exact.worst + 1).all()
    stated = read_overdraw(describe_overdraw(found), len(store))
    assert stated is not None
    np.testing.assert_allclose(stated.mean, found.mean, atol=0.05)
    np.testing.assert_array_equal(stated.worst, found.worst)


@pytest.mark.parametrize(
    "record",
    [
        None,
        [],
        {},
        {"splats": [1], "mean": [1.0], "worst": [1, 2]},
        {"splats": [1], "mean": [-1.0], "worst": [1]},
        {"splats": [1], "mean": [float("nan")], "worst": [1]},
        {"splats": ["1"], "mean": [1.0], "worst": [True]},
    ],
)
def test_what_no_package_writes_is_not_read(record: Any) -> None:
    assert read_overdraw(record, 1) is None


def test_figures_are_rounded() -> None:
    found = SampledFill(np.array([3.0]), np.array([1.26]), np.array([2.0]))
    assert describe_overdraw(found) == {"side": 512, "step": 4, "splats": [3], "mean": [1.3], "worst": [2]}
