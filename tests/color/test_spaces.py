"""Color spaces: known colors, colorsys, round trips, and tensors that say the same with gradients that are finite."""

from __future__ import annotations

import colorsys
import itertools
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gsvis.color import spaces

BOTH = (spaces.rgb_to_hsl, spaces.hsl_to_rgb)

# Ties, ends and what lies next to them are as likely as all the rest.
channel = st.one_of(
    st.sampled_from([0.0, 1.0, 0.5, 5e-324, 1e-310, 1e-40, 1e-8, 0.5 + 2**-53, 1 - 2**-53]), st.floats(0.0, 1.0)
)
colors = arrays(np.float64, (4, 3), elements=channel)
CORNERS = np.array(list(itertools.product([0.0, 0.25, 0.5, 1.0], repeat=3)))
EPS = np.finfo(np.float64).eps


def by_function(function: Callable[..., Any]) -> str:
    return function.__name__


@pytest.mark.parametrize(
    ("rgb", "hsl"),
    [
        ((1, 0, 0), (0, 1, 0.5)),
        ((1, 1, 0), (1 / 6, 1, 0.5)),
        ((0, 1, 0), (2 / 6, 1, 0.5)),
        ((0, 1, 1), (3 / 6, 1, 0.5)),
        ((0, 0, 1), (4 / 6, 1, 0.5)),
        ((1, 0, 1), (5 / 6, 1, 0.5)),
        ((0.5, 0, 0), (0, 1, 0.25)),
        ((1, 0.5, 0.5), (0, 1, 0.75)),
        ((0, 0, 0), (0, 0, 0)),
        ((0.25, 0.25, 0.25), (0, 0, 0.25)),
        ((1, 1, 1), (0, 0, 1)),
    ],
)
def test_known_colors(rgb: tuple[float, ...], hsl: tuple[float, ...]) -> None:
    assert spaces.rgb_to_hsl(rgb) == pytest.approx(np.array(hsl), abs=1e-7)
    assert spaces.hsl_to_rgb(hsl) == pytest.approx(np.array(rgb), abs=1e-7)


@given(colors)
def test_hsl_is_that_of_colorsys(rgb: np.ndarray) -> None:
    rgb = np.where(rgb < 1e-300, 0.0, rgb)  # colorsys divides what is smaller
    hls = np.array([colorsys.rgb_to_hls(*color) for color in rgb])
    np.testing.assert_allclose(spaces.rgb_to_hsl(rgb), hls[:, [0, 2, 1]], atol=1e-12, rtol=1e-12)


@given(colors, st.sampled_from([np.float64, np.float32]))
def test_the_way_there_and_back_is_exact_to_rounding(rgb: np.ndarray, dtype: type) -> None:
    rgb = rgb.astype(dtype)
    coordinates = spaces.rgb_to_hsl(rgb)
    again = spaces.hsl_to_rgb(coordinates)
    assert coordinates.dtype == again.dtype == dtype
    np.testing.assert_allclose(again, rgb, rtol=0, atol=4 * np.finfo(dtype).eps)
    assert 0.0 <= again.min() <= again.max() <= 1.0
    assert (coordinates >= 0).all()
    assert (coordinates <= 1).all()
    assert (coordinates[:, 0] < 1).all()


@given(arrays(np.float64, (4, 3), elements=st.floats(0.02, 0.98)))
def test_the_way_back_and_there_is_exact_where_hue_matters(coordinates: np.ndarray) -> None:
    np.testing.assert_allclose(spaces.rgb_to_hsl(spaces.hsl_to_rgb(coordinates)), coordinates, rtol=0, atol=1e-12)


