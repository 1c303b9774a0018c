"""The figures of the paper: which there are, and that each is a picture with a caption that says what is not alike."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np
import pytest
from paper import figures, study
from PIL import Image

from gsvis.raycast import DirectionCdf


def size_of(data: bytes) -> tuple[int, int]:
    with Image.open(io.BytesIO(data)) as image:
        assert image.format == "PNG"
        return image.size


def test_every_figure_with_a_measurement_is_there() -> None:
    panels = {15: (8, 15), 9: (9, 10, 11, 12, 14)}
    drawn = {number for key in figures.FIGURES for number in panels.get(key, (key,))}
    assert drawn == set(range(3, 19)) - {6, 7}


def test_the_figure_of_directions_states_the_papers_points() -> None:
    sets = np.zeros((4, 10), np.uint8)
    sets[2:] = 255
    cdf = DirectionCdf.from_sets(sets)
    image, caption = figures.draw_directions(SimpleNamespace(directions=cdf, traced=cdf, directions_views=7))
    assert min(size_of(image)) > 300
    assert "50.0% below 41.25%" in caption
    assert "39.4% and 80.4%" in caption
    assert "7 views" in caption


def test_the_figure_of_a_walk_draws_both_curves() -> None:
    times = np.arange(3.0)
    walk_terms = SimpleNamespace(
        times=times, gaussians=times / 2.0, terms=times / 4.0, epsilon=0.02,
    )  # fmt: skip
    image, caption = figures.draw_walk(SimpleNamespace(walk_terms=walk_terms))
    assert min(size_of(image)) > 300
    assert "100.0% of the Gaussians and 50.0% of the SRBFs (0.0% at the start)" in caption


def test_likeness_of_equal_images_is_perfect() -> None:
    images = np.random.default_rng(0).random((2, 24, 32, 3)).astype(np.float32)
    same = study.likeness(images, images)
    assert (same.psnr, same.ssim) == (100.0, pytest.approx(1.0))
    assert same.flip in (None, pytest.approx(0.0, abs=1e-6))
    assert same.lpips is None
    other = study.likeness(images, np.clip(images + 0.1, 0.0, 1.0), lambda one, two: float(abs(one - two).max()))
    assert other.psnr < 30.0
    assert other.lpips == pytest.approx(0.1)


def test_options_of_prepare_are_few_and_have_no_views_with_photographs() -> None:
    assert figures.words_of(["steps=5"], None) == ["--steps", "5"]
    photographs = SimpleNamespace(words=["--photos", "there"])
    words = figures.words_of(None, photographs)
    assert "--views" in figures.words_of(None, None)
    assert "--views" not in words
    assert words[-2:] == ["--photos", "there"]


def test_pictures_stand_side_by_side() -> None:
    image = np.zeros((30, 40, 3), np.float32)
    one, two = (size_of(figures.montage([[image] * count], ["a"] * count)) for count in (1, 2))
    assert two[0] == 2 * one[0]
    assert two[1] == one[1]
