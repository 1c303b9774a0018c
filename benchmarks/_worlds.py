"""Test worlds: a scene in copies, turned, mirrored, jittered, joined by doors and a street; and a small built-in one.

Copies are jittered, so that no two tiles have the same content and tasks named by content cannot be shared.

    python benchmarks/_worlds.py ../shared/data/scenes/showroom/lod-meta.json --lod 2 --copies 9 -o city.ply
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.io import load_scene
from gsvis.io.ply import save_ply
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

F64 = NDArray[np.float64]

_JITTER = 1e-4  # of the size of a copy, on every center
_GAP = 0.25  # width of a street, in sizes of a copy
_DOOR = 0.08  # half width of a door in the side of a copy that faces the street, in sizes of it


def sheet(corner: F64, along: F64, up: F64, step: float, color: tuple[float, float, float]) -> Gaussians:
    """Opaque discs over a rectangle from a corner, in a lattice of about `step`."""
    sides = [np.linalg.norm(each) for each in (along, up)]
    counts = [max(1, round(side / step)) for side in sides]
    u, v = ((np.arange(count) + 0.5) / count for count in counts)
    places = corner + u[:, None, None] * along + v[None, :, None] * up
    axes = np.stack([along / sides[0], up / sides[1], np.cross(along, up) / (sides[0] * sides[1])], axis=1)
    from gsvis.scene.gaussians import quats_from_rotations

    n = places.shape[0] * places.shape[1]
    scales = np.tile([0.95 * sides[0] / counts[0], 0.95 * sides[1] / counts[1], 0.02 * step], (n, 1))
    shade = 0.85 + 0.3 * ((np.add.outer(np.arange(counts[0]), np.arange(counts[1])) % 7) / 7.0).reshape(-1, 1)
    sh0 = ((np.clip(np.array(color) * shade, 0.0, 1.0)) - 0.5) / SH_C0
    quats = np.tile(quats_from_rotations(axes[None]), (n, 1))
    return Gaussians(places.reshape(-1, 3), quats, scales, np.full(n, 0.995), sh0[:, None])


def house(low: F64, size: F64, step: float, color: tuple[float, float, float]) -> Gaussians:
    """A box of walls and a roof, with a door in the side towards +y."""
    x, y, z = np.diag(size)
    door, height = 0.2 * size[0], 0.6 * size[2]
    left = 0.5 * (size[0] - door)
    ex, ez = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    front = low + y
    walls = [
        (low, x, z), (low, y, z), (low + x, y, z), (low + z, x, y),
        (front, left * ex, z), (front + (left + door) * ex, left * ex, z),
        (front + left * ex + height * ez, door * ex, (size[2] - height) * ez),
    ]  # fmt: skip
    return Gaussians.concatenate([sheet(*wall, step, color) for wall in walls])


def small_street(houses: int = 4, step: float = 0.25, flyaways: int = 20, seed: int = 0) -> Gaussians:
    """A street along x, z up, with houses of 4 x 3 x 3 on one side, a wall on the other, and a few flyaways."""
    rng = np.random.default_rng(seed)
    length = 6.0 * houses
    parts = [
        sheet(np.array([0.0, -4.0, 0.0]), np.array([length, 0, 0]), np.array([0, 8.0, 0]), step, (0.4, 0.4, 0.42)),
        sheet(np.array([0.0, 4.0, 0.0]), np.array([length, 0, 0]), np.array([0, 0, 2.0]), step, (0.6, 0.3, 0.25)),
    ]
    for k in range(houses):
        color = tuple(0.3 + 0.6 * rng.random(3))
        low = np.array([6.0 * k + 1.0 + rng.random(), -3.5, 0.0])
        parts.append(house(low, np.array([4.0, 3.0, 2.5 + rng.random()]), step, color))
    away = rng.normal(size=(flyaways, 3)) * 400.0
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (flyaways, 1))
    parts.append(
        Gaussians(away, quats, np.full((flyaways, 3), 0.5), np.full(flyaways, 0.5), np.zeros((flyaways, 1, 3)))
    )
    return Gaussians.concatenate(parts)


def copies(
    g: Gaussians, count: int, up: int = 2, seed: int = 0, turns: Sequence[int] | None = None
) -> Iterator[Gaussians]:
    """Yield copies of a scene on a square lattice: turned, mirrored, jittered, with doors, and a piece of street.

    `turns` gives the quarters by which each copy is turned; without them they are drawn.
    """
    rng = np.random.default_rng(seed)
    low, high = g.bounds(0.98)
    middle, size = 0.5 * (low + high), float((high - low)[[k for k in range(3) if k != up]].max())
    near = np.abs(g.means - middle).max(axis=1) <= size  # flyaways of copies would lie in other copies
    core, pitch, side = g[near], (1.0 + _GAP) * size, int(np.ceil(np.sqrt(count)))
    flat = [k for k in range(3) if k != up]
    for k in range(count):
        place = np.zeros(3)
        place[flat] = pitch * np.array(divmod(k, side))
        means = core.means - middle
        door = (np.abs(means[:, flat[0]]) < _DOOR * size) & (np.abs(means[:, flat[1]]) > 0.3 * size)
        kept = core[~(door & (means[:, up] < 0.2 * size))]
        turn = np.eye(3)
        drawn = int(rng.integers(4))
        angle = 0.5 * np.pi * (drawn if turns is None else turns[k])
        turn[np.ix_(flat, flat)] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        copy = kept.transform(np.eye(3), -middle, 1.0)
        if rng.random() < 0.5:
            copy = mirrored(copy, flat[0])
        copy = copy.transform(np.round(turn), place, 1.0)
        jitter = _JITTER * size * rng.normal(size=(len(copy), 3))
        yield Gaussians(copy.means + jitter, copy.quats, copy.scales, copy.opacities, copy.sh0, copy.shN)
        corner, ground = place.copy(), float(np.quantile(means[:, up], 0.02))
        corner[flat] -= 0.5 * pitch
        corner[up] += ground
        along, across = np.zeros(3), np.zeros(3)
        along[flat[0]], across[flat[1]] = pitch, 0.5 * _GAP * size
        yield sheet(corner, along, across, size / 200.0, (0.35, 0.35, 0.38))


def mirrored(g: Gaussians, axis: int) -> Gaussians:
    """A scene without SH mirrored on one axis: centers, and rotations, whose other two components change their sign."""
    means, quats = g.means.copy(), g.quats.copy()
    means[:, axis] *= -1.0
    quats[:, [1 + k for k in range(3) if k != axis]] *= -1.0
    return Gaussians(means, quats, g.scales, g.opacities, g.sh0)


def write_copies(scene: str, lod: int | None, count: int, out: Path) -> int:
    """Write each copy with its street as a PLY of a folder, one at a time; return the Gaussians of all."""
    g = load_scene(scene, lod)
    if g.sh_degree:
        g = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0)
    out.mkdir(parents=True, exist_ok=True)
    total = 0
    for k, part in enumerate(copies(g, count)):
        save_ply(part, out / f"part-{k:04d}.ply")
        total += len(part)
    return total


def main() -> None:
    """Write a world of copies."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--lod", type=int)
    parser.add_argument("--copies", type=int, default=9)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    print(f"{write_copies(given.scene, given.lod, given.copies, given.out):,} Gaussians in {given.out}")


if __name__ == "__main__":
    main()
