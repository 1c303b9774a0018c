"""Scenes of every kind, z up, in meters: statues on hollow plinths, rooms, streets between facades, and more."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians

Triple = tuple[float, float, float]
Pair = tuple[float, float]


def discs(means: NDArray[np.float64], scales: Triple, opacity: float = 0.95) -> Gaussians:
    """Axis-aligned Gaussians of one shape."""
    n = len(means)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    opacities, black = np.full(n, opacity), np.zeros((n, 1, 3))
    return Gaussians(means, quats, np.tile(scales, (n, 1)), opacities, black, facts=SceneFacts(meters_per_unit=1.0))


def sheet(axis: int, at: float, low: Pair, high: Pair, step: float) -> Gaussians:
    """A rectangle of thin discs across `axis`."""
    across = [i for i in range(3) if i != axis]
    u, v = np.meshgrid(*(np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)), indexing="ij")
    means = np.full((u.size, 3), at, np.float64)
    means[:, across[0]], means[:, across[1]] = u.ravel(), v.ravel()
    scales = [0.9 * step] * 3
    scales[axis] = 0.02 * step
    return discs(means, (scales[0], scales[1], scales[2]))


def box(low: Triple, high: Triple, step: float, without: tuple[tuple[int, int], ...] = ()) -> Gaussians:
    """Six sheets, without those of `without`: pairs of an axis and 0 for its low or 1 for its high end."""
    parts = []
    for axis in range(3):
        a, b = (i for i in range(3) if i != axis)
        for end, at in enumerate((low[axis], high[axis])):
            if (axis, end) not in without:
                parts.append(sheet(axis, at, (low[a], low[b]), (high[a], high[b]), step))
    return Gaussians.concatenate(parts)


def ball(center: Triple, radius: float, count: int) -> Gaussians:
    """A closed sphere."""
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    flat = np.sqrt(1.0 - z * z)
    way = np.stack([np.cos(turn) * flat, np.sin(turn) * flat, z], axis=1)
    size = 1.5 * radius * float(np.sqrt(np.pi / count))
    return discs(np.array(center) + radius * way, (size, size, size))


def statue(bottom: bool = False) -> Gaussians:
    """Balls on a hollow plinth, with or without a bottom."""
    plinth = box((-0.5, -0.5, 0.0), (0.5, 0.5, 1.2), 0.05, () if bottom else ((2, 0),))
    balls = ball((0, 0, 1.6), 0.38, 3000), ball((0, 0, 2.2), 0.22, 1500), ball((0.4, 0, 1.9), 0.12, 700)
    return Gaussians.concatenate([plinth, *balls])


def street(behind: bool = False) -> Gaussians:
    """60 m of street, 12 wide, between towers of up to 24 m with gaps; with or without ground behind them."""
    parts = [sheet(2, 0.0, (-30, -7), (30, 7), 0.3)]
    if behind:
        parts += [sheet(2, 0.0, (-30, y), (30, y + 7.0), 0.3) for y in (-14.0, 7.0)]
    for y in (-6.0, 6.0):
        for k in range(6):
            height = 24.0 * (0.5 + 0.125 * ((7 * k + (3 if y > 0 else 0)) % 5))
            parts.append(sheet(1, y, (10.0 * k - 30.0, 0.0), (10.0 * k - 20.0 - k % 2, height), 0.3))
    rng = np.random.default_rng(0)
    parts += [ball((rng.uniform(-25, 25), rng.uniform(-5, 5), 1.0), 0.6, 300) for _ in range(8)]
    return Gaussians.concatenate(parts)


def plaza() -> Gaussians:
    """A large statue in the middle of a square between houses."""
    walls = [sheet(a, at, (-20, 0), (20, 12), 0.4) for a in (0, 1) for at in (-20.0, 20.0)]
    return Gaussians.concatenate(
        [sheet(2, 0.0, (-20, -20), (20, 20), 0.4), *walls, statue().transform(np.eye(3), scale=1.5)]
    )


def forest() -> Gaussians:
    """Trees on a piece of ground."""
    rng = np.random.default_rng(5)
    parts = [sheet(2, 0.0, (-20, -20), (20, 20), 0.3)]
    for _ in range(60):
        x, y, height = *rng.uniform(-19, 19, 2), rng.uniform(6, 10)
        trunk = np.column_stack([np.full(60, x), np.full(60, y), np.linspace(0.0, height, 60)])
        leaves = np.array([x, y, height]) + rng.normal(0.0, 1.2, (150, 3))
        parts += [discs(trunk, (0.2, 0.2, 0.2)), discs(leaves, (0.35, 0.35, 0.2), 0.6)]
    return Gaussians.concatenate(parts)


def terrain() -> Gaussians:
    """Hills seen from the air, with a few sheds."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(-50, 50, (30_000, 2))
    hills = np.column_stack([xy, 2.0 * np.sin(xy[:, 0] / 9.0) * np.cos(xy[:, 1] / 7.0)])
    corners = rng.uniform(-45, 45, (10, 2))
    sheds = [box((x - 3, y - 3, -1.0), (x + 3, y + 3, 4.0), 0.5) for x, y in corners]
    return Gaussians.concatenate([discs(hills, (0.5, 0.5, 0.05)), *sheds])