@pytest.mark.parametrize("function", BOTH, ids=by_function)
def test_tensors_say_the_same(function: Callable[..., Any]) -> None:
    at = np.concatenate([CORNERS, np.random.default_rng(2).uniform(size=(50, 3))]).reshape(2, -1, 3)
    for dtype, tolerance in ((torch.float64, 1e-15), (torch.float32, 1e-6)):
        result = function(torch.tensor(at, dtype=dtype))
        assert isinstance(result, torch.Tensor)
        assert result.dtype == dtype
        expected = function(at.astype(np.float64 if dtype == torch.float64 else np.float32))
        np.testing.assert_allclose(result.numpy(), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("function", BOTH, ids=by_function)
def test_gradients_are_finite_differences(function: Callable[..., Any]) -> None:
    at = np.random.default_rng(3).uniform(0.05, 0.95, (60, 3))
    spread = np.abs(at[:, [0, 1, 2]] - at[:, [1, 2, 0]]).min(axis=1)
    kinks = np.abs(6 * at[:, 0] - np.round(6 * at[:, 0]))
    at = at[(spread > 0.02) & (kinks > 0.02) & (np.abs(at[:, 2] - 0.5) > 0.01)]
    assert len(at) > 20
    assert torch.autograd.gradcheck(function, torch.tensor(at, requires_grad=True))


@given(st.floats(-1e3, 1e3))
def test_hue_goes_in_circles_and_its_color_is_pure(hue: float) -> None:
    turned = spaces.hsl_to_rgb([[hue + turns, 1.0, 0.5] for turns in (0.0, 1.0, -3.0, 1 / 3)])
    assert (turned[0].min(), turned[0].max()) == (0.0, 1.0)
    np.testing.assert_allclose(turned[:3], np.broadcast_to(turned[0], (3, 3)), atol=1e-11)
    np.testing.assert_allclose(turned[3], turned[0][[2, 0, 1]], atol=1e-11)


def test_colors_are_affine_in_saturation() -> None:
    hue, saturation, lightness = np.random.default_rng(0).uniform(size=(3, 50))
    pure = spaces.hsl_to_rgb(np.stack([hue, np.ones(50), np.full(50, 0.5)], 1))
    direct = lightness[:, None] + (saturation * (1 - abs(2 * lightness - 1)))[:, None] * (pure - 0.5)
    np.testing.assert_allclose(spaces.hsl_to_rgb(np.stack([hue, saturation, lightness], 1)), direct, atol=1e-15)


def test_hue_has_a_gradient_where_two_channels_tie() -> None:
    yellow_and_red = torch.tensor([[0.8, 0.8, 0.2], [0.8, 0.3, 0.3]], dtype=torch.float64, requires_grad=True)
    hue: Callable[[torch.Tensor], torch.Tensor] = lambda rgb: spaces.rgb_to_hsl(rgb)[..., 0]  # noqa: E731
    (gradient,) = torch.autograd.grad(hue(yellow_and_red)[0], yellow_and_red)
    np.testing.assert_allclose(gradient[0].numpy(), np.array([-1, 1, 0]) / 3.6, atol=1e-12)


@given(colors, st.sampled_from(BOTH), st.sampled_from([torch.float64, torch.float32]))
def test_nothing_is_ever_nan(at: np.ndarray, function: Callable[..., Any], dtype: torch.dtype) -> None:
    at = np.concatenate([at, np.repeat(at[:, :1], 3, axis=1)])  # grays too
    assert np.isfinite(function(at)).all()
    leaf = torch.tensor(at, dtype=dtype, requires_grad=True)
    result = function(leaf)
    assert torch.isfinite(result).all()
    if result.requires_grad:
        result.sum().backward()
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()


@given(arrays(np.float32, (4, 3), elements=st.floats(-4, 4, width=32)))
def test_tensors_out_of_range_stay_finite(at: np.ndarray) -> None:
    for function in BOTH:
        leaf = torch.tensor(at, requires_grad=True)
        result = function(leaf)
        (gradient,) = torch.autograd.grad((result + 0 * leaf).sum(), leaf)
        assert torch.isfinite(result).all()
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("function", BOTH, ids=by_function)
def test_shapes_and_kinds(function: Callable[..., Any]) -> None:
    for shape in ((3,), (0, 3), (2, 1, 5, 3)):
        assert function(np.full(shape, 0.25)).shape == shape
        assert tuple(function(torch.full(shape, 0.25)).shape) == shape
    assert function([[0, 1, 0]]).dtype == np.float32
    assert function(np.full((2, 3), 0.5, np.float16)).dtype == np.float32
    assert function([0.25, 0.5, 0.75]).dtype == np.float64
    given = np.full((2, 3), 0.25)
    function(given)
    assert (given == 0.25).all()


@pytest.mark.parametrize("function", BOTH, ids=by_function)
def test_refusals(function: Callable[..., Any]) -> None:
    for wrong in (np.zeros(()), np.zeros(4), np.zeros((3, 4))):
        for value in (wrong, torch.tensor(wrong)):
            with pytest.raises(ValueError, match=r"(rgb|hsl): expected shape \(\.\.\., 3\), got \("):
                function(value)
    with pytest.raises(ValueError, match="expected floats, got bytes; divide"):
        function(np.zeros((2, 3), np.uint8))
    with pytest.raises(ValueError, match="expected a float tensor"):
        function(torch.zeros((2, 3), dtype=torch.uint8))
    with pytest.raises(ValueError, match="expected finite values, got nan"):
        function([0.0, np.nan, 0.0])
    with pytest.raises(ValueError, match="expected numbers"):
        function(["red", "green", "blue"])


def test_ranges_are_named_with_a_remedy() -> None:
    with pytest.raises(ValueError, match=r"rgb: expected values in \[0, 1\], got 1\.5; divide the colors of each"):
        spaces.rgb_to_hsl([0.0, 0.5, 1.5])
    with pytest.raises(ValueError, match=r"hsl: expected values in \[0, 1\], got 1\.25; clip saturation and"):
        spaces.hsl_to_rgb([0.0, 0.5, 1.25])


def test_arrays_need_no_torch() -> None:
    program = "import sys, gsvis.color.spaces as s; s.rgb_to_hsl([1, 0, 0]); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
