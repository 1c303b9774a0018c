"""Colors of rounded records: what is learned makes up for rounding, the rest of the records stays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from gsvis.color.evaluate import Evaluator
from gsvis.color.records import QuantizedColors
from gsvis.package import Contents
from gsvis.package.rounding import Limits, Quality, limits_of, rounded_contents
from gsvis.prepare.record_limits import choose_limits
from gsvis.prepare.rounded_colors import RecordLesson, cameras_by_rules
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import two_rooms
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.colors import LearnConfig
from gsvis.train.images import PosedImages
from gsvis.train.photos import load_photo_cameras
from tests.package.worlds import colors_of, levels_of
from tests.train.photo_files import write_transforms

COUNT = 300


def eyes(count: int, seed: int) -> Cameras:
    """Cameras around the origin, where the Gaussians are."""
    away = np.random.default_rng(seed).normal(size=(count, 3))
    places = 5.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    return Cameras.look_at(places, np.zeros((count, 3)), width=48, height=36)


@cache
def lesson(variant: str = "rgb") -> RecordLesson:
    levels = levels_of(COUNT, 2)
    exact, packed = colors_of(COUNT, variant, 2)
    member = levels.member(len(levels) - 1)
    g = levels.union[member]
    shown = Evaluator(exact[member])
    cameras = eyes(24, 1)
    images = [
        rasterize(g, cameras[c], colors=shown.colors(g.means, cameras[c].viewpoints[0])).images[0] for c in range(24)
    ]
    config = replace(LearnConfig.for_records(120), base_rate=1e-3, intensity_rate=1e-3)
    return RecordLesson(levels, exact, packed, PosedImages(cameras, np.stack(images).astype(np.float32)), config)


def limits(of: RecordLesson) -> Limits:
    return limits_of(Contents.from_levels(of.levels, of.packed), Quality())


def error(of: RecordLesson, colors: QuantizedColors) -> float:
    """PSNR of rounded records with colors, in the images of the lesson."""
    contents = rounded_contents(of.levels, colors, limits(of))
    member = of.levels.member(len(of.levels) - 1)
    g = contents.gaussians()[member]
    shown = Evaluator(contents.colors().dequantize()[member])
    views = of.views
    found = []
    for c in range(len(views)):
        camera = views.cameras[c]
        image = rasterize(g, camera, colors=shown.colors(g.means, camera.viewpoints[0])).images[0]
        found.append(float(psnr(np.clip(image, 0, 1), np.clip(views.image(c), 0, 1))))
    return float(np.mean(found))


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
def test_learned_colors_make_up_for_rounding(variant: str) -> None:
    of = lesson(variant)
    assert error(of, of.learn(limits(of))) > error(of, of.packed) + 0.2


def test_geometry_stays_and_nearly_all_lobes() -> None:
    of = lesson()
    before = rounded_contents(of.levels, of.packed, limits(of))
    after = rounded_contents(of.levels, of.learn(limits(of)), limits(of))
    for name in ("means", "quats", "scales", "opacities"):
        assert np.array_equal(getattr(after.gaussians(), name), getattr(before.gaussians(), name)), name
    for name in ("offsets", "functions"):
        assert np.array_equal(getattr(after.colors(), name), getattr(before.colors(), name)), name
    for name in ("centers", "decays"):  # a term whose intensity fell much lacks another bit
        assert (getattr(after.colors(), name) == getattr(before.colors(), name)).mean() > 0.9, name
    assert not np.array_equal(after.colors().base, before.colors().base)
    hidden = ~of.levels.member(len(of.levels) - 1)
    assert hidden.any()
    assert np.array_equal(after.colors().base[hidden], before.colors().base[hidden])


def test_the_same_lesson_gives_the_same_colors() -> None:
    of = lesson()
    first, second = of.learn(limits(of)), of.learn(limits(of))
    assert np.array_equal(first.base, second.base)
    assert np.array_equal(first.intensities, second.intensities)


def test_records_are_coarser_where_colors_are_learned() -> None:
    of = lesson()
    rules = eyes(4, 5), eyes(4, 6)
    plain = choose_limits(of.levels, of.exact, of.packed, rules, 38.0)
    learned = choose_limits(of.levels, of.exact, of.packed, rules, 38.0, lesson=of)
    assert plain.colors is None
    assert learned.colors is not None
    assert learned.finer < plain.finer
    assert learned.psnr >= 38.0
    assert learned.worst >= 33.0


def test_images_are_drawn_by_each_rule(tmp_path: Path) -> None:
    rooms = two_rooms(1000, sh_degree=0)
    levels = Levels.single(rooms.gaussians)
    views = ViewSampling(3, 40, 30, stream=3)
    photos = write_transforms(tmp_path, 9)
    found = cameras_by_rules(levels, rooms.navigable, views, photos)
    assert [len(each) for each in found] == [3, 3, 3]
    poses = load_photo_cameras(photos)
    assert np.isin(found[2].viewpoints[:, 0], poses.viewpoints[1:8, 0]).all()  # the first and the ninth may judge
    assert len(cameras_by_rules(levels, rooms.navigable, views)) == 2
