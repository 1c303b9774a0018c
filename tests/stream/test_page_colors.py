"""The formulas of docs/streaming.md, written down once more in plain Python, give the tables and colors of gsvis.

Whoever changes a formula here changes it on the page, and the other way round.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.abr.holdings import Holdings
from gsvis.color.evaluate import evaluate
from gsvis.color.records import PRECISIONS, Grids
from gsvis.stream import Token
from tests.stream.worlds import package_of

PAGE = Path(__file__).parents[2] / "docs" / "streaming.md"
FLOATS = st.floats(-8.0, 8.0, width=32)
POSITIVE = st.floats(2.0**-6, 512.0, width=32)


def sign(x: float) -> float:
    return -1.0 if x < 0 else 1.0


def bend(low: float, high: float, center: float, knee: float, n: int) -> list[float]:
    def u(x: float) -> float:
        away = abs(x - center)
        return x - center if away <= knee else sign(x - center) * knee * (1 + math.log(away / knee))

    def entry(i: int) -> float:
        p = u(low) + (u(high) - u(low)) * i / (n - 1)
        return center + (p if abs(p) <= knee else sign(p) * knee * math.exp(abs(p) / knee - 1))

    return ended([entry(i) for i in range(n)], low, high)


def ended(values: list[float], low: float, high: float) -> list[float]:
    return [low, *(min(max(value, low), high) for value in values[1:-1]), high]


def decays_of(low: float, high: float, n: int) -> list[float]:
    return ended([low * (high / low) ** (i / (n - 1)) for i in range(n)], low, high)


def intensities_of(most: float, bits: int) -> list[float]:
    h = 2 ** (bits - 1) - 1
    steps = [sign(j) * 0.1 * (math.exp(abs(j) / h * math.log(1 + most / 0.1)) - 1) for j in range(-h, h + 1)]
    return ended(steps, -most, most)


@given(
    st.sampled_from(["rgb", "hsl"]),
    st.sampled_from(sorted(PRECISIONS)),
    st.tuples(*[st.tuples(FLOATS, FLOATS).map(sorted)] * 3),
    st.tuples(POSITIVE, POSITIVE).map(sorted),
    st.tuples(POSITIVE, POSITIVE).map(sorted),
    st.floats(0.0, 64.0, width=32),
)
def test_tables(variant: str, name: str, base, scales, decays, intensity: float) -> None:
    p = PRECISIONS[name]
    pairs = [tuple(pair) for pair in base]
    if variant == "hsl":
        pairs[0] = (0.0, 1.0)
    grids = Grids(variant, p, tuple(pairs), tuple(scales), tuple(decays), intensity)  # type: ignore[arg-type]
    n = 2**p.base
    for k, (low, high) in enumerate(pairs):
        hue = variant == "hsl" and k == 0
        expected = [i / n for i in range(n)] if hue else bend(low, high, 0.5, 0.5, n)
        np.testing.assert_allclose(grids.base_table(k), expected, rtol=3e-7, atol=3e-7)
    np.testing.assert_allclose(grids.scale_table(), bend(*scales, 0.0, 1.0, 2**p.scale), rtol=3e-7)
    n = 2**p.center
    np.testing.assert_allclose(grids.theta_table(), [(i + 0.5) * math.pi / n for i in range(n)], rtol=3e-7)
    n = 2 ** (p.center + 1)
    np.testing.assert_allclose(grids.phi_table(), [-math.pi + 2 * math.pi * i / n for i in range(n)], atol=3e-7)
    np.testing.assert_allclose(grids.decay_table(), decays_of(*decays, 2**p.decay), rtol=3e-7)
    np.testing.assert_allclose(grids.intensity_table(), intensities_of(intensity, p.intensity), rtol=3e-6, atol=1e-7)


def color_of(variant: str, base: list[float], scale: float, terms: list[tuple], mean: list[float], eye: list[float]):
    """The color of one Gaussian; a term is function, polar angle, azimuth, decay, intensities."""
    away = [m - e for m, e in zip(mean, eye, strict=True)]
    length = math.sqrt(sum(x * x for x in away))
    d = [x / length for x in away] if length else [0.0, 0.0, 1.0]
    v = list(base)
    for function, a, b, decay, intensities in terms:
        c = (math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a))
        s = math.exp(decay * (sum(x * y for x, y in zip(d, c, strict=True)) - 1))
        for k in range(3):
            if variant == "rgb":
                v[k] += intensities[k] * s
            elif k == function + 1:
                v[k] += intensities[0] * base[k] * s
    if variant == "rgb":
        return [max(0.0, x) for x in v]
    hue, saturation, lightness = v[0], min(max(v[1], 0.0), 1.0), min(max(v[2], 0.0), 1.0)
    ramps = [max(-1.0, min(w - 3, 9 - w, 1.0)) for w in ((t + 12 * hue) % 12 for t in (0, 8, 4))]
    return [max(0.0, scale * (lightness - saturation * min(lightness, 1 - lightness) * ramp)) for ramp in ramps]


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
def test_colors(tmp_path: Path, variant: str) -> None:
    eye = [0.25, -1.5, 0.5]
    with package_of(tmp_path / "s.gsvis", 200, variant) as package:
        contents = package.contents
        colors, means = contents.colors().dequantize(), contents.gaussians().means
        expected = evaluate(colors, means, eye)
    offsets = colors.offsets.tolist()
    assert offsets[-1] > 100
    for i, (start, stop) in enumerate(pairwise(offsets)):
        terms = [
            (
                int(colors.functions[t]),
                *colors.centers[t].tolist(),
                float(colors.decays[t]),
                colors.intensities[t].tolist(),
            )
            for t in range(start, stop)
        ]
        found = color_of(variant, colors.base[i].tolist(), float(colors.scales[i]), terms, means[i].tolist(), eye)
        np.testing.assert_allclose(found, expected[i], atol=2e-5)


ARRAY, RUNS = 12346, 12347


def words(*values: int) -> bytes:
    return np.array(values, "<u2").tobytes()


def plain(values: list[int]) -> bytes:
    """A bitmap below 65,536 without runs: an array, or a bitset of more than 4096 values."""
    data = words(*values)
    if len(values) > 4096:
        bits = np.zeros(1 << 16, np.uint8)
        bits[values] = 1
        data = np.packbits(bits, bitorder="little").tobytes()
    return np.array([ARRAY, 1], "<u4").tobytes() + words(0, len(values) - 1) + np.array([16], "<u4").tobytes() + data


def with_runs(count: int, *runs: int) -> bytes:
    return np.array([RUNS], "<u4").tobytes() + b"\1" + words(0, count - 1, len(runs) // 2, *runs)


BITSET_OF_FEW = plain([*range(0, 10_000, 2)])[:8] + words(0, 1) + np.array([16], "<u4").tobytes() + b"\5" + bytes(8191)
BITMAPS = {
    "an empty set": (bytes.fromhex("3a30000000000000"), True),
    "an array, even where runs are smaller": (plain([*range(100)]), True),
    "a bitset of many": (plain([*range(0, 10_000, 2)]), True),
    "runs": (with_runs(100, 0, 99), True),
    "runs where an array is smaller": (with_runs(2, 0, 0, 5, 0), True),
    "no bytes": (b"", False),
    "a bitset of few": (BITSET_OF_FEW, False),
    "values that fall": (plain([3, 2]), False),
    "runs that touch": (with_runs(4, 0, 1, 2, 1), False),
    "runs that overlap": (with_runs(6, 0, 3, 2, 3), False),
    "the cookie of runs without runs": (np.array([RUNS], "<u4").tobytes() + b"\0" + words(0, 1, 1, 5), False),
    "a byte too many": (plain([1, 5]) + b"\0", False),
    "an id beyond the scene": (plain([20_000]), False),
}


@pytest.mark.parametrize("name", BITMAPS)
def test_bitmaps_of_holdings(name: str) -> None:
    data, is_good = BITMAPS[name]
    nothing = bytes.fromhex("3a30000000000000")
    parts = [data, nothing, nothing]
    head = b"GVH1" + np.array([20_000, 10, *map(len, parts)], "<u4").tobytes()
    if is_good:
        Holdings.from_bytes(head + b"".join(parts), 20_000, 10)
        return
    with pytest.raises(ValueError, match="data: expected"):
        Holdings.from_bytes(head + b"".join(parts), 20_000, 10)


def test_the_page_names_what_is_tested() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for part in (
        Token("s3cret").to_bytes().hex(),
        "3a30000000000000",
        "bend(low, high, 0.5, 0.5)",
        "exp(decay (d . c - 1))",
    ):
        assert part in page
