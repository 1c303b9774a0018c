"""Point clouds refuse what is no point, and slice like arrays."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.points import PointCloud


def test_points_are_checked_and_cannot_be_written_to() -> None:
    for means, colors, message in (
        ([[0, 0]], None, "means: expected shape"),
        ([[0, 0, np.nan]], None, "means: expected finite"),
        ([[0, 0, 0]], [[0, 0, 2]], "colors: expected values in"),
        ([[0, 0, 0]], np.zeros((2, 3)), "expected one length for all"),
    ):
        with pytest.raises(ValueError, match=message):
            PointCloud(means, colors)
    cloud = PointCloud(np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="read-only"):
        cloud.means[0] = 1.0


def test_slices_keep_colors_with_their_points() -> None:
    cloud = PointCloud(np.eye(3), np.eye(3))
    assert repr(cloud[[2, 0]]) == "PointCloud(2)"
    assert (cloud[[2, 0]].means == cloud[[2, 0]].colors).all()
    assert len(cloud[1]) == 1
    assert len(PointCloud(np.zeros((0, 3)))) == 0
