"""Images of many cameras: drawn side by side or one by one, they are the same, in the order of the cameras."""

from __future__ import annotations

from collections.abc import Iterator

import numba
import numpy as np
import pytest

from gsvis.scene.cameras import Cameras
from gsvis.train.images import display_image, display_images, render_views
from tests.raycast.scenes import scene


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = numba.get_num_threads()
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    yield
    numba.set_num_threads(before)


def test_images_side_by_side_are_those_drawn_one_by_one(two_threads: None) -> None:
    g = scene("mixed", n=400)
    cameras = Cameras.orbit([0, 0, 0], 3.0, 7, width=40, height=30)
    wanted = [display_image(g, cameras[c]) for c in range(len(cameras))]
    reported: list[int] = []
    views = render_views(g, cameras, progress=lambda stage, done, total: reported.append(done))
    assert reported == list(range(len(cameras) + 1))
    found = list(display_images(g, [cameras[c] for c in range(len(cameras))]))
    for c, image in enumerate(wanted):
        np.testing.assert_array_equal(found[c], image)
        np.testing.assert_array_equal(np.clip(views.image(c), 0.0, 1.0), image)
    assert numba.get_num_threads() == min(2, numba.config.NUMBA_NUM_THREADS)
