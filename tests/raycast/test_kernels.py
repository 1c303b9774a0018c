"""The explicit vector code against the loop it stands for, and the hierarchy against its definition."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast._kernels.bvh import MOST_LEVELS, WIDTH, build
from gsvis.raycast._kernels.simd import EIGHT, meets_eight, peaks_of_eight
from gsvis.raycast._kernels.trace import REACH, STACK, peak_of
from tests.raycast.scenes import KINDS, scene


@njit
def eight(boxes, node, origin, inverse, t_stop, t_near):  # type: ignore[no-untyped-def]
    return meets_eight(boxes, node, origin, inverse, t_stop, t_near)


@njit
def eight_peaks(table, queue, first, origin, direction, squares, peaks):  # type: ignore[no-untyped-def]
    return peaks_of_eight(table, queue, first, origin, direction, squares, peaks)


@njit(error_model="numpy")
def one_peak(table, g, origin, direction):  # type: ignore[no-untyped-def]
    x, y, z = origin
    u, v, w = direction
    return peak_of(table, g, x, y, z, u, v, w)


def test_eight_gaussians_at_once_equal_one_after_the_other_to_the_bit() -> None:
    rng = np.random.default_rng(1)
    table = rng.normal(size=(200, 16)).astype(np.float32)
    table[:, 3:7] /= np.linalg.norm(table[:, 3:7], axis=1, keepdims=True)
    table[:, 7:10] = np.exp(table[:, 7:10])
    table[:, 13:16] *= 1e-8
    table[:, REACH] = np.exp(4.0 * table[:, REACH])
    squares = np.empty(EIGHT)
    peaks = np.empty(EIGHT)
    met_some = 0
    for first in range(0, 192, EIGHT):
        queue = rng.permutation(len(table))
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        ray = tuple(rng.normal(size=3)), tuple(direction)
        met = eight_peaks(table, queue, first, *ray, squares, peaks)
        for k in range(EIGHT):
            square, peak = one_peak(table, queue[first + k], *ray)
            assert (squares[k], peaks[k]) == (square, peak)
            assert bool(met >> k & 1) == (square <= table[queue[first + k], REACH])
        met_some += int(met).bit_count()
    assert 20 < met_some < 172


def test_eight_boxes_at_once_equal_one_box_after_the_other() -> None:
    rng = np.random.default_rng(0)
    boxes = np.sort(rng.uniform(-1, 1, (500, 2, 3, WIDTH)).astype(np.float32), axis=1).reshape(500, 6, WIDTH)
    boxes[::3, :, 5:] = np.inf  # empty children
    boxes[1::3, 3] = boxes[1::3, 0]  # flat ones
    t_near = np.empty(WIDTH)
    met_any = 0
    for node in range(len(boxes)):
        o = rng.uniform(-1.5, 1.5, 3)
        d = rng.uniform(-0.5, 0.5, 3) - o
        d[node % 3] = 0.0 if node % 5 == 0 else d[node % 3]
        inverse = 1.0 / np.where(d == 0.0, 1e-300, d)
        t_stop = np.inf if node % 2 else 1.0
        mask = eight(boxes, node, tuple(o), tuple(inverse), t_stop, t_near)
        for k in range(WIDTH):
            low, high = boxes[node, :3, k].astype(float), boxes[node, 3:, k].astype(float)
            with np.errstate(invalid="ignore", over="ignore"):
                a, b = (low - o) * inverse, (high - o) * inverse
            near, far = max(np.minimum(a, b).max(), 0.0), min(np.maximum(a, b).min(), t_stop)
            met = near <= far and near < np.inf
            assert bool(mask >> k & 1) == met
            if met:
                assert t_near[k] == near
                met_any += 1
    assert met_any > 300


@pytest.mark.parametrize("n", [0, 1, 2, 7, 8, 9, 100, 2000])
@pytest.mark.parametrize("same", [False, True])
def test_every_box_is_reached_once_through_boxes_that_hold_it(n: int, same: bool) -> None:
    rng = np.random.default_rng(n)
    low = rng.normal(size=(n, 3)).astype(np.float32)
    if same:
        low[:] = 0.25
    high = low + rng.uniform(0, 1, (n, 3)).astype(np.float32)
    order, boxes, children = build(low, high)
    assert sorted(order) == list(range(n))
    seen = []

    def walk(node: int, outer_low: np.ndarray, outer_high: np.ndarray) -> None:
        for k in range(WIDTH):
            if np.isinf(boxes[node, 0, k]):
                continue
            lo, hi = boxes[node, :3, k], boxes[node, 3:, k]
            assert (lo >= outer_low).all()
            assert (hi <= outer_high).all()
            if children[node, k] >= 0:
                walk(children[node, k], lo, hi)
            else:
                box = order[-1 - children[node, k]]
                seen.append(box)
                np.testing.assert_array_equal(low[box], lo)
                np.testing.assert_array_equal(high[box], hi)

    walk(0, np.full(3, -np.inf), np.full(3, np.inf))
    assert sorted(seen) == list(range(n))


def levels(children: np.ndarray) -> int:
    """Longest path of a hierarchy; a node comes after its parent."""
    depth = np.ones(len(children), int)
    for node, row in enumerate(children):
        inner = row[row >= 0]
        depth[inner] = depth[node] + 1
    return int(depth.max())


@pytest.mark.parametrize("ratio", [0.5, 0.9, 0.95, 0.97])
def test_no_chain_of_boxes_outgrows_the_stack(ratio: float) -> None:
    # Each axis shrinks in turn, so that the area heuristic peels off one box after the other.
    steps = ratio ** np.arange(int(80 / -np.log(ratio)))
    low = np.zeros((3 * len(steps), 3), np.float32)
    for axis in range(3):
        low[axis::3, axis] = steps
    high = (low * 1.001).astype(np.float32)
    order, _, children = build(low, high)
    assert sorted(order) == list(range(len(low)))
    assert levels(children) <= MOST_LEVELS
    assert STACK > (WIDTH - 1) * MOST_LEVELS


@pytest.mark.parametrize("kind", KINDS)
def test_boxes_hold_their_ellipsoids(kind: str) -> None:
    hierarchy = Tracer(EllipsoidProxies.from_scene(scene(kind))).hierarchy
    proxies = EllipsoidProxies.from_scene(scene(kind))
    sphere = np.random.default_rng(1).normal(size=(300, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    positions = hierarchy.positions[proxies.ids]
    for node in range(len(hierarchy.boxes)):
        for k in range(WIDTH):
            position = -1 - hierarchy.children[node, k]
            if position < 0 or np.isinf(hierarchy.boxes[node, 0, k]):
                continue
            m = int(np.flatnonzero(positions == position)[0])
            g = proxies.gaussians[int(proxies.ids[m])]
            points = g.means[0].astype(float) + (sphere * proxies.radii[m]) @ g.rotations()[0].T
            assert (points >= hierarchy.boxes[node, :3, k]).all()
            assert (points <= hierarchy.boxes[node, 3:, k]).all()
