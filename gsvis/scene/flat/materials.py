"""Paint surfaces: wood, tiles, wallpaper, cloth, stone. Every function returns a `Look`; colors are sRGB in [0, 1]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flat.charts import Look
from gsvis.scene.flat.noise import chance, grain

__all__ = [
    "carpet",
    "checkered",
    "cloth",
    "leaves",
    "marble",
    "planks",
    "plaster",
    "rug",
    "stripes",
    "tiles",
    "wood",
]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]


def tinted(color: Triple, factor: F64) -> F64:
    """Return (..., 3) a color times a factor for each point, in [0, 1]."""
    return np.clip(np.array(color) * factor[..., None], 0.0, 1.0)


def mixed(first: Triple | F64, second: Triple | F64, share: F64) -> F64:
    """Return (..., 3) a mixture of two colors; `share` is that of the second."""
    part = share[..., None]
    return np.asarray(np.asarray(first) * (1.0 - part) + np.asarray(second) * part)


def planks(color: Triple, width: float = 0.16, length: float = 1.5, gloss: float = 0.045, seed: int = 1) -> Look:
    """Return floor boards along u."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        row = np.floor(v / width)
        shifted = u / length + 7.3 * chance(row, seed)
        board = np.floor(shifted)
        tone = chance(row, board, seed)
        veins = grain(0.13 * u + tone, 1.9 * v + 3.1 * tone)
        rings = np.sin(55.0 * (v + 0.06 * grain(0.05 * u + tone, 0.3 * v + tone)) + 40.0 * tone)
        factor = 0.84 + 0.30 * tone + 0.05 * veins + 0.035 * rings
        edge = np.minimum(v / width - row, 1.0 + row - v / width) * width
        end = np.minimum(shifted - board, 1.0 + board - shifted) * length
        joint = (edge < 0.005) | (end < 0.005)
        warm = mixed(color, (color[0], 0.93 * color[1], 0.82 * color[2]), chance(row, board, seed + 1))
        return np.asarray(np.clip(warm * np.where(joint, 0.45, factor)[..., None], 0.0, 1.0))

    return Look(paint, gloss=gloss, texel=0.011)


def wood(color: Triple, gloss: float = 0.04, texel: float = 0.01, seed: int = 1) -> Look:
    """Return wood in one piece, its veins along u."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        bent = v + 0.03 * grain(0.12 * u + 0.17 * seed, 0.2 * v)
        factor = 0.97 + 0.06 * grain(0.16 * u, 1.7 * bent + 0.37 * seed) + 0.05 * np.sin(70.0 * bent + seed)
        return tinted(color, factor)

    return Look(paint, gloss=gloss, texel=texel)


def plaster(color: Triple, gloss: float = 0.0) -> Look:
    """Return a painted wall with faint marks of the roller."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        return tinted(color, 1.0 + 0.008 * grain(0.31 * u, 0.31 * v) + 0.006 * grain(0.05 * u + 0.4, 0.05 * v))

    return Look(paint, gloss=gloss, texel=0.02)


def tiles(
    color: Triple,
    joint: Triple,
    size: tuple[float, float] = (0.2, 0.2),
    *,
    bond: float = 0.0,
    vary: float = 0.06,
    gloss: float = 0.06,
) -> Look:
    """Return tiles with joints; `bond` shifts every second row, in widths of a tile."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        row = np.floor(v / size[1])
        along = u / size[0] + bond * (row % 2.0)
        column = np.floor(along)
        edge_u = np.minimum(along - column, 1.0 + column - along) * size[0]
        edge_v = np.minimum(v / size[1] - row, 1.0 + row - v / size[1]) * size[1]
        tone = 1.0 + vary * (2.0 * chance(row, column, 5) - 1.0) + 0.012 * grain(0.9 * u, 0.9 * v)
        joints = np.minimum(edge_u, edge_v) < 0.0045
        return np.asarray(np.where(joints[..., None], np.array(joint), tinted(color, tone)))

    return Look(paint, gloss=gloss, texel=0.009)


def checkered(light: Triple, dark: Triple, size: float = 0.4, gloss: float = 0.07) -> Look:
    """Return stone slabs of two alternating colors."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        row = np.floor(v / size)
        column = np.floor(u / size)
        veins = np.abs(grain(0.22 * u + chance(row, column), 0.22 * v))
        factor = 1.0 + 0.05 * (chance(row, column, 3) - 0.5) - 0.05 * np.exp(-8.0 * veins)
        both = np.where(((row + column) % 2.0 < 1.0)[..., None], np.array(light), np.array(dark))
        inside = np.minimum.reduce([u / size - column, 1.0 + column - u / size, v / size - row, 1.0 + row - v / size])
        return np.asarray(np.clip(both * np.where(inside * size < 0.004, 0.7, factor)[..., None], 0.0, 1.0))

    return Look(paint, gloss=gloss, texel=0.011)


