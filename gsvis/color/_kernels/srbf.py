"""Kernels that turn a base and its SRBF terms into colors: all Gaussians from one eye, or each along many directions.

Gaussians are processed in windows of WINDOW, sorted in each by their number of terms and split into groups of LANES: a
vector holds the k-th terms of the Gaussians of a group. Directions run from the eye to the Gaussian. The exponent comes
from the chord, decay (x.c - 1) = -decay/2 |x - c|^2, which keeps its digits in float32 for narrow lobes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.compiled import inner, kernel, njit
from gsvis._kernels.simd import Builder, Vector
from gsvis._kernels.threads import in_parts
from gsvis.color._kernels.rgb import to_rgb

__all__ = ["LANES", "SLOT", "WINDOW", "colors_along", "colors_from_eye", "pack"]

LANES = 16
GROUPS = 16
WINDOW = LANES * GROUPS

SLOT = 7
"""Rows of a slot: the center's x, y, z; -decay/2 log2 e; what the term adds in each component of the space."""

_HALF_LOG2E = np.float32(0.7213475204444817)
_I64 = ir.IntType(64)


def _row(builder: Any, array: Any, row: Any) -> Any:
    """Return the address of the first entry of row `row` of a two-dimensional array."""
    return builder.mul(row, cgutils.unpack_tuple(builder, array.shape, 2)[1])


def _lobe(terms: list[Vector], x: list[Vector], factor: Vector | float) -> Vector:
    """Return exp2 of the exponent of terms (rows of SLOT) at x, times a factor."""
    chord = [a - b for a, b in zip(x, terms[:3], strict=True)]
    square = chord[0].times_plus(chord[0], chord[1].times_plus(chord[1], chord[2] * chord[2]))
    return (square * terms[3]).exp2() * factor


