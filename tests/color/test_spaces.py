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

PAIRS = {
    "hsl": (spaces.rgb_to_hsl, spaces.hsl_to_rgb),
    "hsv": (spaces.rgb_to_hsv, spaces.hsv_to_rgb),
    "yuv": (spaces.rgb_to_yuv, spaces.yuv_to_rgb),
}
SLOPES: dict[Callable[..., Any], tuple[Callable[..., Any], int]] = {
    spaces.rgb_by_hsl_saturation: (spaces.hsl_to_rgb, 1),
    spaces.rgb_by_hsl_lightness: (spaces.hsl_to_rgb, 2),
    spaces.rgb_by_hsv_saturation: (spaces.hsv_to_rgb, 1),
    spaces.rgb_by_hsv_value: (spaces.hsv_to_rgb, 2),
    spaces.rgb_by_yuv_luma: (spaces.yuv_to_rgb, 0),
}
EVERYTHING = [f for pair in PAIRS.values() for f in pair] + list(SLOPES)

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
    ("rgb", "hsl", "hsv"),
    [
        ((1, 0, 0), (0, 1, 0.5), (0, 1, 1)),
        ((1, 1, 0), (1 / 6, 1, 0.5), (1 / 6, 1, 1)),
        ((0, 1, 0), (2 / 6, 1, 0.5), (2 / 6, 1, 1)),
        ((0, 1, 1), (3 / 6, 1, 0.5), (3 / 6, 1, 1)),
        ((0, 0, 1), (4 / 6, 1, 0.5), (4 / 6, 1, 1)),
        ((1, 0, 1), (5 / 6, 1, 0.5), (5 / 6, 1, 1)),
        ((0.5, 0, 0), (0, 1, 0.25), (0, 1, 0.5)),
        ((1, 0.5, 0.5), (0, 1, 0.75), (0, 0.5, 1)),
        ((0, 0, 0), (0, 0, 0), (0, 0, 0)),
        ((0.25, 0.25, 0.25), (0, 0, 0.25), (0, 0, 0.25)),
        ((1, 1, 1), (0, 0, 1), (0, 0, 1)),
    ],
)
def test_known_colors(rgb: tuple[float, ...], hsl: tuple[float, ...], hsv: tuple[float, ...]) -> None:
    assert spaces.rgb_to_hsl(rgb) == pytest.approx(np.array(hsl), abs=1e-7)
    assert spaces.rgb_to_hsv(rgb) == pytest.approx(np.array(hsv), abs=1e-7)
    assert spaces.hsl_to_rgb(hsl) == pytest.approx(np.array(rgb), abs=1e-7)
    assert spaces.hsv_to_rgb(hsv) == pytest.approx(np.array(rgb), abs=1e-7)


def test_yuv_is_bt_601() -> None:
    primaries = np.eye(3)
    expected = [[0.299, -0.168736, 0.5], [0.587, -0.331264, -0.418688], [0.114, 0.5, -0.081312]]
    np.testing.assert_allclose(spaces.rgb_to_yuv(primaries), expected, atol=1e-6)
    np.testing.assert_allclose(
        spaces.yuv_to_rgb(primaries), [[1, 1, 1], [0, -0.344136, 1.772], [1.402, -0.714136, 0]], atol=1e-6
    )
    grays = np.linspace(-2, 3, 11)[:, None].repeat(3, axis=1)
    np.testing.assert_array_equal(spaces.rgb_to_yuv(grays), grays * [1, 0, 0])


@given(colors)
def test_hsl_and_hsv_are_those_of_colorsys(rgb: np.ndarray) -> None:
    rgb = np.where(rgb < 1e-300, 0.0, rgb)  # colorsys divides what is smaller
    hls = np.array([colorsys.rgb_to_hls(*color) for color in rgb])
    np.testing.assert_allclose(spaces.rgb_to_hsl(rgb), hls[:, [0, 2, 1]], atol=1e-12, rtol=1e-12)
    hsv = np.array([colorsys.rgb_to_hsv(*color) for color in rgb])
    np.testing.assert_allclose(spaces.rgb_to_hsv(rgb), hsv, atol=1e-12, rtol=1e-12)


