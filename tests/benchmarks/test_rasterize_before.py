"""The kept rasterizer, a ruler of benchmarks, draws what the rasterizer of today draws."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.procedural import random_scene

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from _rasterize_before import rasterize_before


@pytest.mark.parametrize(("kind", "degree"), [("blob", 3), ("coincident", 0)])
def test_the_kept_rasterizer_draws_what_the_rasterizer_draws(kind: str, degree: int) -> None:
    g = random_scene(np.random.default_rng(7), 3000, degree, kind)
    inside = Cameras.cubemap([[0.1, -0.2, 0.3]], 41)
    outside = Cameras.orbit((0.0, 0.0, 0.0), 9.0, 2, width=70, height=37)
    for cameras in (inside, outside):
        images = rasterize_before(g, cameras)
        assert images.shape == (len(cameras), cameras.height, cameras.width, 3)
        assert images.max() > 0.5
        np.testing.assert_allclose(images, rasterize(g, cameras, backend="cpu").images, rtol=0.0, atol=1e-5)


def test_nothing_in_view_is_black() -> None:
    g = random_scene(np.random.default_rng(7), 20)
    away = Cameras.look_at([[500.0, 0.0, 0.0]], [[900.0, 0.0, 0.0]], width=20, height=18)
    assert not rasterize_before(g, away).any()
