"""Generate scenes: a furnished flat, occluder scenes with visibility known in closed form, and random scenes for tests.

Occluder scenes consist of opaque surfaces (`_surfaces.py`) in meters, z up. Each comes with viewpoints and, for each
viewpoint, the Gaussians that are certainly visible and certainly hidden (docs/conventions.md: largest weight at least,
or below, 1/255). Gaussians in the margins (soft rims, grazing lines, corners) are in neither set. Everything is
deterministic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.scene._surfaces import OFFSETS, OPACITY, SPENT, Patch, Sheet, Shell, Surface
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.sh import SH_C0

__all__ = [
    "BUILTIN_SCENES",
    "OCCLUDER_SCENES",
    "BuiltinScene",
    "OccluderScene",
    "box_in_room",
    "builtin_scene",
    "furnished_flat",
    "nested_shells",
    "random_scene",
    "two_rooms",
    "wall_with_hole",
]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Triple = tuple[float, float, float]

UP = (0.0, 0.0, 1.0)
CLEARANCE = 0.25
"""Least distance of eyes of built-in scenes from surfaces, meters."""

FINE = 0.4  # lattice step of occluders, relative to the rest: a finer rim leaves fewer Gaussians undecided
_WARM = (0.78, 0.62, 0.46)
_COOL = (0.50, 0.62, 0.76)
_CLAY = (0.76, 0.36, 0.26)
_MOSS = (0.40, 0.58, 0.34)
_SAND = (0.84, 0.78, 0.64)
_SLATE = (0.36, 0.40, 0.46)
_PLUM = (0.58, 0.34, 0.52)


@dataclass(frozen=True, eq=False, repr=False)
class BuiltinScene:
    """A scene that gsvis generates.

    Args:
        gaussians: The N Gaussians.
        viewpoints: (V, 3) eyes.
        navigable: Allowed viewpoints.
        up: (3,) up axis.
        name: Name in `BUILTIN_SCENES`.
    """

    gaussians: Gaussians
    viewpoints: F64
    navigable: NavigableSpace
    up: F64
    name: str

    def __repr__(self) -> str:
        return f"BuiltinScene({self.name}: {len(self.gaussians):,} Gaussians, {len(self.viewpoints)} eyes)"


@dataclass(frozen=True, eq=False, repr=False)
class OccluderScene(BuiltinScene):
    """A scene with known visibility from some viewpoints.

    Args:
        gaussians: The N Gaussians.
        viewpoints: (V, 3) eyes.
        navigable: Allowed viewpoints.
        up: (3,) up axis.
        name: Name in `BUILTIN_SCENES`.
        surfaces: Its surfaces, in the order of the Gaussians.
    """

    surfaces: tuple[Surface, ...]

    @property
    def visible(self) -> Mask:
        """(V, N) Gaussians that are certainly visible: the largest weight on a line from the eye is at least 1/255."""
        return self._verdicts[0]

    @property
    def hidden(self) -> Mask:
        """(V, N) Gaussians that are certainly hidden: the weight is below 1/255 on every line."""
        return self._verdicts[1]

    @cached_property
    def _verdicts(self) -> tuple[Mask, Mask]:
        """Visible and hidden Gaussians, computed on first use because it takes longer than building the scene."""
        return _judge(self.gaussians, self.surfaces, self.viewpoints)

    @property
    def undecided(self) -> Mask:
        """(V, N) Gaussians that are neither certainly visible nor certainly hidden."""
        return ~(self.visible | self.hidden)

    def __repr__(self) -> str:
        size = f"{len(self.gaussians):,} Gaussians, {len(self.viewpoints)} eyes"
        return f"OccluderScene({self.name}: {size}, {self.undecided.mean():.1%} undecided)"


Painted = tuple[Surface, Triple]


def wall_with_hole(count: int = 20_000, *, sh_degree: int = 2) -> OccluderScene:
    """Build a free-standing wall, 6 x 4, with a square hole of 1.6; behind it are a backdrop and three balls.

    Args:
        count: Approximate number of Gaussians, at least 1000.
        sh_degree: 0 to 3.
    """

    def surfaces(step: float) -> list[Painted]:
        """Return the painted surfaces for a lattice step."""
        wall = Sheet(1, 0.0, (-3.0, 0.0), (3.0, 4.0), FINE * step, (((-0.8, 1.2), (0.8, 2.8)),))
        return [
            (wall, _WARM),
            (Sheet(1, 4.0, (-5.0, -1.0), (5.0, 5.0), step), _COOL),
            *(
                (Shell((x, 2.2, z), 0.45, step), c)
                for x, z, c in ((-1.6, 1.2, _CLAY), (0.1, 2.0, _MOSS), (1.7, 2.8, _PLUM))
            ),
        ]

    eyes = [(0.0, -4.0, 2.0), (-1.5, -3.0, 1.6), (1.2, -2.5, 2.8), (0.0, 1.2, 1.0)]
    return _scene("wall_with_hole", count, sh_degree, surfaces, eyes, ((-3.0, -5.0, 0.2), (3.0, 3.8, 3.8)))


def box_in_room(count: int = 20_000, *, sh_degree: int = 2) -> OccluderScene:
    """Build a closed box in the middle of a closed room of 6 x 5 x 3.

    Args:
        count: Approximate number of Gaussians, at least 1000.
        sh_degree: 0 to 3.
    """

    def surfaces(step: float) -> list[Painted]:
        """Return the painted surfaces for a lattice step."""
        room = _box((0.0, 0.0, 0.0), (6.0, 5.0, 3.0), step, (_WARM, _COOL, _SLATE, _SAND))
        return room + _box((2.3, 1.8, 0.4), (3.7, 3.2, 2.6), FINE * step, (_CLAY, _CLAY, _PLUM, _MOSS))

    eyes = [(0.5, 2.4, 1.6), (5.5, 2.5, 1.3), (3.0, 4.5, 1.8), (3.1, 0.5, 1.2)]
    return _scene("box_in_room", count, sh_degree, surfaces, eyes, ((0.0, 0.0, 0.0), (6.0, 5.0, 3.0)))


def two_rooms(count: int = 40_000, *, sh_degree: int = 3) -> OccluderScene:
    """Build two rooms of 4 x 4 x 3, joined by a door 1 wide and 2.1 high, with a ball in each.

    Args:
        count: Approximate number of Gaussians, at least 1000.
        sh_degree: 0 to 3.
    """

    def surfaces(step: float) -> list[Painted]:
        """Return the painted surfaces for a lattice step."""
        over = (
            2.0 * FINE * step
        )  # the partition extends behind floor, walls and ceiling, so that no seam lets light through
        door = ((1.5, -over), (2.5, 2.1))
        return [
            *_box((0.0, 0.0, 0.0), (8.0, 4.0, 3.0), step, (_WARM, _COOL, _SLATE, _SAND)),
            (Sheet(0, 4.0, (-over, -over), (4.0 + over, 3.0 + over), FINE * step, (door,)), _MOSS),
            (Shell((2.2, 3.1, 0.7), 0.4, step), _CLAY),
            (Shell((6.4, 1.0, 0.9), 0.45, step), _PLUM),
        ]

    eyes = [(0.8, 2.0, 1.6), (2.4, 0.8, 1.2), (5.6, 2.2, 1.5), (6.8, 3.0, 1.8)]
    return _scene("two_rooms", count, sh_degree, surfaces, eyes, ((0.0, 0.0, 0.0), (8.0, 4.0, 3.0)))


def nested_shells(count: int = 20_000, *, sh_degree: int = 3) -> OccluderScene:
    """Build three concentric closed spheres of radius 1, 2 and 3, with eyes between them, at the center, and outside.

    The navigable space lies between the outer two.

    Args:
        count: Approximate number of Gaussians, at least 1000.
        sh_degree: 0 to 3.
    """

    def surfaces(step: float) -> list[Painted]:
        """Return the painted surfaces for a lattice step."""
        return [(Shell((0.0, 0.0, 0.0), r, step), c) for r, c in ((1.0, _CLAY), (2.0, _MOSS), (3.0, _COOL))]

    eyes = [(-1.6, 1.5, -1.2), (1.1, 0.9, 0.5), (0.0, 0.0, 0.0), (5.0, 3.0, 4.0)]
    return _scene("nested_shells", count, sh_degree, surfaces, eyes, ((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0)))


def furnished_flat(count: int = 240_000, *, sh_degree: int = 3, seed: int = 1) -> BuiltinScene:
    """Build a furnished flat of five rooms and a hall, 10 x 8.6 meters, that looks like a trained capture.

    Colors of polished surfaces depend on the view. As after training, some Gaussians float in the air, and a
    layer lies behind the visible one. Visibility is not known in closed form.

    Args:
        count: Approximate number of Gaussians, at least 1000. Fewer take less time, with coarser shadows.
        sh_degree: 0 to 3.
        seed: Seed of all random numbers.
    """
    from gsvis.scene import flat  # slow to import, seldom needed

    g = flat.furnished_flat(count, sh_degree, seed)
    space = flat.navigable_space(g)
    index = np.argwhere(space.free)
    low, high = space.origin + space.voxel_size * np.stack([index.min(axis=0), index.max(axis=0) + 1])
    box = ((float(low[0]), float(low[1]), float(low[2])), (float(high[0]), float(high[1]), float(high[2])))
    facts = SceneFacts(up=flat.UP, up_source="the plan of the flat", meters_per_unit=1.0, box=box)
    return BuiltinScene(g.with_facts(facts), np.array(flat.EYES), space, np.array(flat.UP), "flat")


OCCLUDER_SCENES: dict[str, Callable[..., OccluderScene]] = {
    "wall_with_hole": wall_with_hole,
    "box_in_room": box_in_room,
    "two_rooms": two_rooms,
    "nested_shells": nested_shells,
}
"""Scenes whose visibility is known, by name."""

BUILTIN_SCENES: dict[str, Callable[..., BuiltinScene]] = {"flat": furnished_flat, **OCCLUDER_SCENES}
"""All scenes by name; on the command line `builtin:flat` and so on."""


def builtin_scene(name: str) -> BuiltinScene:
    """Return the scene with that name, at its default size.

    Raises:
        ValueError: If no scene has that name.
    """
    return BUILTIN_SCENES[_check.one_of("name", name, tuple(BUILTIN_SCENES))]()


def random_scene(rng: np.random.Generator, n: int, sh_degree: int = 0, kind: str = "blob") -> Gaussians:
    """Return random Gaussians around the origin, a few units wide, for tests and benchmarks.

    Args:
        rng: Source of randomness.
        n: Number of Gaussians.
        sh_degree: 0 to 3.
        kind: "blob" (all shapes), "discs" (nearly flat), "needles" (50 times as long as wide), "nested" (shared
            centers, sizes over two decades), "coincident" (every center four times, every tenth Gaussian twice).

    Raises:
        ValueError: If an argument is out of range.
    """
    _check.one_of("kind", kind, ("blob", "discs", "needles", "nested", "coincident"))
    _check.positive_int("n", n, at_least=0)
    k = (_check.positive_int("sh_degree", sh_degree, at_least=0) + 1) ** 2
    means = rng.normal(size=(n, 3))
    scales = np.exp(rng.normal(-2.5, 0.6, (n, 3)))
    if kind == "discs":
        scales[:, 2] = 1e-4 * scales[:, 0]
    elif kind == "needles":
        scales[:, 1:] = scales[:, :1] / 50.0
    elif kind == "nested":
        means = means[np.arange(n) % max(n // 50, 1)] + 0.01 * rng.normal(size=(n, 3))
        scales *= 10.0 ** rng.uniform(-1.0, 1.0, (n, 1))
    elif kind == "coincident":
        means = means[np.arange(n) // 4 * 4]
    g = Gaussians(
        means,
        rng.normal(size=(n, 4)),
        scales,
        rng.beta(0.8, 0.8, n),
        rng.normal(0.0, 0.8, (n, 1, 3)),
        rng.normal(0.0, 0.15, (n, k - 1, 3)),
    )
    if kind == "coincident" and n:
        where = np.arange(n)
        where[9::10] = where[9::10] - 1
        g = g[where]
    return g


def _box(low: Triple, high: Triple, step: float, colors: Sequence[Triple]) -> list[Painted]:
    """Return six sheets; `colors` are those of the x walls, the y walls, the floor and the ceiling."""
    painted: list[Painted] = []
    for axis in range(3):
        a, b = (i for i in range(3) if i != axis)
        for side, at in enumerate((low[axis], high[axis])):
            color = colors[axis] if axis < 2 else colors[2 + side]
            painted.append((Sheet(axis, at, (low[a], low[b]), (high[a], high[b]), step), color))
    return painted


def _scene(
    name: str,
    count: int,
    sh_degree: int,
    surfaces: Callable[[float], list[Painted]],
    eyes: list[Triple],
    box: tuple[Triple, Triple],
) -> OccluderScene:
    """Choose the lattice step for about `count` Gaussians and build the scene; the first eye is navigable."""
    _check.positive_int("count", count, at_least=1000)
    step = 0.1
    for _ in range(4):  # small balls keep their own step, so the count is not an exact power of the step
        built = sum(surface.count for surface, _ in surfaces(step))
        step *= float(np.sqrt(built / count))
    parts, colors = zip(*surfaces(step), strict=True)
    g = _dress([surface.patch() for surface in parts], colors, sh_degree)
    viewpoints = np.array(eyes, np.float64)
    space = _space(g, parts, box, viewpoints[0])
    return OccluderScene(g, viewpoints, space, np.array(UP), name, parts)


def _dress(patches: list[Patch], colors: Sequence[Triple], sh_degree: int) -> Gaussians:
    """Return the Gaussians of the patches, with a soft checker pattern and colors that vary with the view direction."""
    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree: expected 0, 1, 2 or 3, got {sh_degree!r}")
    means = np.concatenate([patch.means for patch in patches])
    base = np.concatenate([np.tile(c, (len(p.means), 1)) for p, c in zip(patches, colors, strict=True)])
    check = np.sin(2.0 * np.pi * (means + 0.13)).prod(axis=1) if len(means) else np.zeros(0)
    grain = np.sin(7.1 * means[:, 0] + 3.0 * np.sin(5.3 * means[:, 1]) + 6.7 * means[:, 2])
    base = np.clip(base + 0.10 * np.tanh(4.0 * check)[:, None] + 0.04 * grain[:, None], 0.05, 0.95)
    bands = np.repeat(np.arange(1, sh_degree + 1), 2 * np.arange(1, sh_degree + 1) + 1)
    k = np.arange(len(bands))
    phase = 0.7 * means @ np.array([[1.0, -0.6, 0.8], [0.4, 1.1, -0.7], [-0.9, 0.5, 1.0]])
    waves = np.cos(phase[:, None, :] + 1.7 * k[None, :, None])  # one slow wave for each coefficient and channel
    higher = 0.12 * 0.5 ** (bands - 1)[None, :, None] * waves
    return Gaussians(
        means,
        np.concatenate([patch.quats for patch in patches]),
        np.concatenate([patch.scales for patch in patches]),
        np.full(len(means), OPACITY),
        ((base - 0.5) / SH_C0)[:, None, :],
        higher,
    )


def _judge(g: Gaussians, surfaces: Sequence[Surface], eyes: F64) -> tuple[Mask, Mask]:
    """Return (V, N) certainly visible and certainly hidden; every surface is tested against every Gaussian."""
    means = g.means.astype(np.float64)
    covars = g.covars()
    patches = [surface.patch() for surface in surfaces]
    starts = np.cumsum([0, *(len(patch.means) for patch in patches)])
    visible = np.ones((len(eyes), len(g)), bool)
    hidden = np.zeros((len(eyes), len(g)), bool)
    for v, eye in enumerate(eyes):
        depth = np.repeat(0.5 * OFFSETS**2, len(g), axis=1)  # a Gaussian is fainter off its center
        for i, surface in enumerate(surfaces):
            own = slice(int(starts[i]), int(starts[i + 1]))
            dims, clear = surface.verdict(eye, means, covars)
            dims[:, own], clear[own] = surface.own_verdict(eye, patches[i])
            depth += dims
            visible[v] &= clear
        hidden[v] = depth.min(axis=0) >= SPENT
    return visible & ~hidden, hidden


def _space(g: Gaussians, surfaces: Sequence[Surface], box: tuple[Triple, Triple], home: F64) -> NavigableSpace:
    """Return the part of the box that lies away from all surfaces and is connected to `home`."""
    from scipy import ndimage  # slow to import, seldom needed

    grid = NavigableSpace.from_box(*box, 80)
    centers = grid.origin + grid.voxel_size * (np.indices(grid.free.shape).reshape(3, -1).T + 0.5)
    away = np.min([surface.distance(centers) for surface in surfaces], axis=0).reshape(grid.free.shape)
    targets = g.means[:: max(len(g) // 4096, 1)].astype(np.float64)
    labels, _ = ndimage.label(away > CLEARANCE)
    start = np.floor((home - grid.origin) / grid.voxel_size).astype(int)
    free = labels == labels[tuple(start)]
    rule = f"{CLEARANCE:g} from all surfaces"
    return NavigableSpace(grid.origin, grid.voxel_size, free, np.array(UP), away < grid.voxel_size, targets, rule)
