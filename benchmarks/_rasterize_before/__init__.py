"""The forward path of the CPU rasterizer as it was at commit 70806c2. The ruler of `pvs_whole.py`.

Kernels and their order are those of that commit: tiles are shared out beforehand, blocks of Gaussians by `prange`, and
SH colors are evaluated of the splats that reach the image. Left out is what does not draw: gradients, torch tensors,
checks of arguments. So the ruler is no slower than `rasterize` was. Vector instructions come from
`gsvis._kernels.simd`, which has changed since then in nothing but its comments.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

from . import colors, tiles
from . import project as projection

__all__ = ["rasterize_before"]

_BLOCK = 2048

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


class _View(NamedTuple):
    """One camera: its (4, 4) pose, fx, fy, cx, cy, and its pixels across and down."""

    viewmat: F64
    intrinsics: tuple[float, float, float, float]
    width: int
    height: int

    @property
    def eye(self) -> F64:
        return np.asarray(-self.viewmat[:3, :3].T @ self.viewmat[:3, 3])

    @property
    def tiles(self) -> tuple[int, int]:
        return -(-self.width // tiles.TILE), -(-self.height // tiles.TILE)


class _Projected(NamedTuple):
    """The M Gaussians that reach a pixel, and the lists of the tiles: members[offsets[t]:offsets[t + 1]]."""

    ids: I32
    splats: F64
    depths: F32
    offsets: NDArray[np.int64]
    members: I32


def rasterize_before(g: Gaussians, cameras: Cameras) -> F32:
    """Return the images (C, H, W, 3) of C cameras without skew, over black, at the SH degree of the scene."""
    images = np.empty((len(cameras), cameras.height, cameras.width, 3), np.float32)
    for c in range(len(cameras)):
        k = cameras.Ks[c]
        intrinsics = float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
        viewmat = np.ascontiguousarray(cameras.viewmats[c], np.float64)
        images[c] = _draw(g, _View(viewmat, intrinsics, cameras.width, cameras.height))
    return images


def _draw(g: Gaussians, view: _View) -> F32:
    projected = _project(g, view)
    features = np.empty((len(projected.ids), 4), np.float32)
    features[:, 3] = projected.depths
    colors.colors_from_sh(projected.ids, g.means, g.sh0, g.shN, g.sh_degree, view.eye, np.float32(0.0), features)
    shape = (view.height, view.width)
    image = np.empty((*shape, 3), np.float32)
    planes = tuple(np.empty(shape, np.float32) for _ in range(4))
    background = np.zeros(3, np.float32)
    lists = projected.offsets, projected.members
    tiles.blend_tiles(projected.splats, features, *lists, view.tiles[0], background, image, *planes)
    return image


def _project(g: Gaussians, view: _View) -> _Projected:
    """Project, sort by depth and cut into tiles."""
    n = len(g.means)
    counts = np.zeros(-(-n // _BLOCK), np.int64)
    ids, splats, depths = np.empty(n, np.int32), np.empty((n, 8)), np.empty(n, np.float32)
    projection.project(
        g.means, g.quats, g.scales, g.opacities, view.viewmat, view.intrinsics, view.width, view.height, False,
        ids, splats, depths, counts,
    )  # fmt: skip
    starts = np.concatenate([[0], np.cumsum(counts)])
    m = int(starts[-1])
    packed = np.empty(m, np.int32), np.empty((m, 8)), np.empty(m, np.float32)
    projection.gather_blocks(counts, starts, ids, splats, depths, *packed)
    ids, splats, depths = packed
    order = np.argsort(depths).astype(np.int32)
    content = g.means, g.scales, g.quats, g.opacities[:, None], g.sh0[:, 0]
    tiles.order_ties(order, depths[order], ids, *content)
    tiles_x, tiles_y = view.tiles
    room = np.empty(m, np.int64)
    tiles.count_candidates(splats, tiles_x, tiles_y, room)
    first_room = np.concatenate([[0], np.cumsum(room[order])])
    met, counts = np.empty(int(first_room[-1]), np.int32), np.empty(m, np.int32)
    histogram = np.zeros((get_num_threads(), tiles_x * tiles_y), np.int32)
    tiles.meet_tiles(splats, order, first_room, tiles_x, tiles_y, met, counts, histogram)
    offsets = np.empty(tiles_x * tiles_y + 1, np.int64)
    tiles.place_chunks(histogram, offsets)
    first_pair = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    members, pair_of = np.empty(int(offsets[-1]), np.int32), np.empty(0, np.int32)
    tiles.fill_tiles(order, first_room, met, counts, first_pair, histogram, members, pair_of)
    return _Projected(ids, splats, depths, offsets, members)
