"""Put floaters, fog and hidden Gaussians into a scene. Seeded; knows nothing of cleaning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.look import Look
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.directions import seen_from_space
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["KINDS", "Injected", "drawn_by", "inject", "seen_by"]

KINDS = ("scene", "floaters", "fog", "interior")
HAZE = 0.35  # optical depth, over a path as long as the scene is wide, of fog and at most of floaters
TAU = 1.0 / 255.0
CERTAIN = TAU / 4.0  # weight below which what is put in is hidden without doubt


@dataclass(frozen=True, eq=False)
class Injected:
    """A scene with more in it.

    Attributes:
        scene: N + M Gaussians; those put in come last.
        kinds: (N + M,) uint8, index in `KINDS`.
    """

    scene: Gaussians
    kinds: NDArray[np.uint8]


def inject(g: Gaussians, space: NavigableSpace, share: float, seed: int, *, crowded: bool = False) -> Injected:
    """Put floaters, fog and hidden Gaussians into a scene, together `share` of its number.

    Floaters are groups of 1 to 4 of 0.1% to 1% of the scene's width and opacities 0.1 to 0.95, at random places of
    navigable space; all smaller by one factor where they would take more light than fog may (`crowded` keeps them).
    Fog has 2% to 6% of the width and opacities 0.02 to 0.05, at such places too; as many as make a
    path across the scene lose a third of its light, at most a third of all. Hidden ones lie behind surfaces, where 48
    eyes do not see them, nor any eye on 1,280 rays outward from each: seams of walls let light through.

    Args:
        g: The scene.
        space: Its navigable space.
        share: Gaussians to put in, over those of the scene.
        seed: Seed of all choices.
        crowded: Let floaters take any amount of light: 20 times what the scene's width lets through, in large scenes.
    """
    rng = np.random.default_rng([seed, 77])
    low, high = g.bounds(0.98)
    side = float((high - low).max())
    total = max(3, round(share * len(g)))
    voxels = np.argwhere(space.free)
    spans = space.voxel_size * (voxels.max(axis=0) + 1 - voxels.min(axis=0))
    across = float(np.prod(np.sort(spans)[:2]))  # cross-section of the longest way through
    sigma = side * rng.uniform(0.02, 0.06, total // 3)
    opacity = rng.uniform(0.02, 0.05, total // 3)
    count = int(np.searchsorted(np.cumsum(opacity * 2.0 * np.pi * sigma**2) / across, HAZE))
    fog = _make(
        rng, space.sample_viewpoints(count, rng), sigma[:count, None] * rng.uniform(0.6, 1.0, (count, 3)),
        opacity[:count], g, gray=True,
    )  # fmt: skip
    hidden = _hidden(g, space, rng, side, (total - count) // 2)
    rest = total - count - len(hidden)
    groups = space.sample_viewpoints(rest, rng)[np.sort(rng.integers(0, max(rest // 2, 1), rest))]
    scales = side * 10.0 ** rng.uniform(-3.0, -2.0, (rest, 1)) * rng.uniform(0.3, 1.0, (rest, 3))
    places = groups + 0.002 * side * rng.normal(size=(rest, 3))
    dense = rng.uniform(0.1, 0.95, rest)
    taken = float(np.sum(dense * 2.0 * np.pi * np.prod(np.sort(scales, axis=1)[:, 1:], axis=1))) * side / space.volume
    if not crowded:
        scales *= min(1.0, float(np.sqrt(HAZE / taken)))
    floaters = _make(rng, places, scales, dense, g)
    kinds = np.repeat(np.arange(4, dtype=np.uint8), [len(g), rest, count, len(hidden)])
    return Injected(Gaussians.concatenate([g, floaters, fog, hidden]), kinds)


def drawn_by(g: Gaussians, eyes: NDArray[np.float64], size: int = 192) -> NDArray[np.bool_]:
    """Return (N,) what the rasterizer draws on cubemaps around eyes (E, 3), with a weight of at least 1/255."""
    seen = np.zeros(len(g), bool)
    for eye in eyes:
        seen |= view_weights(g, Cameras.cubemap(eye[None], size)).largest.max(axis=0) >= TAU
    return seen


def seen_by(g: Gaussians, eyes: NDArray[np.float64], size: int = 256, floor: float = TAU) -> NDArray[np.bool_]:
    """Return (N,) what eyes (E, 3) see, on cubemaps, with a weight of at least `floor`."""
    look, seen = Look(g, "hybrid", size, floor), np.zeros(len(g), bool)
    for eye in eyes:
        seen[look(eye)[0]] = True
    return seen


def _hidden(g: Gaussians, space: NavigableSpace, rng: np.random.Generator, side: float, count: int) -> Gaussians:
    """Return Gaussians behind surfaces that eyes do not see."""
    eyes = space.sample_viewpoints(48, rng)
    solid = np.flatnonzero(g.opacities >= 0.5)
    low, high = g.bounds(0.98)
    found: list[Gaussians] = []
    for _ in range(4):
        means = g.means[rng.choice(solid, 3 * count)].astype(np.float64)
        nearest = eyes[np.argmin(((means[:, None] - eyes[None, :16]) ** 2).sum(axis=2), axis=1)]
        away = means - nearest
        away /= np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
        places = means + side * rng.uniform(0.008, 0.03, (len(means), 1)) * away
        places = places[np.all((places > low) & (places < high), axis=1)]
        scales = side * 10.0 ** rng.uniform(-3.2, -2.5, (len(places), 1)) * rng.uniform(0.3, 1.0, (len(places), 3))
        made = _make(rng, places, scales, rng.uniform(0.3, 0.95, len(places)), g)
        found = [_still_hidden(g, Gaussians.concatenate([*found, made]), space, eyes)[:count]]
        if len(found[0]) >= count:
            break
    # Those left out may have hidden others.
    return _still_hidden(g, found[0], space, eyes)


def _still_hidden(g: Gaussians, made: Gaussians, space: NavigableSpace, eyes: NDArray[np.float64]) -> Gaussians:
    """Return those of some Gaussians that no eye sees in a scene with them, when those that eyes see are left out."""
    while len(made):
        tracer = Tracer(EllipsoidProxies.from_scene(Gaussians.concatenate([g, made])))
        hidden = ~seen_from_space(tracer, space, ids=len(g) + np.arange(len(made)), rays_per_face=16)
        if hidden.all():  # looks are expensive: only when rays find no more
            hidden = ~seen_by(Gaussians.concatenate([g, made]), eyes, floor=CERTAIN)[len(g) :]
            if hidden.all():
                break
        made = made[hidden]
    return made


def _make(
    rng: np.random.Generator, means: NDArray[np.float64], scales: NDArray[np.float64], opacities: NDArray[np.float64],
    like: Gaussians, *, gray: bool = False,
) -> Gaussians:  # fmt: skip
    """Return Gaussians with random turns and colors, of the SH degree of a scene."""
    n = len(means)
    base = rng.normal(0.0, 0.2, (n, 1, 1)) + (0.0 if gray else 1.0) * rng.normal(0.0, 1.0, (n, 1, 3))
    shN = np.zeros((n, like.shN.shape[1], 3))
    return Gaussians(means, rng.normal(size=(n, 4)), scales, opacities, base, shN)
