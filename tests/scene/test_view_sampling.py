"""Cameras at random where eyes may be: in rooms as many as asked stand, elsewhere all are anywhere."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import random_scene
from gsvis.scene.view_sampling import ViewSampling

G = random_scene(np.random.default_rng(0), 20)
UP = np.array([0.0, 0.0, 1.0])


def space(kind: str = "rooms", lowest: int = 0) -> NavigableSpace:
    """A hall 20 x 20 x 10 with a floor at 0, far from the Gaussians."""
    occupied = np.zeros((40, 40, 22), bool)
    occupied[:, :, 0] = occupied[:, :, -1] = True
    free = ~occupied
    free[:, :, :lowest] = False
    return NavigableSpace(np.array([90.0, 90.0, -0.5]), 0.5, free, UP, occupied, kind=SpaceKind(kind, "a test"))


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_in_rooms_a_share_of_the_eyes_stands(share: float) -> None:
    heights = ViewSampling(200, 16, 12, standing=share).cameras(G, space()).viewpoints[:, 2]
    stands = (heights >= 2.0) & (heights <= 3.5)  # 0.4 to 0.65 of 0.3 of its width, in whole voxels
    expected = 200 * (share + (1.0 - share) * 1.5 / 10.0)
    assert abs(stands.sum() - expected) < 20
    assert stands[:50].any()
    assert share == 1.0 or not stands[:50].all()  # in no order


def test_elsewhere_and_without_a_share_eyes_are_anywhere() -> None:
    plain = ViewSampling(50, 16, 12).cameras(G, space())
    for other in (
        ViewSampling(50, 16, 12, standing=0.5).cameras(G, space("open place")),
        ViewSampling(50, 16, 12, standing=0.0).cameras(G, space()),
    ):
        np.testing.assert_array_equal(other.viewmats, plain.viewmats)
    assert space(lowest=8).where_people_stand() is None


def test_shares_that_make_no_sense_are_refused() -> None:
    for share in (-0.1, 1.1, np.nan):
        with pytest.raises(ValueError, match=r"^standing: expected a share in \[0, 1\], got"):
            ViewSampling(standing=share)