@intrinsic
def _add_group(typing_context, slots, first, count, x, gates, sums, group):
    """Add the terms in slots first .. first + count to the sums of the LANES Gaussians of a group.

    Args:
        typing_context: The typing context of numba, unused.
        slots: (S * SLOT, LANES) float32.
        first: Index of the first slot.
        count: Number of slots.
        x: (3, WINDOW) float32, unit directions.
        gates: (>= count, LANES) float32, factors of the terms.
        sums: (3, WINDOW) float32, changed in place.
        group: Index of the group in the window.
    """
    del typing_context
    i64 = types.int64
    signature = types.void(slots, i64, i64, x, gates, sums, i64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        source, eye, factors, target = (
            context.make_array(sig.args[k])(context, builder, args[k]) for k in (0, 3, 4, 5)
        )
        here = builder.mul(args[6], ir.Constant(_I64, LANES))
        places = [builder.add(here, ir.Constant(_I64, c * WINDOW)) for c in range(3)]
        direction = [lanes.load(eye.data, place) for place in places]
        rooms = [cgutils.alloca_once_value(builder, lanes.load(target.data, place).value) for place in places]
        start = builder.gep(source.data, [builder.mul(args[1], ir.Constant(_I64, SLOT * LANES))])
        with cgutils.for_range(builder, args[2]) as loop:
            slot = builder.gep(start, [builder.mul(loop.index, ir.Constant(_I64, SLOT * LANES))])
            terms = [lanes.load(slot, ir.Constant(_I64, k * LANES)) for k in range(SLOT)]
            gate = lanes.load(factors.data, builder.mul(loop.index, ir.Constant(_I64, LANES)))
            value = _lobe(terms, direction, gate)
            for room, amplitude in zip(rooms, terms[4:], strict=True):
                builder.store(value.times_plus(amplitude, Vector(lanes, builder.load(room))).value, room)
        for room, place in zip(rooms, places, strict=True):
            lanes.store(Vector(lanes, builder.load(room)), target.data, place)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _add_along(typing_context, slots, slot, lane, x, sums):
    """Add one term, lane `lane` of slot `slot`, to the sums over all directions.

    Args:
        typing_context: The typing context of numba, unused.
        slots: (S * SLOT, LANES) float32.
        slot: Index of the slot.
        lane: Index of the lane in the slot.
        x: (3, D) float32, unit directions, D a multiple of LANES.
        sums: (3, D) float32, changed in place.
    """
    del typing_context
    signature = types.void(slots, types.int64, types.int64, x, sums)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        source, points, target = (context.make_array(sig.args[k])(context, builder, args[k]) for k in (0, 3, 4))
        place = builder.add(builder.mul(args[1], ir.Constant(_I64, SLOT * LANES)), args[2])
        rows = [builder.add(place, ir.Constant(_I64, k * LANES)) for k in range(SLOT)]
        terms = [lanes.splat(builder.load(builder.gep(source.data, [row]))) for row in rows]
        starts = [_row(builder, points, ir.Constant(_I64, c)) for c in range(3)]
        vectors = builder.sdiv(starts[1], ir.Constant(_I64, LANES))
        with cgutils.for_range(builder, vectors) as loop:
            at = builder.mul(loop.index, ir.Constant(_I64, LANES))
            places = [builder.add(start, at) for start in starts]
            value = _lobe(terms, [lanes.load(points.data, p) for p in places], 1.0)
            for p, amplitude in zip(places, terms[4:], strict=True):
                lanes.store(value.times_plus(amplitude, lanes.load(target.data, p)), target.data, p)
        return context.get_dummy_value()

    return signature, generate


@inner
def _pack_group(order, first, starts, offsets, terms, slots):
    """Pack the terms of one group; `order` is its part of the whole order, `first` the first Gaussian of its window."""
    centers, decays, amplitudes = terms
    for lane in range(len(order)):
        i = first + order[lane]
        for k in range(offsets[i + 1] - offsets[i]):
            t = offsets[i] + k
            row = (starts + k) * SLOT
            theta = np.float64(centers[t, 0])
            phi = np.float64(centers[t, 1])
            across = np.sin(theta)
            slots[row, lane] = across * np.cos(phi)
            slots[row + 1, lane] = across * np.sin(phi)
            slots[row + 2, lane] = np.cos(theta)
            slots[row + 3, lane] = -decays[t] * _HALF_LOG2E
            for c in range(3):
                slots[row + 4 + c, lane] = amplitudes[t, c]


@in_parts(lambda order, offsets, starts, *_: len(starts) - 1)
@kernel(error_model="numpy")
def pack(begin, end, order, offsets, starts, terms, slots):
    """Pack terms into slots.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        order: (N,) uint8, the Gaussians of each window by falling number of terms, from 0 in each window.
        offsets: (N + 1,) int64; the terms of Gaussian i are offsets[i]:offsets[i + 1].
        starts: (groups + 1,) int64, first slot of each group.
        terms: Centers (T, 2), decays (T,) and amplitudes (T, 3), float32.
        slots: (S * SLOT, LANES) float32, zeros; written.
    """
    for group in range(begin, end):
        own = order[group * LANES : (group + 1) * LANES]
        _pack_group(own, group // GROUPS * WINDOW, starts[group], offsets, terms, slots)


@inner
def _offsets_from_eye(means, order, eye, x):
    """Write means[order] - eye into x (3, WINDOW) float64."""
    for j in range(len(order)):
        i = order[j]
        x[0, j], x[1, j], x[2, j] = means[i, 0] - eye[0], means[i, 1] - eye[1], means[i, 2] - eye[2]


@inner(error_model="numpy")
def _to_unit(x, unit):
    """Write unit vectors along x (3, WINDOW) float64 as float32; +z for length 0, as for SH."""
    for j in range(x.shape[1]):
        square = x[0, j] * x[0, j] + x[1, j] * x[1, j] + x[2, j] * x[2, j]
        here = square == 0.0
        inverse = 1.0 / np.sqrt(1.0 if here else square)
        unit[0, j], unit[1, j], unit[2, j] = x[0, j] * inverse, x[1, j] * inverse, 1.0 if here else x[2, j] * inverse


@inner
def _open_gates(order, first, offsets, active, gates):
    """Write 1.0 for the active terms of a group and 0.0 for the others into gates."""
    for lane in range(len(order)):
        i = first + order[lane]
        for k in range(offsets[i + 1] - offsets[i]):
            gates[k, lane] = 1.0 if active[offsets[i] + k] else 0.0


@njit(cache=True)
def _put(sums, order, out):
    """Copy column j of sums (3, WINDOW) into row order[j] of out."""
    for j in range(len(order)):
        i = order[j]
        out[i, 0], out[i, 1], out[i, 2] = sums[0, j], sums[1, j], sums[2, j]


@inner
def _window_from_eye(window, means, eye, space, packed, active, out):
    """Write colors of one window into out (WINDOW or fewer, 3)."""
    order, offsets, starts, slots, base, scales = packed
    first = window * WINDOW
    own = order[first : first + WINDOW]
    x = np.ones((3, WINDOW))
    unit = np.empty((3, WINDOW), np.float32)
    _offsets_from_eye(means[first : first + WINDOW], own, eye, x)
    _to_unit(x, unit)
    sums = base[window].copy()
    top = window * GROUPS
    end = min(top + GROUPS, len(starts) - 1)
    gates = np.ones((starts[top + 1] - starts[top], LANES), np.float32)  # the first group has the most terms
    for group in range(top, end):
        if len(active):
            _open_gates(order[group * LANES : (group + 1) * LANES], first, offsets, active, gates)
        _add_group(slots, starts[group], starts[group + 1] - starts[group], unit, gates, sums, group - top)
    to_rgb(space, sums, scales[window])
    _put(sums, own, out)


@in_parts(lambda windows, *_: len(windows))
@kernel(error_model="numpy")
def colors_from_eye(begin, end, windows, means, eye, space, packed, active, out):
    """Compute colors from one eye.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        windows: (W,) int64, the windows to compute; their colors are consecutive in `out`.
        means: (N, 3) float32.
        eye: Three float64.
        space: Code of the space, from `SPACES`.
        packed: order, offsets, starts, slots as in `pack`; base (windows, 3, WINDOW) and scales (windows, WINDOW)
            float32, in the order of `order`.
        active: (T,) bool, the terms to use; (0,) for all.
        out: (at least W * WINDOW, or N, 3) float32, written.
    """
    for w in range(begin, end):
        part = out[w * WINDOW : (w + 1) * WINDOW]
        _window_from_eye(windows[w], means, eye, space, packed, active, part)


@inner
def _group_along(group, x, space, packed, out):
    """Write colors of one group along shared directions; see `colors_along`."""
    order, offsets, starts, slots, base, scales = packed
    window = group // GROUPS
    width = x.shape[1]
    sums = np.empty((3, width), np.float32)
    factors = np.empty(width, np.float32)
    for j in range(group * LANES, min((group + 1) * LANES, len(order))):
        i = window * WINDOW + order[j]
        place = j - window * WINDOW
        for c in range(3):
            sums[c] = base[window, c, place]
        factors[:] = scales[window, place]
        for k in range(offsets[i + 1] - offsets[i]):
            _add_along(slots, starts[group] + k, j - group * LANES, x, sums)
        to_rgb(space, sums, factors)
        for d in range(out.shape[1]):
            out[i, d, 0], out[i, d, 1], out[i, d, 2] = sums[0, d], sums[1, d], sums[2, d]


@in_parts(lambda x, space, packed, out: len(packed[2]) - 1)
@kernel(error_model="numpy")
def colors_along(begin, end, x, space, packed, out):
    """Compute colors along directions that all Gaussians share.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        x: (3, D) float32, unit directions, padded to a multiple of LANES.
        space: Code of the space.
        packed: Packed terms, as in `colors_from_eye`.
        out: (N, D without padding, 3) float32, written.
    """
    for group in range(begin, end):
        _group_along(np.int64(group), x, space, packed, out)