def apartment() -> Gaussians:
    """Two rooms with a door, and boxes for furniture."""
    partition = sheet(0, 4.0, (0, 0), (5, 2.7), 0.09)
    partition = partition[~((np.abs(partition.means[:, 1] - 2.5) < 0.5) & (partition.means[:, 2] < 2.1))]
    rng = np.random.default_rng(1)
    middles = rng.uniform((0.6, 0.6, 0.3), (7.4, 4.4, 0.9), (10, 3))
    furniture = [box((x - 0.35, y - 0.35, z - 0.3), (x + 0.35, y + 0.35, z + 0.3), 0.07) for x, y, z in middles]
    return Gaussians.concatenate([box((0, 0, 0), (8, 5, 2.7), 0.09), partition, *furniture])


def statue_in_room() -> Gaussians:
    """A statue on a plinth, in a room."""
    return Gaussians.concatenate([box((-4, -4, 0), (4, 4, 4), 0.12), statue()])


def cathedral() -> Gaussians:
    """A tall hall with pillars."""
    pillars = [
        box((x - 0.4, y - 0.4, 0.0), (x + 0.4, y + 0.4, 17.8), 0.25) for x in (2.5, 7.5) for y in range(4, 28, 4)
    ]
    return Gaussians.concatenate([box((0, 0, 0), (10, 30, 18), 0.3), *pillars])


def table() -> Gaussians:
    """A table with two balls on it."""
    legs = [box((x - 0.04, y - 0.04, 0), (x + 0.04, y + 0.04, 0.7), 0.03) for x in (-0.7, 0.7) for y in (-0.4, 0.4)]
    balls = ball((0, 0, 0.9), 0.12, 800), ball((0.4, 0.1, 0.85), 0.08, 500)
    return Gaussians.concatenate([box((-0.8, -0.5, 0.7), (0.8, 0.5, 0.75), 0.03), *legs, *balls])


def filled() -> Gaussians:
    """An object without any hollow."""
    means = np.random.default_rng(1).normal(size=(12_000, 3)).clip(-2, 2) * [0.25, 0.25, 0.75]
    return discs(means, (0.06, 0.06, 0.06))


def island() -> Gaussians:
    """A table on a round piece of lawn, with nothing around it."""
    rng = np.random.default_rng(2)
    radius, turn = 3.0 * np.sqrt(rng.random(3000)), rng.uniform(0.0, 2.0 * np.pi, 3000)
    lawn = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), rng.normal(0.0, 0.02, 3000)])
    return Gaussians.concatenate([discs(lawn, (0.15, 0.15, 0.01)), table()])


KINDS = {
    "object": (statue, table, filled, island),
    "rooms": (apartment, statue_in_room, cathedral),
    "open place": (street, plaza, forest, terrain),
}


def outside(g: Gaussians, share: float, how: str = "sphere", *, seed: int = 3) -> Gaussians:
    """A scene with small Gaussians far outside of it, which are a share of the whole."""
    rng = np.random.default_rng(seed)
    count = round(share / (1.0 - share) * len(g))
    ahead = rng.normal(size=(count, 3))
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    distances = {
        "sphere": np.full(count, 8000.0),
        "ball": 8000.0 * np.cbrt(rng.random(count)),
        "every scale": np.exp(rng.uniform(np.log(60.0), np.log(1e6), count)),
        "one side": np.full(count, 8000.0),
        "one point": np.full(count, 8000.0),
    }[how]
    if how == "one side":
        ahead[:, 0] = np.abs(ahead[:, 0]) + 0.1
    elif how == "one point":
        ahead[:] = [0.6, 0.0, 0.8]
    return Gaussians.concatenate([g, discs(g.means.mean(axis=0) + distances[:, None] * ahead, (0.09, 0.09, 0.09))])
