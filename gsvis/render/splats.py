"""The splats of one view: projection, sorting, tiles and blending of features, one camera at a time, without torch.

Conventions: docs/conventions.md. Results depend neither on the order of the Gaussians in the scene nor on the number of
threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from gsvis import _check
from gsvis.color.sh import write_sh_colors
from gsvis.render._kernels import lists as _lists
from gsvis.render._kernels import order as _kernels_order
from gsvis.render._kernels import project as _kernels_project
from gsvis.render._kernels import tiles as _kernels_tiles
from gsvis.render._kernels.lanes import TILE
from gsvis.scene.cameras import Cameras
from gsvis.scene.lengths import length_factor

__all__ = [
    "Projected",
    "View",
    "blend",
    "check_no_skew",
    "color_splats",
    "draw",
    "in_usual_units",
    "project",
    "project_splats",
]

_BLOCK = 2048  # splats of a chunk at least
_CHUNKS = 4  # chunks of the depth order for each thread
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class View:
    """One camera, for the kernels.

    Attributes:
        viewmat: (4, 4) float64, camera from world.
        intrinsics: (fx, fy, cx, cy) in pixels.
        width: Pixels.
        height: Pixels.
    """

    viewmat: F64
    intrinsics: tuple[float, float, float, float]
    width: int
    height: int

    @classmethod
    def from_matrices(cls, viewmat: F64, K: F64, width: int, height: int) -> View:  # noqa: N803
        """Return the view of a (4, 4) pose and (3, 3) intrinsics; callers check that there is no skew."""
        fx = float(K[0, 0])
        fy = float(K[1, 1])
        cx = float(K[0, 2])
        cy = float(K[1, 2])
        return cls(np.ascontiguousarray(viewmat, np.float64), (fx, fy, cx, cy), width, height)

    @property
    def eye(self) -> F64:
        """(3,) viewpoint, world frame."""
        return np.asarray(-self.viewmat[:3, :3].T @ self.viewmat[:3, 3])

    @property
    def tiles(self) -> tuple[int, int]:
        """Number of tiles across and down."""
        return -(-self.width // TILE), -(-self.height // TILE)


@dataclass(frozen=True, eq=False)
class Projected:
    """The M Gaussians that reach a pixel of one view, and the tiles' lists of them.

    Attributes:
        ids: (M,) int32, the Gaussian of each splat.
        splats: (M, 8) float64; see `_kernels_project`.
        depths: (M,) float32, camera z.
        order: (M,) int32 splats, front to back.
        offsets: (tiles + 1,) int64; tile t owns members[offsets[t]:offsets[t + 1]].
        members: (P,) int32 splats, front to back.
        pair_of: (P,) int32 number of each pair, along `order`; empty if `project` was called without `pairs`.
        first_pair: (M + 1,) int64; splat order[k] owns pairs first_pair[k]:first_pair[k + 1].
    """

    ids: I32
    splats: F64
    depths: F32
    order: I32
    offsets: NDArray[np.int64]
    members: I32
    pair_of: I32
    first_pair: NDArray[np.int64]


def check_no_skew(cameras: Cameras) -> None:
    """Raise an error if a camera has skew.

    Raises:
        ValueError: If one has.
    """
    if np.abs(cameras.Ks[:, 0, 1]).max(initial=0.0) > 0.0:
        raise ValueError("cameras: expected Ks without skew (Ks[:, 0, 1] == 0); undistort the images first")


def project(scene: Any, view: View, *, antialiased: bool, pairs: bool, shown: Mask | None = None) -> Projected:
    """Project Gaussians, sort them by depth and list them by tile.

    Args:
        scene: Object with arrays means, quats, scales, opacities, and sh0; the last helps to order equal depths.
        view: The camera.
        antialiased: Lower opacities so that the dilation keeps their integral.
        pairs: Number the (tile, splat) pairs, as gradients and weights need.
        shown: (S,) which of the first S Gaussians are drawn; all others are. None draws all.
    """
    ids, splats, depths = project_splats(scene, view, antialiased=antialiased, shown=shown)
    order = _sort_splats(scene, ids, depths)
    return Projected(ids, splats, depths, order, *_list_tiles(splats, order, view, pairs=pairs))


def project_splats(scene: Any, view: View, *, antialiased: bool, shown: Mask | None = None) -> tuple[I32, F64, F32]:
    """Return the Gaussians (M,) that reach a pixel, their splats (M, 8) and depths (M,), in the order of the scene.

    Args:
        scene: Object with arrays means, quats, scales and opacities.
        view: The camera.
        antialiased: Lower opacities so that the dilation keeps their integral.
        shown: (S,) which of the first S Gaussians are drawn; all others are. None draws all.
    """
    n = len(scene.means)
    counts = np.zeros(-(-n // _kernels_project.BLOCK), np.int64)
    found = np.empty(n, np.int32)
    factor = length_factor(scene.means)
    means, scales, viewmat = in_usual_units(scene, view, factor)
    some = np.zeros(0, bool) if shown is None else shown
    arrays = _check.read_only(means, scene.quats, scales, scene.opacities, some)
    camera = viewmat, view.intrinsics, view.width, view.height
    _kernels_project.find_candidates(arrays, *camera, found, counts)
    places = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=places[1:])
    ids = np.empty(places[-1], np.int32)
    splats = _cache_lines(places[-1])
    depths = np.empty(places[-1], np.float32)
    _kernels_project.project(arrays, *camera, antialiased, found, places, ids, splats, depths, counts)
    m = _kernels_project.close_gaps(places, counts, ids, splats, depths)
    ids = ids[:m]
    splats = splats[:m]
    depths = depths[:m]
    if factor != 1.0:
        depths /= np.float32(factor)
    return ids, splats, depths


def _cache_lines(count: int) -> F64:
    """Return `count` rows of eight float64, one cache line each."""
    room = np.empty(8 * count + 8)
    first = -room.ctypes.data % 64 // 8
    return room[first : first + 8 * count].reshape(count, 8)


def in_usual_units(scene: Any, view: View, factor: float) -> tuple[Any, Any, F64]:
    """Return means (N, 3), scales (N, 3) and the (4, 4) pose, scaled by a power of two."""
    if factor == 1.0:
        return scene.means, scene.scales, view.viewmat
    pose = view.viewmat.copy()
    pose[:3, 3] *= factor
    return scene.means * np.float32(factor), scene.scales * np.float32(factor), pose


def _sort_splats(scene: Any, ids: I32, depths: F32) -> I32:
    """Return the M splats front to back; equal depths by content, equal content by id."""
    m = len(ids)
    bits = depths.view(np.uint32)  # positive numbers are ordered like their bits
    least = bits.min(initial=np.iinfo(np.uint32).max)
    width = int(bits.max(initial=least) - least).bit_length()
    passes = -(-width // _kernels_order.DIGIT)
    keys = np.empty(m, np.uint64)
    moved = np.empty(m, np.uint64)
    order = np.empty(m, np.int32)
    _kernels_order.join_keys(bits, least, keys)
    for k in range(passes):
        first = width * k // passes
        last = width * (k + 1) // passes
        counts = np.zeros((-(-m // _kernels_order.BLOCK), 1 << (last - first)), np.int32)
        shift = np.uint64(32 + first)
        _kernels_order.count_digits(keys, shift, counts)
        _kernels_order.place_blocks(counts, np.empty(counts.shape[1], np.int64))
        _kernels_order.move_keys(keys, shift, counts, moved)
        keys, moved = moved, keys
    content = scene.means, scene.scales, scene.quats, scene.opacities[:, None], scene.sh0[:, 0]
    _kernels_order.order_ties(keys, ids, *_check.read_only(*content), order)
    return order


def _list_tiles(splats: F64, order: I32, view: View, *, pairs: bool) -> tuple[I64, I32, I32, I64]:
    """Return offsets, members, pair_of and first_pair of `Projected`."""
    m = len(splats)
    tiles_x, tiles_y = view.tiles
    boxes = np.zeros(-(-m // _lists.BLOCK), np.int64)
    _lists.count_boxes(splats, tiles_x, tiles_y, boxes)
    starts = np.empty(-(-m // _lists.PART), np.int64)
    met = np.empty(boxes.sum() + _lists.SURPLUS * len(starts), np.int32)
    spans = np.empty(m, np.int32)
    chunks = max(1, min(_CHUNKS * get_num_threads(), m // _BLOCK))
    places = np.zeros((chunks, tiles_x * tiles_y), np.int32)
    sums = np.zeros(chunks, np.int64)
    _lists.meet_tiles(order, splats, tiles_x, tiles_y, np.zeros(1, np.int64), met, starts, spans, places, sums)
    offsets = np.zeros(tiles_x * tiles_y + 1, np.int64)
    _kernels_order.place_blocks(places, offsets[1:])
    members = np.empty(int(offsets[-1]), np.int32)
    pair_of = np.empty(len(members) if pairs else 0, np.int32)
    first_pair = np.empty(m + 1, np.int64)
    first_pair[m] = len(members)
    _lists.fill_tiles(order, starts, spans, met, places, np.cumsum(sums) - sums, members, pair_of, first_pair)
    return offsets, members, pair_of, first_pair


def blend(
    projected: Projected, view: View, features: F32, background: F32, tiles: tuple[I64, I32] | None = None
) -> tuple[F32, F32, F32, F32, F32]:
    """Blend features front to back.

    Args:
        projected: The M splats of the view.
        view: The camera.
        features: (M, 4) features of each splat: three channels to blend over the background, and a depth.
        background: (3,) behind everything.
        tiles: Offsets and members that replace those of `projected`, to show only some splats.

    Returns:
        image (H, W, 3), transmittance, expected depth, median depth and depth at the end of each ray, all (H, W).
    """
    shape = (view.height, view.width)
    image = np.empty((*shape, 3), np.float32)
    planes = tuple(np.empty(shape, np.float32) for _ in range(4))
    offsets, members = (projected.offsets, projected.members) if tiles is None else tiles
    _kernels_tiles.blend_tiles(projected.splats, features, offsets, members, view.tiles[0], background, image, *planes)
    return image, planes[0], planes[1], planes[2], planes[3]


def color_splats(scene: Any, projected: Projected, view: View, sh_degree: int, colors: F32 | None) -> F32:
    """Return the (M, 4) features of splats that `blend` draws: their colors and depths.

    Args:
        scene: Object with arrays means, sh0 and shN.
        projected: The M splats of the view.
        view: The camera.
        sh_degree: Degree to evaluate, at most that of the scene.
        colors: (N, 3) RGB instead of SH.
    """
    features = np.empty((len(projected.ids), 4), np.float32)
    features[:, 3] = projected.depths
    if colors is None:
        write_sh_colors(projected.ids, (scene.means, scene.sh0, scene.shN), sh_degree, view.eye, features)
    else:
        features[:, :3] = colors[projected.ids]
    return features


def draw(
    scene: Any, view: View, *, background: F32, sh_degree: int, antialiased: bool = False, colors: F32 | None = None
) -> tuple[F32, F32, F32, F32]:
    """Render one view, without gradients.

    Args:
        scene: Object with arrays means, quats, scales, opacities, sh0 and shN.
        view: The camera.
        background: (3,) RGB behind everything.
        sh_degree: Degree to evaluate, at most that of the scene.
        antialiased: Lower opacities so that the dilation keeps their integral.
        colors: (N, 3) RGB instead of SH.

    Returns:
        image (H, W, 3), alpha (H, W), expected depth (H, W), median depth (H, W).
    """
    projected = project(scene, view, antialiased=antialiased, pairs=False)
    features = color_splats(scene, projected, view, sh_degree, colors)
    image, transmittance, depth, median, _ = blend(projected, view, features, background)
    return image, np.float32(1.0) - transmittance, depth, median
