"""Poses as JSON: cameras come back from them."""

from __future__ import annotations

import json

import numpy as np

from gsvis.scene.cameras import Cameras
from gsvis.scene.poses import cameras_from_poses, describe_poses


def test_cameras_come_back_from_their_poses() -> None:
    rng = np.random.default_rng(0)
    cameras = Cameras.look_at(rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), width=30, height=20, fov=70.0)
    for decimals, error in ((None, 1e-12), (6, 1e-5)):
        poses = json.loads(json.dumps(describe_poses(cameras, decimals=decimals)))
        again = cameras_from_poses(poses, 30, 20, 70.0)
        np.testing.assert_allclose(again.viewmats, cameras.viewmats, atol=error)
        np.testing.assert_allclose(again.Ks, cameras.Ks)


def test_no_poses_are_no_cameras() -> None:
    assert len(cameras_from_poses([], 4, 3, 60.0)) == 0
    assert describe_poses(None) == []
