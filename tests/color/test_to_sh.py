"""SRBF colors as spherical harmonics: what is represented exactly, how well, and nothing that explodes."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.color.evaluate import evaluate_along
from gsvis.color.sh import sh_colors_along
from gsvis.color.srbf import SrbfColors
from gsvis.color.to_sh import to_sh
from gsvis.color.variants import VARIANTS
from gsvis.scene.icosphere import face_directions
from tests.color.samples import random_colors

SPHERE = face_directions(16).reshape(-1, 3)


def lobes(decay: float, count: int = 50, height: float = 0.2) -> SrbfColors:
    rng = np.random.default_rng(0)
    coordinates = np.stack([np.arccos(rng.uniform(-1, 1, count)), rng.uniform(-np.pi, np.pi, count)], axis=1)
    return SrbfColors(
        "rgb", np.full((count, 3), 0.5), np.ones(count), np.arange(count + 1),
        np.zeros(count, np.uint8), coordinates, np.full(count, decay), height * rng.uniform(-1, 1, (count, 3)),
    )  # fmt: skip


@pytest.mark.parametrize(("decay", "most"), [(0.1, 1e-5), (0.5, 1e-4), (1.0, 1e-3), (3.0, 1e-2)])
def test_wide_lobes_are_represented(decay: float, most: float) -> None:
    """A lobe of height 0.2 loses a degree-4 remainder: about decay^4 exp(-decay) / 945 of it."""
    colors = lobes(decay)
    sh0, sh_n, losses = to_sh(colors)
    assert sh0.shape == (50, 1, 3)
    assert sh_n.shape == (50, 15, 3)
    assert losses.max() < most
    errors = sh_colors_along(sh0, sh_n, SPHERE) - evaluate_along(colors, SPHERE)
    assert np.abs(errors).max() < 10 * most


@pytest.mark.parametrize("name", VARIANTS)
def test_the_loss_is_the_error(name: str) -> None:
    colors = random_colors(np.random.default_rng(1), 60, name)
    points = face_directions(1).reshape(-1, 3)
    weights = np.random.default_rng(2).random((60, 80))
    for given in (None, weights[0], weights):
        fitted = to_sh(colors, directions=points, weights=given)
        found = sh_colors_along(fitted.sh0, fitted.shN, points)
        squares = ((found - evaluate_along(colors, points)) ** 2).mean(axis=2)
        shares = np.broadcast_to(1.0 if given is None else given, squares.shape)
        want = np.sqrt((squares * shares).sum(axis=1) / shares.sum(axis=1))
        np.testing.assert_allclose(fitted.losses, want, atol=1e-5)


@pytest.mark.parametrize("name", VARIANTS)
def test_no_terms_are_exact(name: str) -> None:
    colors = random_colors(np.random.default_rng(3), 40, name).first(0)
    weights = np.zeros((40, 320))
    weights[:, :3] = 1.0
    for given in (None, weights):
        fitted = to_sh(colors, weights=given)
        assert (fitted.shN == 0).all()
        assert fitted.losses.max() < 1e-6
        np.testing.assert_allclose(
            sh_colors_along(fitted.sh0, fitted.shN, [[0, 0, 1]]), evaluate_along(colors, [[0, 0, 1]]), atol=1e-6
        )


def test_higher_degrees_lose_less() -> None:
    colors = lobes(4.0)
    losses = [to_sh(colors, sh_degree=degree).losses for degree in range(4)]
    for more, fewer in zip(losses[1:], losses[:-1], strict=True):
        assert (more <= fewer + 1e-6).all()
    assert losses[3].mean() < 0.2 * losses[0].mean()


def test_weights_lower_the_error_where_they_are() -> None:
    colors = lobes(8.0)
    inside = np.zeros(320)
    inside[:80] = 1.0
    everywhere, chosen = to_sh(colors, directions=SPHERE[::4]), to_sh(colors, weights=inside)
    points = face_directions(4).reshape(-1, 3)[:80]
    want = evaluate_along(colors, points)

    def error(fitted: object) -> float:
        return float(np.square(sh_colors_along(fitted.sh0, fitted.shN, points) - want).mean())  # type: ignore[attr-defined]

    assert error(chosen) < 0.5 * error(everywhere)
    shared = to_sh(colors, weights=np.tile(inside, (50, 1)))
    np.testing.assert_allclose(shared.sh0, chosen.sh0, atol=1e-3)
    np.testing.assert_allclose(shared.losses, chosen.losses, atol=1e-6)


@pytest.mark.parametrize("seen", [0, 1, 4, 40])
def test_masked_fits_do_not_explode(seen: int) -> None:
    """From a few directions alone, or none: outside them the color stays in the region of what was seen."""
    colors = lobes(20.0, height=0.5)
    weights = np.zeros((50, 320))
    weights[:, :seen] = 1.0
    fitted = to_sh(colors, weights=weights)
    assert all(np.isfinite(part).all() for part in fitted)
    assert sh_colors_along(fitted.sh0, fitted.shN, SPHERE, clipped=False).max() < 1.5
    assert sh_colors_along(fitted.sh0, fitted.shN, SPHERE, clipped=False).min() > -0.5
    if seen == 0:  # never seen: as if seen from everywhere
        np.testing.assert_allclose(fitted.losses, to_sh(colors).losses, atol=1e-5)


def test_slices_and_progress() -> None:
    colors = random_colors(np.random.default_rng(5), 9000, "rgb", 2)
    calls: list[tuple[str, int, int]] = []
    fitted = to_sh(colors, progress=lambda *call: calls.append(call))
    assert calls[0] == ("harmonics", 0, 9000)
    assert calls[-1] == ("harmonics", 9000, 9000)
    assert len(calls) > 2
    tail = to_sh(colors[8990:])
    np.testing.assert_allclose(fitted.shN[8990:], tail.shN, atol=1e-6)


def test_nothing_and_bad_arguments() -> None:
    empty = to_sh(random_colors(np.random.default_rng(6), 0))
    assert empty.sh0.shape == (0, 1, 3)
    assert len(empty.losses) == 0
    colors = random_colors(np.random.default_rng(7), 3)
    with pytest.raises(ValueError, match="degree: expected 0, 1, 2 or 3"):
        to_sh(colors, sh_degree=4)
    with pytest.raises(ValueError, match=r"weights: expected shape \(3, 320\), got \(3, 80\)"):
        to_sh(colors, weights=np.ones((3, 80)))
    with pytest.raises(ValueError, match="weights: expected values in"):
        to_sh(colors, weights=-np.ones(320))
    with pytest.raises(ValueError, match="directions: expected at least one"):
        to_sh(colors, directions=np.zeros((0, 3)))
    with pytest.raises(ValueError, match="ridge: expected a finite number > 0"):
        to_sh(colors, ridge=0.0)
