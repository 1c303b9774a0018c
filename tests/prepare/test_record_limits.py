"""The choice of how coarsely records are rounded: as coarse as a wanted PSNR allows, and not at all where none does."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from gsvis.color.records import QuantizedColors
from gsvis.color.srbf import SrbfColors
from gsvis.prepare.record_limits import RecordLimits, cameras_of_choice, choose_limits
from gsvis.scene.cameras import Cameras
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import two_rooms
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.photos import load_photo_cameras
from tests.package.worlds import colors_of, levels_of
from tests.train.photo_files import write_transforms


@cache
def scene() -> tuple[Levels, SrbfColors, QuantizedColors]:
    return levels_of(300, 2), *colors_of(300, seed=2)


def chosen(wanted: float) -> RecordLimits:
    eyes = np.array([[4.0, 0.0, 0.5], [0.0, -4.0, 0.0]])
    cameras = Cameras.look_at(eyes, np.zeros((2, 3)), width=48, height=36)
    return choose_limits(*scene(), (cameras[:1], cameras[1:]), wanted)


def test_less_psnr_gives_coarser_records() -> None:
    fine, coarse = chosen(46.0), chosen(38.0)
    assert fine.limits is not None
    assert coarse.limits is not None
    assert coarse.finer < fine.finer
    assert fine.psnr >= 46.0
    assert coarse.psnr >= 38.0
    assert min(fine.worst + 5.0 - 46.0, coarse.worst + 5.0 - 38.0) >= 0.0


def test_records_keep_all_bits_where_no_rounding_is_fine_enough() -> None:
    assert chosen(90.0).limits is None


def test_a_camera_is_needed() -> None:
    with pytest.raises(ValueError, match="cameras"):
        choose_limits(*scene(), (), 40.0)


def test_views_of_the_choice_are_drawn_by_each_rule_apart_from_those_of_the_cost(tmp_path: Path) -> None:
    rooms = two_rooms(1000, sh_degree=0)
    levels = Levels.single(rooms.gaussians)
    views = ViewSampling(3, 40, 30, stream=3)
    photos = write_transforms(tmp_path, 9)
    found = cameras_of_choice(levels, rooms.navigable, views, photos)
    assert [len(each) for each in found] == [6, 6, 6]
    assert {(each.width, each.height) for each in found} == {(40, 30)}
    cost = views.cameras(levels, rooms.navigable)
    assert not np.isin(found[0].viewpoints[:, 0], cost.viewpoints[:, 0]).any()
    poses = load_photo_cameras(photos)
    assert np.isin(found[2].viewpoints[:, 0], poses.viewpoints[1:8, 0]).all()  # the first and the ninth may judge
    assert len(cameras_of_choice(levels, rooms.navigable, views)) == 2
