"""Splats of a view: front to back, ties by content and id; the lists of tiles; any number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from gsvis import _check
from gsvis.render import GaussianTensors, rasterize, view_weights
from gsvis.render._kernels import order as _kernels_order
from gsvis.render._kernels.lanes import TILE
from gsvis.render.reference import project_reference
from gsvis.render.splats import Projected, View, project
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

KINDS = ("apart", "planes", "wall", "copies", "wide")
AHEAD = Cameras(np.eye(4)[None], [[[30, 0, 24], [0, 30, 16], [0, 0, 1]]], 48, 32)


def crowd(kind: str, n: int = 20_000) -> Gaussians:
    """Gaussians ahead of `AHEAD`, more than fit one block, whose depths are what `kind` says."""
    rng = np.random.default_rng(KINDS.index(kind))
    z = rng.uniform(1.0, 9.0, n)
    if kind == "planes":  # runs of 20: short ones; x and y are on a grid too
        z = np.sort(np.floor(z * n / 160) * 160 / n)
    elif kind == "wall":  # one run over all blocks
        z = np.full(n, 2.0)
    elif kind == "wide":  # all bits of the depths
        z = np.exp2(rng.uniform(-6.0, 120.0, n))
    means = np.stack([rng.integers(-9, 10, n) / 16 * z, rng.integers(-9, 10, n) / 16 * z, z], axis=1)
    scales = np.where(rng.random((n, 1)) < 0.1, 0.05, 0.01) * z[:, None] * rng.uniform(0.5, 1.0, (n, 3))
    g = Gaussians(means, rng.normal(size=(n, 4)), scales, rng.uniform(0.1, 0.9, n), rng.normal(size=(n, 1, 3)))
    return g[rng.integers(0, n // 3, n)] if kind == "copies" else g


def ahead() -> View:
    return View.from_matrices(AHEAD.viewmats[0], AHEAD.Ks[0], AHEAD.width, AHEAD.height)


def projected(g: Gaussians) -> Projected:
    return project(g, ahead(), antialiased=False, pairs=True)


@pytest.fixture
def one_thread() -> Iterator[None]:
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)


@pytest.mark.parametrize("kind", KINDS)
def test_order_is_by_depth_then_content_then_id(kind: str) -> None:
    g = crowd(kind, 40_000 if kind == "wide" else 20_000)  # the near half of a wide one lies before the near plane
    p = projected(g)
    assert len(p.ids) > 2 * _kernels_order.BLOCK
    assert (np.diff(p.ids) > 0).all()
    content = np.concatenate([g.means, g.scales, g.quats, g.opacities[:, None], g.sh0[:, 0]], axis=1)[p.ids]
    keys = [p.depths, *content.T]
    assert (p.order == np.lexsort([np.arange(len(p.ids)), *reversed(keys)])).all()


@pytest.mark.parametrize("kind", ["apart", "planes", "copies"])
def test_lists_of_tiles_hold_every_pair_once_front_to_back(kind: str) -> None:
    p = projected(crowd(kind))
    rank = np.empty(len(p.order), np.int64)
    rank[p.order] = np.arange(len(p.order))
    tile_of = np.repeat(np.arange(len(p.offsets) - 1), np.diff(p.offsets))
    assert (np.lexsort([rank[p.members], tile_of]) == np.arange(len(p.members))).all()
    assert p.first_pair[0] == 0
    assert p.first_pair[-1] == len(p.members) == p.offsets[-1]
    assert (np.sort(p.pair_of) == np.arange(len(p.members))).all()
    assert (np.searchsorted(p.first_pair, p.pair_of, side="right") - 1 == rank[p.members]).all()
    by_pair = np.empty(len(p.members), np.int64)
    by_pair[p.pair_of] = tile_of
    same_splat = np.diff(np.repeat(np.arange(len(p.order)), np.diff(p.first_pair))) == 0
    assert (np.diff(by_pair)[same_splat] > 0).all()


@pytest.mark.parametrize("kind", ["apart", "wide"])
def test_lists_of_tiles_hold_all_splats_that_reach_a_pixel(kind: str) -> None:
    p, view, side = projected(crowd(kind)), ahead(), TILE
    some = np.random.default_rng(0).choice(len(p.ids), 500, replace=False)
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    for m in some:
        u, v, a, b, c, top = p.splats[m, :6]
        seen = top + a * (x - u) ** 2 + b * (x - u) * (y - v) + c * (y - v) ** 2 >= -np.log2(255.0)
        tiles = np.unique((y[seen] // side).astype(int) * view.tiles[0] + (x[seen] // side).astype(int))
        listed = [t for t in range(len(p.offsets) - 1) if m in p.members[p.offsets[t] : p.offsets[t + 1]]]
        assert set(tiles) <= set(listed)


@pytest.mark.parametrize("antialiased", [False, True])
def test_splats_are_those_of_the_slow_projection(antialiased: bool) -> None:
    g = crowd("apart", 3_000)
    rng = np.random.default_rng(3)
    g = replace(g, opacities=np.exp2(rng.uniform(-8.5, 0.0, len(g))).astype(np.float32))  # some below 1/255
    p = project(g, ahead(), antialiased=antialiased, pairs=False)
    slow = project_reference(g, ahead(), antialiased=antialiased)
    known = {int(i): k for k, i in enumerate(slow.ids)}
    assert 0 < len(p.ids) < len(g)
    rows = [known[int(i)] for i in p.ids]
    np.testing.assert_allclose(p.splats[:, :2], slow.means2d[rows], rtol=1e-12, atol=1e-9)
    conics = p.splats[:, 2:5] * (-2.0, -1.0, -2.0) / np.log2(np.e)  # log2 alpha has half the conic's squares
    np.testing.assert_allclose(conics, slow.conics[rows], rtol=1e-5, atol=1e-6)  # float32 rotations
    np.testing.assert_allclose(np.exp2(p.splats[:, 5]), slow.opacities[rows], rtol=1e-5 if antialiased else 1e-13)


def test_what_is_not_shown_is_not_projected() -> None:
    g = crowd("apart")
    shown = np.random.default_rng(4).random(len(g) - 500) < 0.3  # the last 500 are always drawn
    p = project(g, ahead(), antialiased=False, pairs=True, shown=shown)
    everything = projected(g)
    drawn = np.append(shown, np.ones(500, bool))[everything.ids]
    assert 0 < drawn.sum() < len(drawn)
    assert (p.ids == everything.ids[drawn]).all()
    assert p.splats.tobytes() == everything.splats[drawn].tobytes()


def everything(g: Gaussians) -> list[bytes]:
    """All that the room computes from splats, as bytes."""
    drawn, weights = rasterize(g, AHEAD), view_weights(g, AHEAD)
    tensors = GaussianTensors.from_gaussians(g, requires_grad=True)
    by_tensors = rasterize(tensors, AHEAD, backend="cpu")
    torch.autograd.backward(by_tensors.images.square().sum())
    gradients = [t.grad for t in (*vars(tensors).values(), by_tensors.means2d) if isinstance(t.grad, torch.Tensor)]
    arrays = [*vars(projected(g)).values(), *vars(drawn).values(), weights.largest, weights.summed]
    return [a.tobytes() for a in arrays] + [t.numpy().tobytes() for t in gradients]


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_do_not_depend_on_threads(kind: str, one_thread: None) -> None:
    g = crowd(kind)
    alone = everything(g)
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert everything(g) == alone


@pytest.mark.parametrize("kind", ["planes", "wall", "copies"])
def test_images_do_not_depend_on_the_order_of_the_scene(kind: str) -> None:
    g = crowd(kind)
    shuffled = g[np.random.default_rng(1).permutation(len(g))]
    assert rasterize(shuffled, AHEAD).images.tobytes() == rasterize(g, AHEAD).images.tobytes()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_splats(n: int) -> None:
    p = projected(crowd("wall")[:n])
    assert p.order.tolist() in ([], [0], [0, 1], [1, 0])
    assert len(p.order) == len(p.ids) == n
    assert p.first_pair.shape == (n + 1,)


def test_long_and_short_runs_sort_alike() -> None:
    rng = np.random.default_rng(0)
    n = 3 * _kernels_order.BLOCK
    lengths = rng.choice([1, 2, 3, _kernels_order._SHORT, _kernels_order._SHORT + 1, 700], n)
    depths = np.repeat(np.arange(n), lengths)[:n].astype(np.uint64)
    content = [rng.integers(0, 3, (n, k)).astype(np.float32) for k in (3, 3, 4, 1, 3)]
    order, ids = np.empty(n, np.int32), np.arange(n, dtype=np.int32)
    keys = (depths << np.uint64(32)) | ids.astype(np.uint64)
    _kernels_order.order_ties(keys, ids, *_check.read_only(*content), order)
    columns = np.concatenate(content, axis=1).T
    assert (order == np.lexsort([ids, *reversed(columns), depths])).all()


PROJECTED = """
import hashlib
import numpy as np
from gsvis.render.splats import View, project_splats
from gsvis.scene.gaussians import Gaussians

rng = np.random.default_rng(0)
sizes = 0.3 * rng.random((3000, 3)) ** 4 + 1e-3
g = Gaussians(rng.normal(size=(3000, 3)), rng.normal(size=(3000, 4)), sizes, rng.random(3000), np.zeros((3000, 1, 3)))
pose = np.eye(4)
pose[2, 3] = 4.0
found = project_splats(g, View(pose, (50.0, 51.0, 32.0, 24.0), 64, 48), antialiased=True)
assert len(found[0]) > 1000
print(hashlib.sha256(b"".join(each.tobytes() for each in found)).hexdigest())
"""


def test_kernels_from_the_cache_project_as_those_just_compiled(tmp_path: Path) -> None:
    """A function that others call may be fused with them in one case and not in the other."""
    place = tmp_path / "kernels"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(place), "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", PROJECTED]

    def project_anew() -> tuple[str, dict[Path, int]]:
        bits = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        return bits, {path: path.stat().st_mtime_ns for path in place.rglob("*.nbi")}

    compiled, kept = project_anew()
    assert kept
    assert project_anew() == (compiled, kept)  # nothing was compiled again
