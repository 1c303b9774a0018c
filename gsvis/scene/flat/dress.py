"""Convert pieces to flat Gaussians of the same size, with view-dependent colors.

As in trained scenes, a layer of large pieces lies behind the fine ones and stops the light that passes between them.
Reflections of glossy pieces are traced in some directions and fitted with spherical harmonics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flat.charts import Chart, cross
from gsvis.scene.flat.light import Baked, across, linear, resized, sun_map
from gsvis.scene.flat.pieces import Canvas, Pieces
from gsvis.scene.gaussians import Gaussians, quats_from_rotations
from gsvis.scene.sh import SH_C0, sh_basis

__all__ = ["Batch", "finish", "gaussians_of", "paint_canvas"]

F64 = NDArray[np.float64]

EXPOSURE = 0.74
VIEWS = 22  # directions from which the gloss of a piece is traced
RIDGE = 0.4
DULL = 0.04  # gloss below which nothing is traced


@dataclass(frozen=True)
class Batch:
    """Gaussians before they become a scene.

    Args:
        means: (N, 3).
        rotations: (N, 3, 3), columns are the axes.
        scales: (N, 3).
        opacities: (N,).
        colors: (N, 3) as displayed, [0, 1].
        higher: (N, 15, 3) higher spherical harmonics.
    """

    means: F64
    rotations: F64
    scales: F64
    opacities: F64
    colors: F64
    higher: F64


def displayed(radiance: F64) -> F64:
    """Return displayed colors of linear light: exposed, rolled off at the bright end, sRGB."""
    x = np.maximum(radiance * EXPOSURE, 0.0)
    rolled = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    return np.asarray(np.clip(rolled, 0.0, 1.0) ** (1.0 / 2.2))


def exposed(color: F64) -> F64:
    """Return the linear light that a display shows as a color; the inverse of `displayed`."""
    y = np.clip(color, 0.0, 0.995) ** 2.2
    a = 2.43 * y - 2.51
    b = 0.59 * y - 0.03
    c = 0.14 * y
    return np.asarray((-b - np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a) / EXPOSURE)


def paint_canvas(chart: Chart, i: int, baked: Baked) -> Canvas:
    """Return the displayed colors of a chart.

    Args:
        chart: The chart.
        i: Index of the chart. Charts that are not lit, those outdoors, keep their colors.
        baked: All light.
    """
    columns, rows = (int(np.clip(np.ceil(side / (chart.look.texel * baked.coarseness)), 2, 900)) for side in chart.size)
    u = (np.arange(columns) + 0.5) / columns * chart.size[0]
    v = (np.arange(rows) + 0.5) / rows * chart.size[1]
    across, up = np.meshgrid(u, v)
    colors = np.asarray(chart.look.paint(across, up), np.float64)
    solid = np.ones((rows, columns), bool)
    for u0, v0, u1, v1 in chart.holes:
        solid &= ~((across > u0) & (across < u1) & (up > v0) & (up < v1))
    if i < len(baked.sunny):
        light = resized(baked.map_of(i), rows, columns)
        if baked.sunny[i]:
            light = light + resized(sun_map(baked.rays, chart, baked.sky), rows, columns)
        one = colors.strides[:2] == (0, 0)  # one color everywhere
        own = linear(colors[:1, :1]) if one else linear(colors)
        colors = displayed(own * (light + chart.look.glow))
    return Canvas(colors, solid, chart.size, chart.look.detail, chart.bend, chart.look.rim)


def gaussians_of(
    charts: Sequence[Chart], pieces: Pieces, rng: np.random.Generator, *, width: float, behind: float = 0.0
) -> Batch:
    """Return a flat Gaussian for each piece.

    Args:
        charts: All charts.
        pieces: The pieces.
        rng: Source of randomness.
        width: Standard deviation over the side of a piece.
        behind: Distance behind the surface, meters.
    """
    n = len(pieces.charts)
    middle = 0.5 * (pieces.low + pieces.high)
    sides = pieces.high - pieces.low
    middle = np.clip(middle + 0.06 * sides * rng.normal(size=(n, 2)), 0.0, 1.0)
    means, du, dv, normals = (np.zeros((n, 3)) for _ in range(4))
    for i, chosen in _by_chart(pieces):
        u, v = middle[chosen].T
        means[chosen] = charts[i].place(u, v)
        du[chosen], dv[chosen], normals[chosen] = charts[i].frame(u, v)
    length_u = np.linalg.norm(du, axis=1)
    length_v = np.linalg.norm(dv, axis=1)
    first = du / np.maximum(length_u, 1e-12)[:, None]
    second = cross(normals, first)
    turn = rng.normal(0.0, 0.05, n)[:, None]
    first, second = first * np.cos(turn) + second * np.sin(turn), second * np.cos(turn) - first * np.sin(turn)
    size = np.stack([length_u * sides[:, 0], length_v * sides[:, 1]], axis=1)
    longer = size / np.maximum(size[:, ::-1], 1e-9)
    size = size * (1.0 - 0.05 * np.clip(longer - 1.5, 0.0, 4.0))  # long ones would stick out at their ends
    wide = size * width * np.exp(rng.normal(0.0, 0.07, (n, 2)))
    thin = np.clip(0.05 * wide.min(axis=1), 0.0008, 0.01) * np.exp(rng.normal(0.0, 0.3, n))
    off = -behind + 0.0012 * rng.normal(size=n)
    return Batch(
        means + off[:, None] * normals,
        np.stack([first, second, normals], axis=-1),
        np.concatenate([wide, thin[:, None]], axis=1),
        np.clip(0.985 - 0.12 * rng.beta(1.0, 5.0, n), 0.05, 0.99),
        np.clip(pieces.colors + rng.normal(0.0, 0.006, (n, 3)), 0.0, 1.0),
        _higher(charts, pieces, rng),
    )


def add_gloss(batch: Batch, charts: Sequence[Chart], pieces: Pieces, baked: Baked) -> Batch:
    """Return the batch with the reflections of glossy pieces, in `colors` and `higher`."""
    gloss = np.array([chart.look.gloss if i < len(baked.sunny) else 0.0 for i, chart in enumerate(charts)])
    chosen = np.flatnonzero(gloss[pieces.charts] >= DULL)
    normals = batch.rotations[chosen, :, 2]
    frames = _frames()
    nearest = (normals @ frames[:, :, 2].T).argmax(axis=1)
    toward = np.einsum("fij,dj->fdi", frames, _hemisphere(VIEWS))
    cosine = np.clip(np.einsum("ni,ndi->nd", normals, toward[nearest]), 0.02, 1.0)
    mirrored = 2.0 * cosine[..., None] * normals[:, None] - toward[nearest]
    starts = np.repeat(batch.means[chosen] + 0.01 * normals, VIEWS, axis=0)
    seen = baked.look_along(starts, mirrored.reshape(-1, 3)).reshape(-1, VIEWS, 3)
    front = gloss[pieces.charts[chosen], None]
    share = (front + (1.0 - front) * 0.6 * (1.0 - cosine) ** 5)[..., None]
    base = exposed(batch.colors[chosen])[:, None]
    shown = displayed(base * (1.0 - share) + np.minimum(seen, 6.0) * share)
    mean = shown.mean(axis=1, keepdims=True)
    fitted = np.einsum("nkd,ndc->nkc", _solvers(toward)[nearest], shown - mean)
    colors = batch.colors.copy()
    higher = batch.higher.copy()
    colors[chosen] = mean[:, 0] + SH_C0 * fitted[:, 0]
    higher[chosen] += fitted[:, 1:]
    return Batch(batch.means, batch.rotations, batch.scales, batch.opacities, colors, higher)


def finish(batches: Sequence[Batch], sh_degree: int) -> Gaussians:
    """Return the scene of some batches."""
    joined = {name: np.concatenate([getattr(batch, name) for batch in batches]) for name in Batch.__annotations__}
    rotations = joined["rotations"]
    return Gaussians(
        joined["means"],
        quats_from_rotations(rotations),
        joined["scales"],
        joined["opacities"],
        ((joined["colors"] - 0.5) / SH_C0)[:, None, :],
        joined["higher"][:, : (sh_degree + 1) ** 2 - 1],
    )


def _by_chart(pieces: Pieces) -> list[tuple[int, NDArray[np.int64]]]:
    """Return the ids of the pieces of each chart."""
    order = np.argsort(pieces.charts, kind="stable")
    ids, starts = np.unique(pieces.charts[order], return_index=True)
    return list(zip(ids.tolist(), np.split(order, starts[1:]), strict=True))


def _higher(charts: Sequence[Chart], pieces: Pieces, rng: np.random.Generator) -> F64:
    """Return (n, 15, 3) small coefficients of matte pieces: noise as left by training."""
    n = len(pieces.charts)
    fall = np.repeat([1.0, 0.6, 0.4], [3, 5, 7])[:, None]
    shared = rng.normal(0.0, 0.010, (len(charts), 15, 1))[pieces.charts]
    return np.asarray(fall * (shared + rng.normal(0.0, 0.006, (n, 15, 3))))


def _hemisphere(count: int) -> F64:
    """Return directions spread over the upper half, z up."""
    i = np.arange(count)
    z = 0.06 + 0.92 * (i + 0.5) / count
    angle = i * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def _frames(count: int = 200) -> F64:
    """Return (F, 3, 3) rotations whose third columns cover the sphere, including the six axes."""
    half = _hemisphere(count // 2)
    normals = np.concatenate([np.eye(3), -np.eye(3), half, -half])
    first, second = across(normals)
    return np.stack([first, second, normals], axis=-1)


def _solvers(toward: F64) -> F64:
    """Return (F, 16, D) matrices that fit harmonics to colors seen from (F, D, 3) directions, smooth elsewhere."""
    basis = np.stack([sh_basis(-each, 3) for each in toward])
    bands = np.repeat([0.0, 1.0, 2.0, 3.0], [1, 3, 5, 7])
    penalty = np.diag(RIDGE * bands**2 * toward.shape[1] / 100.0)
    turned = np.swapaxes(basis, 1, 2)
    return np.asarray(np.linalg.solve(turned @ basis + penalty, turned), np.float64)