@given(colors, st.sampled_from(sorted(PAIRS)), st.sampled_from([np.float64, np.float32]))
def test_the_way_there_and_back_is_exact_to_rounding(rgb: np.ndarray, name: str, dtype: type) -> None:
    there, back = PAIRS[name]
    rgb = rgb.astype(dtype)
    coordinates = there(rgb)
    again = back(coordinates)
    assert coordinates.dtype == again.dtype == dtype
    np.testing.assert_allclose(again, rgb, rtol=0, atol=4 * np.finfo(dtype).eps)
    if name != "yuv":
        assert 0.0 <= again.min() <= again.max() <= 1.0
        assert (coordinates >= 0).all()
        assert (coordinates <= 1).all()
        assert (coordinates[:, 0] < 1).all()


@given(arrays(np.float64, (4, 3), elements=st.floats(0.02, 0.98)), st.sampled_from(["hsl", "hsv"]))
def test_the_way_back_and_there_is_exact_where_hue_matters(coordinates: np.ndarray, name: str) -> None:
    there, back = PAIRS[name]
    np.testing.assert_allclose(there(back(coordinates)), coordinates, rtol=0, atol=1e-12)


@given(colors, st.floats(1e-6, 1e6))
def test_hsv_scales_with_colors_beyond_one(rgb: np.ndarray, scale: float) -> None:
    before, after = spaces.rgb_to_hsv(rgb), spaces.rgb_to_hsv(rgb * scale)
    np.testing.assert_allclose(after[:, 2], before[:, 2] * scale, rtol=1e-14, atol=1e-300)
    np.testing.assert_allclose(spaces.hsv_to_rgb(after), rgb * scale, rtol=0, atol=4 * EPS * max(1.0, scale))


@given(st.floats(-1e3, 1e3))
def test_hue_goes_in_circles_and_its_vector_is_saturated(hue: float) -> None:
    vector = spaces.hue_vector(hue)
    assert vector.shape == (3,)
    assert (vector.min(), vector.max()) == (0.0, 1.0)
    turned = spaces.hue_vector([hue, hue + 1.0, hue - 3.0])
    np.testing.assert_allclose(turned, np.broadcast_to(turned[0], (3, 3)), atol=1e-11)
    np.testing.assert_allclose(spaces.hsl_to_rgb(np.array([hue, 1.0, 0.5])), turned[0], atol=1e-15)
    next_primary = spaces.hue_vector(np.float64(hue + 1 / 3))
    np.testing.assert_allclose(next_primary, turned[0][[2, 0, 1]], atol=1e-11)


def test_colors_are_affine_in_saturation() -> None:
    rng = np.random.default_rng(0)
    hue, saturation, lightness = rng.uniform(size=(3, 50))
    h = spaces.hue_vector(hue)
    direct = lightness[:, None] + (saturation * (1 - abs(2 * lightness - 1)))[:, None] * (h - 0.5)
    np.testing.assert_allclose(spaces.hsl_to_rgb(np.stack([hue, saturation, lightness], 1)), direct, atol=1e-15)


@pytest.mark.parametrize("slope", SLOPES, ids=by_function)
def test_slopes_are_finite_differences(slope: Callable[..., Any]) -> None:
    function, coordinate = SLOPES[slope]
    at = np.random.default_rng(1).uniform(0.01, 0.99, (100, 3))
    at = at[np.abs(at[:, 2] - 0.5) > 1e-3]
    step = 1e-6 * np.eye(3)[coordinate]
    differences = (function(at + step) - function(at - step)) / 2e-6
    np.testing.assert_allclose(slope(at), differences, atol=1e-8)
    degenerate = slope(CORNERS)
    assert degenerate.shape == CORNERS.shape
    assert np.isfinite(degenerate).all()


def test_the_slope_by_lightness_at_the_kink_is_the_mean_of_both_sides() -> None:
    below, at, above = spaces.rgb_by_hsl_lightness([[0.1, 0.7, 0.4], [0.1, 0.7, 0.5], [0.1, 0.7, 0.6]])
    np.testing.assert_allclose(at, (below + above) / 2, atol=1e-6)


