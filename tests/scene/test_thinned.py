"""A thinned scene holds fewer Gaussians that cover about as much, and follows the scene."""

from __future__ import annotations

import numpy as np

from gsvis.scene.thinned import thin
from tests.scene.tilted_platform import TILT, tilted_platform


def test_fewer_gaussians_cover_about_as_much_and_giants_stay() -> None:
    g = tilted_platform()
    ids, few = thin(g, 1000)
    assert 900 < len(few) < 1100
    assert np.array_equal(few.means, g.means[ids])
    near = np.linalg.norm(g.means, axis=1) < 20.0
    area = float((g.scales[near, 0].astype(np.float64) ** 2).sum())
    covered = float((few.scales[near[ids], 0].astype(np.float64) ** 2).sum())
    assert 0.7 < covered / area < 1.3
    giants = g.scales.max(axis=1) > 100.0
    assert set(np.flatnonzero(giants)) <= set(ids)


def test_a_small_scene_stays_and_a_moved_one_keeps_the_same() -> None:
    g = tilted_platform(400)
    ids, few = thin(g, len(g))
    assert len(ids) == len(few) == len(g)
    moved = g.transform(scale=100.0, rotation=TILT, translation=np.array([5.0, 0.0, -3.0]))
    assert np.array_equal(thin(g, 200)[0], thin(moved, 200)[0])