def marble(color: Triple, vein: Triple, gloss: float = 0.06) -> Look:
    """Return polished stone with veins."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        bent = 0.4 * u + 0.25 * v + 0.10 * grain(0.2 * u, 0.2 * v)
        share = np.exp(-14.0 * np.abs(np.sin(9.0 * bent))) * (0.4 + 0.3 * np.tanh(grain(0.1 * u + 0.3, 0.1 * v)))
        return np.asarray(np.clip(mixed(color, vein, share) + 0.015 * grain(1.1 * u, 1.1 * v)[..., None], 0.0, 1.0))

    return Look(paint, gloss=gloss, texel=0.01)


def cloth(color: Triple, weave: float = 0.05, texel: float = 0.016, seed: int = 1) -> Look:
    """Return woven cloth with soft folds."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        threads = grain(2.3 * u + 0.1 * seed, 0.9 * v) + grain(0.9 * u, 2.3 * v + 0.1 * seed)
        soft = grain(0.21 * u + 0.3 * seed, 0.21 * v)
        return tinted(color, 1.0 + weave * (0.45 * threads + 0.6 * soft))

    return Look(paint, texel=texel)


def stripes(colors: tuple[Triple, ...], widths: tuple[float, ...], texel: float = 0.01) -> Look:
    """Return stripes along u that repeat; `widths` are meters across."""
    ends = np.cumsum(widths)

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        which = np.searchsorted(ends, v % ends[-1], side="right").clip(0, len(colors) - 1)
        fibers = 1.0 + 0.04 * grain(1.7 * u, 1.7 * v)
        return np.asarray(np.clip(np.array(colors)[which] * fibers[..., None], 0.0, 1.0))

    return Look(paint, texel=texel)


def carpet(color: Triple) -> Look:
    """Return a soft carpet from wall to wall."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        factor = 1.0 + 0.05 * grain(1.3 * u, 1.3 * v) + 0.05 * grain(0.15 * u, 0.15 * v)
        return tinted(color, factor)

    return Look(paint, texel=0.014)


def rug(size: tuple[float, float], ground: Triple, band: Triple, light: Triple, seed: int = 1) -> Look:
    """Return a knotted rug: borders, a medallion, and flowers on a grid that is mirrored twice."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        x = np.abs(u - 0.5 * size[0])
        y = np.abs(v - 0.5 * size[1])
        rim = np.minimum(0.5 * size[0] - x, 0.5 * size[1] - y)
        color = np.broadcast_to(np.array(ground), (*u.shape, 3)).copy()
        _flowers(color, x, y, 0.30, (light, band), seed)
        star = x / (0.36 * size[0]) + y / (0.36 * size[1]) + 0.05 * np.cos(28.0 * np.arctan2(y, x))
        for reach, tone in ((1.0, band), (0.9, light), (0.84, band), (0.55, ground), (0.47, light), (0.38, band)):
            color[star < reach] = tone
        _flowers(color, x, y, 0.22, (ground, light), seed + 3, (star > 0.58) & (star < 0.82))
        for reach, tone in ((0.27, light), (0.25, band), (0.08, light), (0.06, ground)):
            color[rim < reach] = tone
        _flowers(color, x, y, 0.17, (light, ground), seed + 5, (rim > 0.09) & (rim < 0.24))
        worn = 1.0 + 0.06 * grain(1.5 * u, 1.5 * v) + 0.05 * grain(0.2 * u, 0.2 * v)
        return np.asarray(np.clip(color * worn[..., None], 0.0, 1.0))

    return Look(paint, texel=0.012, detail=0.9)


def _flowers(
    color: F64,
    x: F64,
    y: F64,
    pitch: float,
    tones: tuple[Triple, Triple],
    seed: int,
    where: NDArray[np.bool_] | None = None,
) -> None:
    """Paint a flower into every field of a grid, over `color` (..., 3), where `where` is true."""
    column = np.floor(x / pitch)
    row = np.floor(y / pitch)
    dx = x / pitch - column - 0.5
    dy = y / pitch - row - 0.5
    angle = np.arctan2(dy, dx)
    radius = np.hypot(dx, dy)
    petals = np.floor(4.0 + 4.0 * chance(column, row, seed))
    outline = (0.25 + 0.10 * np.cos(petals * angle)) * (0.7 + 0.6 * chance(column, row, seed + 1))
    allowed = np.ones(x.shape, bool) if where is None else where
    color[allowed & (radius < outline)] = tones[0]
    color[allowed & (radius < 0.35 * outline)] = tones[1]


def leaves(ground: Triple, leaf: Triple, bloom: Triple, pitch: float = 0.32) -> Look:
    """Return wallpaper with sprigs: pairs of leaves on stems, every second one with a bloom."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        column = np.floor(u / pitch)
        shifted = v / pitch + 0.5 * (column % 2.0)
        row = np.floor(shifted)
        dx = u / pitch - column - 0.5
        dy = shifted - row - 0.5
        dx = dx + 0.08 * np.sin(6.0 * dy)
        color = np.broadcast_to(np.array(ground), (*u.shape, 3)).copy()
        color *= (1.0 + 0.012 * grain(0.5 * u, 0.5 * v))[..., None]
        color[(np.abs(dx) < 0.014) & (np.abs(dy) < 0.40)] = leaf
        for height, length in ((-0.25, 0.30), (-0.05, 0.26), (0.13, 0.20)):
            for hand in (-1.0, 1.0):
                along = hand * dx * 0.8 + (dy - height) * 0.6
                across = -hand * dx * 0.6 + (dy - height) * 0.8
                inside = (along > 0.0) & (along < length)
                wide = 0.055 * np.sin(np.pi * np.clip(along / length, 0.0, 1.0))
                color[inside & (np.abs(across) < wide)] = leaf
        flower = np.hypot(dx, dy - 0.36) < 0.075
        color[flower & ((row + column) % 2.0 < 1.0)] = bloom
        return np.asarray(color)

    return Look(paint, texel=0.012, detail=0.8)
