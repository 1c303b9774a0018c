"""Keep cleaning from eating what pictures need: draw held-out views without each class, and give back what they miss.

The views are random cameras in navigable space that gave no evidence. No PSNR tells fog that goes from a wall that
goes, so the classes have two measures. What no eye sees must not change a view: PSNR. Fog and floaters may change a
view, but not be what it shows: of few pixels more than half.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.classes import CLASSES, HIDDEN, KEPT, CleanConfig, class_of
from gsvis.progress import Progress, silent
from gsvis.render import psnr, rasterize, view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

__all__ = ["PSNR_CAP", "Cost", "guard", "measure_cost"]

U8 = NDArray[np.uint8]

PSNR_CAP = 100.0
"""PSNR in dB of equal images."""

_MOST_OF = 0.5  # share of a pixel's light from which what goes is what the pixel shows
_STAGE = "guard"


@dataclass(frozen=True)
class Cost:
    """What held-out views lose when Gaussians go.

    Attributes:
        mean_db: Mean PSNR against the whole scene, dB; at most 100.
        worst_db: PSNR of the worst view, dB.
        changed: Share of the pixels with something in them (alpha at least a half), in [0, 1], of which what goes
            makes more than half.
        light_lost: Mean decrease of alpha over all pixels.
        back: Number of Gaussians that the guard gave back for this; 0 if they went.
    """

    mean_db: float
    worst_db: float
    changed: float
    light_lost: float
    back: int = 0


@dataclass(frozen=True, eq=False)
class _Views:
    """What cameras show of a scene: images (C, H, W, 3) and alphas (C, H, W)."""

    g: Gaussians
    cameras: Cameras
    images: NDArray[np.float32]
    alphas: NDArray[np.float32]

    @classmethod
    def draw(cls, g: Gaussians, cameras: Cameras) -> _Views:
        drawn = rasterize(g, cameras, backend="cpu")
        return cls(g, cameras, np.clip(drawn.images, 0.0, 1.0), drawn.alphas)

    def cost_of(self, gone: NDArray[np.bool_]) -> Cost:
        """Return the cost of the views without the Gaussians gone (N,)."""
        if not gone.any():
            return Cost(PSNR_CAP, PSNR_CAP, 0.0, 0.0)
        without = rasterize(self.g[~gone], self.cameras, backend="cpu")
        found = np.minimum(np.atleast_1d(psnr(np.clip(without.images, 0.0, 1.0), self.images)), PSNR_CAP)
        filled = self.alphas >= 0.5
        mostly = filled & (self._light_of(gone) > _MOST_OF * self.alphas)
        return Cost(
            mean_db=float(found.mean()),
            worst_db=float(found.min()),
            changed=int(np.count_nonzero(mostly)) / max(int(np.count_nonzero(filled)), 1),
            light_lost=float(np.mean(self.alphas - without.alphas)),
        )

    def _light_of(self, chosen: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Return (C, H, W) the sum of the weights of some Gaussians (N,): they are drawn white, the others black."""
        g = self.g
        base = np.where(chosen, 0.5 / SH_C0, -0.5 / SH_C0).astype(np.float32)[:, None, None].repeat(3, axis=2)
        white = Gaussians(g.means, g.quats, g.scales, g.opacities, base)
        return np.asarray(rasterize(white, self.cameras, backend="cpu").images[..., 0], np.float32)


def measure_cost(g: Gaussians, kept: NDArray[np.bool_], cameras: Cameras) -> Cost:
    """Return what views of cameras lose when only some Gaussians of a scene are kept.

    Args:
        g: The scene, N Gaussians.
        kept: (N,) those that stay.
        cameras: C > 0 cameras of one size.
    """
    return _Views.draw(g, cameras).cost_of(~np.asarray(kept, bool))


def guard(
    g: Gaussians,
    classes: U8,
    cameras: Cameras,
    config: CleanConfig,
    *,
    more: Cameras | None = None,
    progress: Progress = silent,
) -> tuple[U8, dict[str, Cost]]:
    """Give back what held-out views need.

    First every Gaussian of `HIDDEN` that one of the views sees is given back. Then the views are drawn without each
    class. A class of `HIDDEN` is given back if a view keeps less than `least_db`; fog and floaters, if more than
    `most_changed` of the pixels show little else.

    Args:
        g: The scene, N Gaussians.
        classes: (N,) uint8, the class of each Gaussian; not changed.
        cameras: C > 0 held-out cameras.
        config: The limits.
        more: Further cameras, in which only Gaussians of `HIDDEN` are looked for; cheaper than a comparison.
        progress: Called with stage "guard", in steps.

    Returns:
        The classes (N,) after it, and the cost of each class that held Gaussians, by name. "all" is the cost of what
        goes in the end.
    """
    names = [name for name in CLASSES if np.any(classes == class_of(name))]
    steps = 2 + len([name for name in names if name not in HIDDEN]) + any(name in HIDDEN for name in names)
    progress(_STAGE, 0, steps)
    classes, back = _rescue(g, classes, [cameras] if more is None else [cameras, more], config.tau)
    whole = _Views.draw(g, cameras)
    progress(_STAGE, 1, steps)
    costs: dict[str, Cost] = {}
    done = 1
    groups = [[name for name in names if name in HIDDEN], *([name] for name in names if name not in HIDDEN)]
    for group in groups:
        if not group:
            continue
        costs |= _check_group(classes, whole, group, config)
        done += 1
        progress(_STAGE, done, steps)
    classes = classes.copy()
    for name in names:
        if not _within(name, costs[name], config):
            count = int(np.count_nonzero(classes == class_of(name)))
            costs[name] = replace(costs[name], back=count)
            classes[classes == class_of(name)] = KEPT
        costs[name] = replace(costs[name], back=costs[name].back + back.get(name, 0))
    total = whole.cost_of(classes != KEPT)
    costs["all"] = replace(total, back=sum(each.back for each in costs.values()))
    progress(_STAGE, steps, steps)
    return classes, costs


def _rescue(g: Gaussians, classes: U8, cameras: list[Cameras], tau: float) -> tuple[U8, dict[str, int]]:
    """Return the classes without Gaussians of `HIDDEN` that a camera sees, and how many of each class that were.

    Fog and floaters are left out: what they hide is seen when they are gone.
    """
    hidden = np.isin(classes, [class_of(name) for name in HIDDEN])
    if not hidden.any():
        return classes, {}
    stays = np.flatnonzero(hidden | (classes == KEPT))
    part, seen = g[stays], np.zeros(len(g), bool)
    for camera in (some[c] for some in cameras for c in range(len(some))):
        seen[stays[view_weights(part, camera).largest[0] >= tau]] = True
    rescued = hidden & seen
    counts = {name: int(np.count_nonzero(rescued & (classes == class_of(name)))) for name in HIDDEN}
    return np.where(rescued, np.uint8(KEPT), classes), counts


def _check_group(classes: U8, whole: _Views, group: list[str], config: CleanConfig) -> dict[str, Cost]:
    """Return the cost of each class of a group; measured together if together they cost little enough."""
    cost = whole.cost_of(np.isin(classes, [class_of(name) for name in group]))
    if len(group) == 1 or _within(group[0], cost, config):
        return dict.fromkeys(group, cost)
    found: dict[str, Cost] = {}
    for name in group:
        found |= _check_group(classes, whole, [name], config)
    return found


def _within(name: str, cost: Cost, config: CleanConfig) -> bool:
    """Return whether a class may go at this cost."""
    if name in HIDDEN:
        return cost.worst_db >= config.least_db
    return cost.changed <= config.most_changed
