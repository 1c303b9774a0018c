"""Views to begin with in a scene that nobody has prepared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsvis.cli import starts
from gsvis.cli.source import Source, load_source
from gsvis.cli.starts import find_starts, thin
from gsvis.scene.gaussians import Gaussians, rotations_from_quats

UP = np.array([0.0, 0.0, 1.0])


def test_a_visit_of_rooms_begins_within_them_upright(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(starts, "_PART", 20_000)  # half of its Gaussians
    source = load_source("builtin:two_rooms", None)
    found = find_starts(source, UP)
    assert found is not None
    assert source.navigable is not None
    for start in found:
        assert start.mode == "fly"
        assert source.navigable.contains([start.position]).all()
        across = rotations_from_quats(np.array([start.rotation]))[0][:, 0]
        assert abs(across @ UP) < 1e-3


def test_a_visit_of_a_thing_begins_outside_of_it() -> None:
    rng = np.random.default_rng(0)
    out = rng.standard_normal((3000, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    quats = np.tile([1.0, 0, 0, 0], (3000, 1))
    ball = Gaussians(out, quats, np.full((3000, 3), 0.05), np.full(3000, 0.95), np.zeros((3000, 1, 3)))
    found = find_starts(Source("ball", ball), UP)
    assert found is not None
    for start in found:
        assert start.mode == "orbit"
        away = np.linalg.norm(start.position)
        assert away > 1.0
        ahead = rotations_from_quats(np.array([start.rotation]))[0][:, 2]
        assert ahead @ -np.array(start.position) > 0.0


def test_a_scene_without_room_for_an_eye_has_no_such_view() -> None:
    source = load_source("builtin:two_rooms", None)
    assert find_starts(replace(source, gaussians=source.gaussians[:0], navigable=None), UP) is None


def test_a_part_of_a_scene_covers_as_much(monkeypatch: pytest.MonkeyPatch) -> None:
    source = load_source("builtin:two_rooms", None)
    monkeypatch.setattr(starts, "_PART", 10_000)
    some = thin(source)
    assert len(some.gaussians) == 10_000
    scales = [each.gaussians.scales for each in (source, some)]
    area = [float(np.sort(each, axis=1)[:, 1:].prod(axis=1).sum()) for each in scales]
    assert area[1] == pytest.approx(area[0], rel=0.05)
