"""Check a cleaning: render held-out views without each class, and restore Gaussians that the views need.

The views are random cameras in navigable space that gave no evidence. PSNR cannot distinguish removed fog from a
removed wall, so there are two measures. Unseen classes must not change a view, measured by PSNR. Fog and floaters may
change a view, but may make up more than half of only a few pixels.
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

_MOST_OF = 0.5  # share of a pixel's light from which the pixel mostly shows removed Gaussians
_STAGE = "guard"


@dataclass(frozen=True)
class Cost:
    """Loss of held-out views when Gaussians are removed.

    Attributes:
        mean_db: Mean PSNR against the whole scene, dB; at most 100.
        worst_db: PSNR of the worst view, dB.
        changed: Share of the filled pixels (alpha at least a half), in [0, 1], that mostly show removed Gaussians.
        light_lost: Mean decrease of alpha over all pixels.
        back: Number of Gaussians that the guard restored; 0 if they went.
    """

    mean_db: float
    worst_db: float
    changed: float
    light_lost: float
    back: int = 0


@dataclass(frozen=True, eq=False)
class _Views:
    """Images (C, H, W, 3) and alphas (C, H, W) of a scene."""

    g: Gaussians
    cameras: Cameras
    images: NDArray[np.float32]
    alphas: NDArray[np.float32]

    @classmethod
    def draw(cls, g: Gaussians, cameras: Cameras) -> _Views:
        """Return the views of cameras, rendered."""
        drawn = rasterize(g, cameras, backend="cpu")
        return cls(g, cameras, np.clip(drawn.images, 0.0, 1.0), drawn.alphas)

    def cost_of(self, gone: NDArray[np.bool_], light: NDArray[np.float32]) -> Cost:
        """Return the cost of removing Gaussians `gone` (N,), whose light (C, H, W) is known."""
        if not gone.any():
            return Cost(PSNR_CAP, PSNR_CAP, 0.0, 0.0)
        without = rasterize(self.g[~gone], self.cameras, backend="cpu")
        found = np.minimum(np.atleast_1d(psnr(np.clip(without.images, 0.0, 1.0), self.images)), PSNR_CAP)
        filled = self.alphas >= 0.5
        mostly = filled & (light > _MOST_OF * self.alphas)
        return Cost(
            mean_db=float(found.mean()),
            worst_db=float(found.min()),
            changed=int(np.count_nonzero(mostly)) / max(int(np.count_nonzero(filled)), 1),
            light_lost=float(np.mean(self.alphas - without.alphas)),
        )

    def light_of(self, masks: list[NDArray[np.bool_]]) -> NDArray[np.float32]:
        """Return (C, H, W, 3) the summed weights of one to three sets of Gaussians (N,), one per channel."""
        g = self.g
        lit = [*masks, *[np.zeros(len(g), bool)] * (3 - len(masks))]
        base = (np.stack(lit, axis=1)[:, None].astype(np.float32) - 0.5) / SH_C0
        shown = Gaussians(g.means, g.quats, g.scales, g.opacities, base, facts=g.facts)
        return np.asarray(rasterize(shown, self.cameras, backend="cpu").images, np.float32)


def measure_cost(g: Gaussians, kept: NDArray[np.bool_], cameras: Cameras) -> Cost:
    """Return the loss of views if only some Gaussians of a scene are kept.

    Args:
        g: The scene, N Gaussians.
        kept: (N,) True for Gaussians that stay.
        cameras: C > 0 cameras of one size.
    """
    views = _Views.draw(g, cameras)
    gone = ~np.asarray(kept, bool)
    return views.cost_of(gone, views.light_of([gone])[..., 0])


def guard(
    g: Gaussians,
    classes: U8,
    cameras: Cameras,
    config: CleanConfig,
    *,
    more: Cameras | None = None,
    progress: Progress = silent,
) -> tuple[U8, dict[str, Cost]]:
    """Restore Gaussians that held-out views need.

    First every Gaussian of `HIDDEN` that one of the views sees is restored. Then the views are rendered without each
    class. A class of `HIDDEN` is restored if a view drops below `least_db`; fog and floaters, if more than
    `most_changed` of the pixels mostly show them.

    Args:
        g: The scene, N Gaussians.
        classes: (N,) uint8, the class of each Gaussian; not changed.
        cameras: C > 0 held-out cameras.
        config: The limits.
        more: Further cameras, used only to find visible Gaussians of `HIDDEN`, which is cheaper than a comparison.
        progress: Called with stage "guard", in steps.

    Returns:
        The classes (N,) afterwards, and the cost of each class with Gaussians, by name. "all" is the cost of the final
        removal.
    """
    names = [name for name in CLASSES if np.any(classes == class_of(name))]
    steps = 2 + len([name for name in names if name not in HIDDEN]) + any(name in HIDDEN for name in names)
    progress(_STAGE, 0, steps)
    classes, back = _rescue(g, classes, [cameras] if more is None else [cameras, more], config.tau)
    whole = _Views.draw(g, cameras)
    progress(_STAGE, 1, steps)
    costs: dict[str, Cost] = {}
    split = [[name for name in names if name in HIDDEN], *([name] for name in names if name not in HIDDEN)]
    groups = [group for group in split if group]
    light = whole.light_of([_members(classes, group) for group in groups])
    for k, group in enumerate(groups):
        costs |= _check_group(classes, whole, group, config, light[..., k])
        progress(_STAGE, 2 + k, steps)
    classes = classes.copy()
    for name in names:
        if not _within(name, costs[name], config):
            count = int(np.count_nonzero(classes == class_of(name)))
            costs[name] = replace(costs[name], back=count)
            classes[classes == class_of(name)] = KEPT
        costs[name] = replace(costs[name], back=costs[name].back + back.get(name, 0))
    stays = [k for k, group in enumerate(groups) if _members(classes, group).any()]
    total = whole.cost_of(classes != KEPT, light[..., stays].sum(axis=-1))
    costs["all"] = replace(total, back=sum(each.back for each in costs.values()))
    progress(_STAGE, steps, steps)
    return classes, costs


def _rescue(g: Gaussians, classes: U8, cameras: list[Cameras], tau: float) -> tuple[U8, dict[str, int]]:
    """Return the classes without Gaussians of `HIDDEN` that a camera sees, and their number in each class.

    Views are rendered without fog and floaters, because their removal uncovers what they hide.
    """
    hidden = np.isin(classes, [class_of(name) for name in HIDDEN])
    if not hidden.any():
        return classes, {}
    stays = np.flatnonzero(hidden | (classes == KEPT))
    part = g[stays]
    seen = np.zeros(len(g), bool)
    for camera in (some[c] for some in cameras for c in range(len(some))):
        seen[stays[view_weights(part, camera).largest[0] >= tau]] = True
    rescued = hidden & seen
    counts = {name: int(np.count_nonzero(rescued & (classes == class_of(name)))) for name in HIDDEN}
    return np.where(rescued, np.uint8(KEPT), classes), counts


def _check_group(
    classes: U8, whole: _Views, group: list[str], config: CleanConfig, light: NDArray[np.float32]
) -> dict[str, Cost]:
    """Return the cost of each class of a group; measured together if their joint cost is low enough.

    The light (C, H, W) is that of the whole group.
    """
    cost = whole.cost_of(_members(classes, group), light)
    if len(group) == 1 or _within(group[0], cost, config):
        return dict.fromkeys(group, cost)
    found: dict[str, Cost] = {}
    for name in group:
        found |= _check_group(classes, whole, [name], config, light)
    return found


def _members(classes: U8, group: list[str]) -> NDArray[np.bool_]:
    """Return a mask (N,): which Gaussians belong to one of some classes."""
    return np.isin(classes, [class_of(name) for name in group])


def _within(name: str, cost: Cost, config: CleanConfig) -> bool:
    """Return whether a class may be removed at this cost."""
    if name in HIDDEN:
        return cost.worst_db >= config.least_db
    return cost.changed <= config.most_changed
