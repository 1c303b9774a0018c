"""Maps from above: rows of Gaussians that lie wider apart than cells of the map leave no white stripes."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.report.maps import Ground, _raster

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("turned", [False, True])
def test_rows_wider_apart_than_cells_leave_no_stripe(turned: bool) -> None:
    x, y = np.meshgrid(np.linspace(0.0, 1.0, 240), np.linspace(0.0, 1.0, 51))
    places = np.stack([x.ravel(), y.ravel()], axis=1)[:, :: -1 if turned else 1]
    ground = Ground(np.eye(3)[0], np.eye(3)[1], places, np.array([[-0.04, -0.04], [1.04, 1.04]]))
    _, count, seen = _raster(ground, np.ones(len(places), bool))
    inner = count[6:-6, 6:-6]
    assert inner.min() > 0.0
    assert np.array_equal(count, seen)


def test_what_is_empty_stays_empty() -> None:
    places = np.concatenate([np.random.default_rng(0).random((9000, 2)) * (0.3, 1.0), [[0.99, 0.5]]])
    ground = Ground(np.eye(3)[0], np.eye(3)[1], places, np.array([[0.0, 0.0], [1.0, 1.0]]))
    _, count, _ = _raster(ground, np.zeros(len(places), bool))
    assert count[:, 24:54].max() == 0.0
