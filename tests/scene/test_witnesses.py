"""Cameras that a space was found by do not judge it."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.cameras import Cameras
from gsvis.scene.witnesses import Witnesses, hold_out


@pytest.mark.parametrize("count", [16, 17, 300])
def test_every_other_pose_is_held_out_and_none_is_in_both(count: int) -> None:
    used, kept = hold_out(count)
    assert sorted([*used, *kept]) == list(range(count))
    assert len(kept) == count // 2


def test_few_poses_are_all_needed() -> None:
    used, kept = hold_out(15)
    assert (len(used), len(kept)) == (15, 0)


@pytest.mark.parametrize(("asked", "got"), [(3, 3), (7, 7), (20, 7), (0, 0)])
def test_views_are_some_of_the_poses_in_one_size(asked: int, got: int) -> None:
    cameras = Cameras.orbit([0, 0, 0], 3.0, 7, width=50, height=40)
    views = Witnesses(cameras, "an orbit").views(asked, 32, 24, 70.0)
    assert (len(views), views.width, views.height) == (got, 32, 24)
    apart = np.linalg.norm(views.viewpoints[:, None] - cameras.viewpoints, axis=2).min(axis=1, initial=9.0)
    assert (apart < 1e-9).all()
    assert len(np.unique(views.viewpoints.round(6), axis=0)) == got
