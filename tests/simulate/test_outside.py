"""A viewer outside of all cells: the image rises to that of the whole scene, and earlier than from the nearest set."""

from __future__ import annotations

from collections.abc import Iterator
from unittest.mock import patch

import numpy as np
import pytest

from gsvis.abr import AbrConfig
from gsvis.abr.outside import distance_step
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations
from gsvis.simulate import Stage
from gsvis.simulate.frames import Frame
from gsvis.stream import Session, StreamedScene
from tests.simulate.streets import QUICK, street


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[StreamedScene, Stage]]:
    made, stage = street(tmp_path_factory.mktemp("outside"), 1200)
    with made.source:
        yield made, stage


def looking(scene: StreamedScene, away: float) -> Cameras:
    """Cameras so many sides of a cell outside of the cells, on six sides of them."""
    grid = scene.index.grid
    low, high = grid.centers.min(axis=0), grid.centers.max(axis=0)
    middle = 0.5 * (low + high)
    steps = np.concatenate([np.eye(3), -np.eye(3)]) * (0.5 * (high - low) + (0.5 + away) * grid.cell_size)
    return Cameras.look_at(middle + steps, middle, width=48, height=36)


def curve(scene: StreamedScene, frame: Frame, camera: Cameras) -> tuple[list[int], list[float]]:
    """Bytes and PSNR after each message to a viewer who stands still, until nothing is left."""
    session = Session(scene, QUICK.view, AbrConfig(start_rate=2e4))
    session.welcome(0.0)
    session.on_ack(0.0, 0)
    session.on_pose(0.01, camera.viewpoints[0], quats_from_rotations(camera.viewmats[0, :3, :3].T[None])[0])
    shown, terms = np.zeros(len(scene), bool), np.zeros(len(scene.contents.term_records), bool)
    sizes, psnrs = [], []
    while (message := session.next_message(0.02, 1500.0)) is not None:
        session.on_ack(0.02, message.sequence)
        shown[message.batch.gaussians], terms[message.batch.terms] = True, True
        shown[message.batch.gone] = False
        sizes.append(session.wire_bytes)
        psnrs.append(min(frame.psnr(shown[frame.ids], terms), 60.0))
    assert np.array_equal(shown, scene.contents.last == len(scene.contents.names) - 1)
    return sizes, psnrs


@pytest.mark.parametrize("away", [0.4, 3.0, 20.0])
def test_outside_the_image_rises_to_that_of_the_whole_scene_and_earlier(scene, away: float) -> None:
    streamed, stage = scene
    gains = []
    cameras = looking(streamed, away)
    for camera in (cameras[k : k + 1] for k in range(len(cameras))):
        frame, means = Frame(stage, camera), []
        for rule in (distance_step, lambda *_: 0):
            with patch("gsvis.abr.planner.distance_step", rule):
                sizes, psnrs = curve(streamed, frame, camera)
            assert psnrs[-1] == 60.0
            means.append(np.average(psnrs, weights=np.diff(sizes, prepend=0)))
        gains.append(means[0] - means[1])
    assert min(gains) > 0.0  # dB, mean over the bytes
