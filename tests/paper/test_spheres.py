"""Spheres of figure 15: the right points are drawn, and a figure is a PNG of all its parts."""

from __future__ import annotations

import io

import numpy as np
import pytest
from numpy.typing import NDArray
from paper.sphere import SphereConfig, SphereFit, fit_function
from paper.spheres import SIDES, sphere_figure
from PIL import Image

from gsvis.report.color_spheres import sphere_directions
from gsvis.report.theme import DARK, LIGHT
from gsvis.scene.icosphere import face_directions

X = face_directions(4).reshape(-1, 3)
F64 = NDArray[np.float64]


def hill(x: F64) -> F64:
    return np.exp(6.0 * (x[:, 0] - 1.0))


@pytest.fixture(scope="module")
def fit() -> SphereFit:
    return fit_function(hill(X), X, max_terms=3, config=SphereConfig(sweeps=0, steps=10))


def test_the_points_drawn_are_on_the_sphere_and_on_the_side_of_the_eye() -> None:
    cover, points = sphere_directions(pixels=65)
    assert np.linalg.norm(points, axis=-1) == pytest.approx(np.ones((65, 65)))
    height = np.arcsin(points[32, 32, 2])
    assert points[32, 32] == pytest.approx([np.cos(height), 0.0, np.sin(height)])
    assert (points @ points[32, 32] > -1e-9).all()
    assert np.array_equal(cover[32, 1:-1], np.ones(63))
    assert cover[0, 0] == 0.0
    assert points[5, 32, 2] > points[60, 32, 2]  # up is up
    assert points[32, 60, 1] > 0.0 > points[32, 5, 1]  # from +x, +y lies on the right


@pytest.mark.parametrize("side", SIDES)
def test_a_side_is_the_first_one_turned_about_z(side: float) -> None:
    angle = np.radians(side)
    turned = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    first, other = sphere_directions(pixels=16)[1], sphere_directions(side, pixels=16)[1]
    assert other @ turned.T == pytest.approx(first)


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_a_figure_is_a_png_on_the_color_of_the_page(fit: SphereFit, theme: object) -> None:
    png = sphere_figure(hill, fit, counts=(1, 3), title="hill", theme=theme)  # type: ignore[arg-type]
    with Image.open(io.BytesIO(png)) as image:
        assert image.width > 700
        assert "#{:02x}{:02x}{:02x}".format(*image.convert("RGB").getpixel((2, 2))) == theme.paper  # type: ignore


def test_a_function_that_is_fitted_exactly_or_constant_can_be_drawn() -> None:
    flat = fit_function(np.ones(len(X)), X, max_terms=1)
    assert sphere_figure(lambda x: np.ones(len(x)), flat, counts=(1,)).startswith(b"\x89PNG")


def test_terms_and_errors_have_to_fit(fit: SphereFit) -> None:
    with pytest.raises(ValueError, match=r"^counts: expected 0 to 3"):
        sphere_figure(hill, fit)
    with pytest.raises(ValueError, match=r"^errors: expected 2"):
        sphere_figure(hill, fit, counts=(1, 2), errors=[0.1])
    with pytest.raises(ValueError, match=r"^function: "):
        sphere_figure(lambda x: x, fit, counts=(1,))