@pytest.mark.parametrize("function", EVERYTHING, ids=by_function)
def test_tensors_say_the_same(function: Callable[..., Any]) -> None:
    at = np.concatenate([CORNERS, np.random.default_rng(2).uniform(size=(50, 3))]).reshape(2, -1, 3)
    for dtype, tolerance in ((torch.float64, 1e-15), (torch.float32, 1e-6)):
        result = function(torch.tensor(at, dtype=dtype))
        assert isinstance(result, torch.Tensor)
        assert result.dtype == dtype
        expected = function(at.astype(np.float64 if dtype == torch.float64 else np.float32))
        np.testing.assert_allclose(result.numpy(), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("function", [f for pair in PAIRS.values() for f in pair], ids=by_function)
def test_gradients_are_finite_differences(function: Callable[..., Any]) -> None:
    at = np.random.default_rng(3).uniform(0.05, 0.95, (60, 3))
    spread = np.abs(at[:, [0, 1, 2]] - at[:, [1, 2, 0]]).min(axis=1)
    kinks = np.abs(6 * at[:, 0] - np.round(6 * at[:, 0]))
    at = at[(spread > 0.02) & (kinks > 0.02) & (np.abs(at[:, 2] - 0.5) > 0.01)]
    assert len(at) > 20
    assert torch.autograd.gradcheck(function, torch.tensor(at, requires_grad=True))


def test_hue_has_a_gradient_where_two_channels_tie() -> None:
    yellow_and_red = torch.tensor([[0.8, 0.8, 0.2], [0.8, 0.3, 0.3]], dtype=torch.float64, requires_grad=True)
    hue: Callable[[torch.Tensor], torch.Tensor] = lambda rgb: spaces.rgb_to_hsl(rgb)[..., 0]  # noqa: E731
    (gradient,) = torch.autograd.grad(hue(yellow_and_red)[0], yellow_and_red)
    np.testing.assert_allclose(gradient[0].numpy(), np.array([-1, 1, 0]) / 3.6, atol=1e-12)


@given(colors, st.sampled_from(EVERYTHING), st.sampled_from([torch.float64, torch.float32]))
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
    for function in EVERYTHING:
        leaf = torch.tensor(at, requires_grad=True)
        result = function(leaf)
        (gradient,) = torch.autograd.grad((result + 0 * leaf).sum(), leaf)
        assert torch.isfinite(result).all()
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("function", EVERYTHING, ids=by_function)
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


@pytest.mark.parametrize("function", EVERYTHING, ids=by_function)
def test_refusals(function: Callable[..., Any]) -> None:
    for wrong in (np.zeros(()), np.zeros(4), np.zeros((3, 4))):
        for value in (wrong, torch.tensor(wrong)):
            with pytest.raises(ValueError, match=r"(rgb|hsl|hsv|yuv): expected shape \(\.\.\., 3\), got \("):
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
    with pytest.raises(ValueError, match=r"rgb: expected values in \[0, inf\), got -0\.5; clip the colors below"):
        spaces.rgb_to_hsv([0.0, -0.5, 1.5])
    for function in (spaces.hsl_to_rgb, spaces.rgb_by_hsl_saturation, spaces.rgb_by_hsl_lightness):
        with pytest.raises(ValueError, match=r"hsl: expected values in \[0, 1\], got 1\.25; clip saturation and"):
            function([0.0, 0.5, 1.25])
    for function in (spaces.hsv_to_rgb, spaces.rgb_by_hsv_value, spaces.rgb_by_hsv_saturation):
        with pytest.raises(ValueError, match=r"hsv: expected values in \[0, 1\], got 1\.25; clip saturation to"):
            function([7.0, 1.25, 2.0])
    with pytest.raises(ValueError, match="hue: expected finite values"):
        spaces.hue_vector(np.inf)


def test_arrays_need_no_torch() -> None:
    program = "import sys, gsvis.color.spaces as s; s.rgb_to_hsl([1, 0, 0]); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
