"""Colors of which one number varies: exact where the scene varies so, and better with more terms."""

from __future__ import annotations

import numpy as np
import pytest
from paper.held import HELD, HeldColors, fit_held

from gsvis.color import hsl_to_rgb, sh_colors
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene

N = 60
EYES = np.random.default_rng(5).normal(scale=9.0, size=(12, 3))


def scene(*, gray: bool, spread: float = 0.05) -> Gaussians:
    g = random_scene(np.random.default_rng(0), N, 2)
    rng = np.random.default_rng(1)
    changes = rng.normal(scale=spread, size=(N, 8, 1 if gray else 3)) * np.ones(3)
    levels = rng.uniform(-0.4, 0.4, (N, 1, 1 if gray else 3)) * np.ones(3)
    return Gaussians(g.means, g.quats, g.scales, g.opacities, levels, changes)


def error(g: Gaussians, colors: HeldColors) -> float:
    return float(np.mean([np.square(colors.colors(g.means, eye) - sh_colors(g, eye)).mean() for eye in EYES]))


def fitted(g: Gaussians, name: str, terms: int) -> HeldColors:
    return fit_held(g, np.ones((N, 80)), name, float(terms), terms, np.ones(N))


@pytest.mark.parametrize("name", HELD)
def test_what_is_black_on_all_sides_stays_black(name: str) -> None:
    g = scene(gray=True)
    base = g.sh0.copy()
    base[0] = -5.0
    changes = g.shN.copy()
    changes[0] = 0.0
    dark = Gaussians(g.means, g.quats, g.scales, g.opacities, base, changes)
    shown = fitted(dark, name, 2).colors(g.means, EYES[0])
    assert np.isfinite(shown).all()
    assert shown[0].max() < 1e-6


@pytest.mark.parametrize("name", HELD)
def test_gray_that_changes_with_direction_is_found(name: str) -> None:
    g = scene(gray=True)
    none, few, many = (fitted(g, name, terms) for terms in (0, 4, 16))
    assert none.counts.tolist() == [0] * N
    assert error(g, many) < 0.05 * error(g, none)
    assert error(g, many) < error(g, few) < error(g, none)


@pytest.mark.parametrize("name", HELD)
def test_a_constant_color_is_exact_without_terms(name: str) -> None:
    g = scene(gray=False, spread=0.0)
    assert error(g, fitted(g, name, 0)) < 1e-10


def test_held_hue_costs_what_other_hues_show() -> None:
    g = scene(gray=False)
    for name in HELD:
        assert error(g, fitted(g, name, 16)) > 0.2 * error(g, fitted(g, name, 0))


def test_terms_go_where_they_count_and_keep_to_their_mean() -> None:
    g = scene(gray=True)
    importance = np.where(np.arange(N) < N // 2, 1.0, 1e-6)
    colors = fit_held(g, np.ones((N, 80)), "yuv", 2.0, 8, importance)
    assert colors.counts.mean() <= 2.0
    assert colors.counts[: N // 2].mean() > 3.0


@pytest.mark.parametrize("name", HELD)
def test_one_lobe_is_what_its_formula_says(name: str) -> None:
    held = {"hsl-l": [[0.75, 0.5, 0.25]], "hsv": [[1.0, 0.5, 0.25]], "yuv": [[0.1, -0.05, 0.02]]}[name]
    colors = HeldColors(
        name, np.array(held), np.array([0.4]), np.array([2.0]), np.array([1]), np.array([[0.0, 0.0, 1.0]]),
        np.array([5.0]), np.array([0.2]),
    )  # fmt: skip
    number = 0.4 + 0.2 * np.exp(5.0 * (np.cos(np.radians(45.0)) - 1.0))
    hsl = hsl_to_rgb(np.array([1.0 / 12.0, 0.5, number]))
    want = {"hsl-l": hsl, "hsv": number * np.array(held[0]), "yuv": number + np.array(held[0])}[name]
    np.testing.assert_allclose(colors.colors([[1.0, 0.0, 1.0]], [0.0, 0.0, 0.0])[0], 2.0 * want, atol=1e-6)
