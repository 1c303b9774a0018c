"""Quantize base colors and terms: integers of a few bits that index tables, and their size in bytes.

A few numbers define all tables of a scene (`Grids`), so quantizing dequantized colors gives the same integers. Sizes
are those of the records themselves, before entropy coding. Nothing here writes a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.color import grids as _grids
from gsvis.color._kernels import records as kernels
from gsvis.color.srbf import MAX_DECAY, SrbfColors, spherical_coordinates, unit_vectors
from gsvis.color.variants import Variant, variant
from gsvis.jobs.in_order import in_order

__all__ = [
    "PRECISIONS",
    "Grids",
    "Precision",
    "QuantizedColors",
    "bytes_per_base",
    "bytes_per_term",
    "quantize",
    "record_bytes",
    "sh_bytes",
]

F32 = NDArray[np.float32]
U16 = NDArray[np.uint16]
Range = tuple[float, float]

_PART = 1 << 16  # Gaussians whose terms a thread rounds at a time; bounds memory

INTENSITY_FLOOR = 0.1
"""Size of an intensity above which its steps grow with it."""
BASE_KNEE = 0.5
"""Half the width of the interval in which base colors have even steps, [0, 1]."""


@dataclass(frozen=True)
class Precision:
    """Number of bits of each part of a record.

    Attributes:
        name: Name for reports.
        base: Bits of each component of a base color.
        scale: Bits of the scale of a Gaussian, in variants that have one.
        axis: Bits of a color axis. No variant has axes; packages and streams of version 3 state the number.
        center: Bits of the polar angle of a term's center. The azimuth has one more, which gives the least mean error.
        decay: Bits of the decay of a term.
        intensity: Bits of each intensity of a term.

    Raises:
        ValueError: If a number of bits is not in 2 to 16, or `center` above 15.
    """

    name: str
    base: int
    scale: int
    axis: int
    center: int
    decay: int
    intensity: int

    def __post_init__(self) -> None:
        for field in fields(self)[1:]:
            most = 15 if field.name == "center" else 16
            bits = _check.positive_int(field.name, getattr(self, field.name), at_least=2)
            if bits > most:
                raise ValueError(f"{field.name}: expected 2 to {most} bits, got {bits}")


PRECISIONS: dict[str, Precision] = {
    p.name: p
    for p in (
        Precision("coarse", base=7, scale=7, axis=5, center=5, decay=4, intensity=5),
        Precision("wire", base=8, scale=8, axis=6, center=6, decay=5, intensity=6),
        Precision("fine", base=10, scale=10, axis=8, center=8, decay=7, intensity=8),
    )
}
"""Named precisions. `wire` is the default; docs/design/009-color-records.md states their effect on image quality."""


def _precision(value: Precision | str) -> Precision:
    return value if isinstance(value, Precision) else PRECISIONS[_check.one_of("precision", value, tuple(PRECISIONS))]


@dataclass(frozen=True)
class Grids:
    """Parameters of all tables of a scene, all exact in float32.

    Attributes:
        variant: One of `VARIANTS`.
        precision: Bits of each part.
        base: Least and largest value of the three components; (0, 1) for hue, whose steps wrap around.
        scales: Least and largest scale, > 0.
        decays: Least and largest decay, in (0, 1e4].
        intensity: Largest absolute intensity.

    Raises:
        ValueError: If a number is not finite, a range is reversed, or a value is out of its range.
    """

    variant: str
    precision: Precision
    base: tuple[Range, Range, Range]
    scales: Range
    decays: Range
    intensity: float

    def __post_init__(self) -> None:
        variant(self.variant)
        positive = float(np.finfo(np.float32).tiny)
        for name, pair, low, high in (
            *(("base", pair, -1e30, 1e30) for pair in self.base),
            ("scales", self.scales, positive, 1e30),
            ("decays", self.decays, positive, MAX_DECAY),
            ("intensity", (0.0, self.intensity), 0.0, 1e30),
        ):
            if not low <= pair[0] <= pair[1] <= high:  # NaN fails this test too
                raise ValueError(f"{name}: expected a range within [{low:g}, {high:g}], got {pair[0]:g} to {pair[1]:g}")

    @classmethod
    def from_colors(cls, colors: SrbfColors, precision: Precision | str = "wire") -> Grids:
        """Return the narrowest ranges that hold all values of these colors, so that nothing is clipped."""
        ranges = [_range(colors.base[:, k]) for k in range(3)]
        if colors.kind.space == "hsl":
            ranges[0] = (0.0, 1.0)
        return cls(
            colors.variant,
            _precision(precision),
            (ranges[0], ranges[1], ranges[2]),
            _range(colors.scales, 1.0),
            _range(colors.decays, 1.0),
            _largest(colors.intensities),
        )

    @property
    def kind(self) -> Variant:
        """The variant."""
        return variant(self.variant)

    def base_table(self, component: int) -> F32:
        """Return (2^bits,) values of a component of base colors."""
        bits = self.precision.base
        if self.kind.space == "hsl" and component == 0:
            return _grids.circle(0.0, 1.0, 1 << bits)[:-1]
        return _grids.bend(*self.base[component], 0.5, BASE_KNEE, bits)

    def scale_table(self) -> F32:
        """Return (2^bits,) scales, in even steps up to 1, because the error of the color matters."""
        return _grids.bend(*self.scales, 0.0, 1.0, self.precision.scale)

    def theta_table(self) -> F32:
        """Return (2^bits,) polar angles, none at a pole."""
        count = 1 << self.precision.center
        return np.asarray((np.arange(count) + 0.5) * (np.pi / count), np.float32)

    def phi_table(self) -> F32:
        """Return (2^(bits + 1),) azimuths, from -pi."""
        return _grids.circle(-np.pi, 2.0 * np.pi, 2 << self.precision.center)[:-1]

    def decay_table(self) -> F32:
        """Return (2^bits,) decays in even ratios."""
        return _grids.geometric(*self.decays, self.precision.decay)

    def intensity_table(self) -> F32:
        """Return (2^bits - 1,) intensities, 0 in the middle."""
        return _grids.compand(self.intensity, INTENSITY_FLOOR, self.precision.intensity)


@dataclass(frozen=True, eq=False, repr=False)
class QuantizedColors:
    """Colors of N Gaussians and their T terms as integers, validated, read-only.

    Args:
        grids: Tables that the integers index.
        base: (N, 3) uint16, indices into the tables of the components.
        scales: (N,) uint16, indices into the table of scales; (0,) for variants in RGB, which have none.
        offsets: (N + 1,) int64; the terms of Gaussian i are offsets[i]:offsets[i + 1], in sending order.
        functions: (T,) uint8, index into the variant's functions.
        centers: (T, 2) uint16, indices into the tables of polar angle and azimuth.
        decays: (T,) uint16, indices into the table of decays.
        intensities: (T, I) uint16, indices into the table of intensities.

    Raises:
        ValueError: If a shape or an order does not fit, or an index is beyond its table.
    """

    grids: Grids
    base: U16
    scales: U16
    offsets: NDArray[np.int64]
    functions: NDArray[np.uint8]
    centers: U16
    decays: U16
    intensities: U16

    def __post_init__(self) -> None:
        kind = self.grids.kind
        p = self.grids.precision
        n = len(self.base)
        offsets = _check.integers("offsets", self.offsets, (n + 1,))
        if offsets[0] != 0 or np.any(np.diff(offsets) < 0):
            raise ValueError(f"offsets: expected ascending values from 0, got {_check.not_rising(offsets, first=0)}")
        t = int(offsets[-1])
        arrays: dict[str, NDArray[Any]] = {"offsets": offsets}
        for name, shape, most in (
            ("base", (n, 3), (1 << p.base) - 1),
            ("scales", (n if has_scales(kind) else 0,), (1 << p.scale) - 1),
            ("functions", (t,), len(kind.functions) - 1),
            ("centers", (t, 2), (2 << p.center) - 1),
            ("decays", (t,), (1 << p.decay) - 1),
            ("intensities", (t, kind.intensities), (1 << p.intensity) - 2),
        ):
            dtype = np.uint8 if name == "functions" else np.uint16
            arrays[name] = _check.integers(name, getattr(self, name), shape, dtype)
            _check.in_range(name, arrays[name], 0, most)
        _check.in_range("centers", arrays["centers"][:, 0], 0, (1 << p.center) - 1)
        for name, array in arrays.items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.base)

    def __repr__(self) -> str:
        g = self.grids
        sizes = f"{len(self):,} Gaussians, {self.num_terms:,} terms"
        return f"QuantizedColors({g.variant!r}, {g.precision.name!r}, {sizes})"

    @property
    def num_terms(self) -> int:
        """T."""
        return len(self.functions)

    @property
    def nbytes(self) -> int:
        """Bytes of all records, packed bit by bit."""
        return _packed_bytes(self.grids.kind, self.grids.precision, self.offsets)

    def dequantize(self) -> SrbfColors:
        """Return the colors of the records as floats."""
        g = self.grids
        base = np.stack([g.base_table(k)[self.base[:, k]] for k in range(3)], axis=1)
        scales = g.scale_table()[self.scales] if has_scales(g.kind) else np.ones(len(self), np.float32)
        centers = np.stack([g.theta_table()[self.centers[:, 0]], g.phi_table()[self.centers[:, 1]]], axis=1)
        return SrbfColors(
            g.variant,
            base,
            scales,
            self.offsets,
            self.functions,
            centers,
            g.decay_table()[self.decays],
            g.intensity_table()[self.intensities],
        )


def quantize(
    colors: SrbfColors,
    precision: Precision | str = "wire",
    *,
    refit: bool = True,
    grids: Grids | None = None,
    reach: Sequence[tuple[float, float]] | None = None,
) -> QuantizedColors:
    """Round colors to the precision of records.

    With `refit`, intensities are first fitted to the rounded centers and decays. They are then rounded one by one, the
    largest of a Gaussian first; each compensates for the rounding errors so far. Both steps are least squares in the
    mean over the whole sphere, with small integrals in closed form: no directions, images or renderer are needed.

    A center moves by at most (pi / 2^center) / sqrt(2), a decay by half a ratio, (largest / least)^(1 / (2^decay - 1)),
    a base component in [0, 1] by half an even step. Without `refit` an
    intensity a moves by at most (|a| + 0.1) (exp(k / 2) - 1), k = log(1 + largest / 0.1) / (2^(intensity - 1) - 1).

    Args:
        colors: Colors to round.
        precision: A name from `PRECISIONS`, or a `Precision`.
        refit: Adapt intensities; False rounds each number on its own.
        grids: Tables to use instead of the colors' own, such as those of a larger scene; `precision` is then
            ignored. Values outside their ranges are rejected.
        reach: Least and largest value of each component of base colors, in RGB, which the colors' own tables then cover
            too. Scenes rounded separately with the same `reach` can share tables. Variants in other spaces ignore it.

    Raises:
        ValueError: If the variant is in RGB and a scale is not 1, or `grids` does not cover the colors.

    Examples:
        >>> packed = quantize(SrbfColors.without_terms([[0.0, 0.5, 1.0]]), "fine")
        >>> packed.nbytes, packed.dequantize().base.round(3).tolist()
        (4, [[0.0, 0.5, 1.0]])
    """
    own = Grids.from_colors(colors, precision)
    if reach is not None and colors.kind.space == "rgb":
        low, high = np.array([own.base, np.asarray(reach)], np.float32).transpose(2, 0, 1)
        red, green, blue = zip(low.min(axis=0).tolist(), high.max(axis=0).tolist(), strict=True)
        own = replace(own, base=(red, green, blue))
    g = own if grids is None else grids
    if grids is not None:
        _check_covers(own, grids)
    kind = colors.kind
    if not has_scales(kind) and np.any(colors.scales != 1.0):
        raise ValueError(f"scales: expected 1 for {kind.name!r}, whose space is RGB, got {colors.scales.max():g}")
    base = np.empty((len(colors), 3), np.uint16)
    for k in range(3):
        if kind.space == "hsl" and k == 0:
            base[:, k] = _around(colors.base[:, 0], 0.0, 1.0, 1 << g.precision.base)
        else:
            base[:, k] = _grids.nearest(colors.base[:, k], g.base_table(k))
    parts = [slice(start, start + _PART) for start in range(0, max(len(colors), 1), _PART)]
    lobes = list(in_order(lambda part: _round_lobes(colors[part], g), parts))
    if refit:
        pairs = zip(parts, lobes, strict=True)
        values = list(in_order(lambda pair: _project(colors[pair[0]], _lobes_of(pair[1], g)), pairs))
        if grids is None:
            g = replace(g, intensity=max(map(_largest, values)))
        rows = zip(parts, lobes, values, strict=True)
        places = list(in_order(lambda row: _round_jointly(colors[row[0]], _lobes_of(row[1], g), row[2], g), rows))
        del values
    else:
        places = [_grids.nearest(colors[part].intensities.astype(np.float64), g.intensity_table()) for part in parts]
    centers, decays = (np.concatenate(column) for column in zip(*lobes, strict=True))
    intensities = np.concatenate(places)
    scales = _grids.nearest(colors.scales, g.scale_table()) if has_scales(kind) else np.zeros(0, np.uint16)
    return QuantizedColors(g, base, scales, colors.offsets, colors.functions, centers, decays, intensities)


def bytes_per_term(name: str, precision: Precision | str | None = "wire") -> float:
    """Return the bytes of one term of a variant: center, decay, intensities.

    Args:
        name: Name of the variant.
        precision: A name from `PRECISIONS`, or a `Precision`; None for float32 throughout.

    Examples:
        >>> bytes_per_term("rgb"), bytes_per_term("hsl"), bytes_per_term("rgb", None)
        (4.5, 3.125, 24.0)
    """
    return _term_bits(variant(name), None if precision is None else _precision(precision)) / 8


def bytes_per_base(name: str, precision: Precision | str | None = "wire") -> float:
    """Return the bytes of a Gaussian besides its terms: base color, and a scale if the variant has one.

    Args:
        name: Name of the variant.
        precision: A name from `PRECISIONS`, or a `Precision`; None for float32 throughout.
    """
    return _base_bits(variant(name), None if precision is None else _precision(precision)) / 8


def record_bytes(colors: SrbfColors | QuantizedColors, precision: Precision | str | None = "wire") -> int:
    """Return the bytes of the records of colors: bases, terms, and the bits that count the terms of each Gaussian.

    Args:
        colors: Colors of N Gaussians.
        precision: A name from `PRECISIONS`, or a `Precision`; None for float32 throughout. Ignored for quantized
            colors.
    """
    if isinstance(colors, QuantizedColors):
        return colors.nbytes
    return _packed_bytes(colors.kind, None if precision is None else _precision(precision), colors.offsets)


def sh_bytes(degree: int, bits: int = 32) -> float:
    """Return the bytes of the color of one Gaussian as spherical harmonics, for comparison.

    Args:
        degree: 0 to 3.
        bits: Bits of each coefficient: 32, 16, or 8.
    """
    if degree not in range(4):
        raise ValueError(f"degree: expected 0 to 3, got {degree!r}")
    return 3 * (degree + 1) ** 2 * _check.positive_int("bits", bits) / 8


def has_scales(kind: Variant) -> bool:
    """Return whether the Gaussians of a variant have a scale."""
    return kind.space != "rgb"


def _term_bits(kind: Variant, p: Precision | None) -> int:
    """Return the bits of one term; 32 for each number without a precision."""
    if p is None:
        return (8 if len(kind.functions) > 1 else 0) + 32 * (3 + kind.intensities)
    function = (len(kind.functions) - 1).bit_length()
    return function + 2 * p.center + 1 + p.decay + kind.intensities * p.intensity


def _base_bits(kind: Variant, p: Precision | None) -> int:
    """Return the bits of a Gaussian besides its terms; 32 for each number without a precision."""
    if p is None:
        return 32 * (3 + has_scales(kind))
    return 3 * p.base + has_scales(kind) * p.scale


def _packed_bytes(kind: Variant, p: Precision | None, offsets: NDArray[np.int64]) -> int:
    """Return the bytes of all records packed bit by bit, including the counts of terms."""
    count_bits = int(np.diff(offsets).max(initial=0)).bit_length()
    n = len(offsets) - 1
    t = int(offsets[-1])
    return -(-(n * (_base_bits(kind, p) + count_bits) + t * _term_bits(kind, p)) // 8)


def _range(values: F32, empty: float = 0.0) -> Range:
    """Return the least and largest value; `empty` for none."""
    return (float(values.min()), float(values.max())) if len(values) else (empty, empty)


def _largest(intensities: NDArray[np.floating[Any]]) -> float:
    return float(np.float32(np.abs(intensities).max(initial=0.0)))


def _check_covers(own: Grids, given: Grids) -> None:
    """Raise unless the given tables cover the range of our own."""
    if own.variant != given.variant:
        raise ValueError(f"grids: expected tables of variant {own.variant!r}, got {given.variant!r}")
    mine = asdict(own)
    theirs = asdict(given)
    pairs = [("base", a, b) for a, b in zip(mine["base"], theirs["base"], strict=True)]
    pairs += [(name, mine[name], theirs[name]) for name in ("scales", "decays")]
    pairs.append(("intensities", (0.0, mine["intensity"]), (0.0, theirs["intensity"])))
    for name, (low, high), (least, most) in pairs:
        if low < least or high > most:
            raise ValueError(f"{name}: expected within [{least:g}, {most:g}], got {low:g} to {high:g}; use wider grids")


def _around(values: NDArray[np.floating[Any]], low: float, turn: float, count: int) -> U16:
    """Return the indices of values on a circle of `count` even steps."""
    steps = np.rint((values.astype(np.float64) - low) * (count / turn))
    return np.asarray(np.mod(steps, count), np.uint16)


def _round_lobes(colors: SrbfColors, g: Grids) -> tuple[U16, U16]:
    """Return the indices of centers (T, 2) and decays (T,)."""
    theta, phi = np.moveaxis(spherical_coordinates(unit_vectors(colors.centers)), -1, 0)
    bits = g.precision.center
    places = np.clip(np.floor(theta * ((1 << bits) / np.pi)), 0, (1 << bits) - 1)
    centers = np.stack([places.astype(np.uint16), _around(phi, -np.pi, 2.0 * np.pi, 2 << bits)], axis=1)
    return centers, _grids.nearest(colors.decays, g.decay_table())


def _centers_of(places: U16, g: Grids) -> F32:
    """Return (T, 2) angles of rounded centers."""
    return np.stack([g.theta_table()[places[:, 0]], g.phi_table()[places[:, 1]]], axis=1)


def _lobes_of(places: tuple[U16, U16], g: Grids) -> NDArray[np.float64]:
    """Return (T, 4) decay times center, and decay, of rounded lobes."""
    centers, decays = places
    return _lobes(_centers_of(centers, g), g.decay_table()[decays])


def _lobes(centers: F32, decays: F32) -> NDArray[np.float64]:
    """Return (T, 4) decay times center, and decay."""
    lengths = decays.astype(np.float64)[:, None]
    return np.concatenate([unit_vectors(centers) * lengths, lengths], axis=1)


def _project(colors: SrbfColors, rounded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the intensities that fit the rounded lobes best."""
    values = colors.intensities.astype(np.float64)
    out = np.empty_like(values)
    lobes = _lobes(colors.centers, colors.decays)
    kernels.project(colors.offsets, colors.functions, lobes, rounded, values, out)
    return out


def _round_jointly(colors: SrbfColors, lobes: NDArray[np.float64], values: NDArray[np.float64], g: Grids) -> U16:
    """Return the indices of intensities, each rounded so that it compensates the errors of larger ones."""
    table = g.intensity_table()
    places = np.empty(values.shape, np.uint16)
    middles = _grids.middles(table)
    kernels.round_jointly(colors.offsets, colors.functions, lobes, values, table.astype(np.float64), middles, places)
    return places
