"""Cut a closed space open, so that eyes outside see into it: a dollhouse.

What stands between eyes outside and the opening goes. Kept is what eyes inside see, and what eyes outside see of the
space through the opening, such as the tops of cupboards. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.edit.cut import Cut, CutConfig, cut
from gsvis.edit.eyes import EyesInSpace, EyesOfCameras
from gsvis.edit.opening import Opening
from gsvis.progress import Progress, silent
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["OutsideCut", "cut_from_outside", "light_from_inside", "outside_cameras"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CAP = 45.0  # degrees: largest angle between the direction and an eye outside, seen from the opening
_FOV = 40.0
_FRAME = (480, 360)
_ROOM = 1.2  # share of the image's height that the opening takes at most, inverse
_LOOKS = 24  # eyes outside that decide
_JUDGES = 8  # other eyes that say what they see
_SMALL = (240, 180)  # their pixels
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class OutsideCut:
    """The part of a scene of N Gaussians that is kept.

    Attributes:
        kept: (N,) True for Gaussians that are kept.
        blocking: (N,) True for those that stood in the way.
        opening: Where the space is open.
        inside: The cut for the eyes inside, of the whole scene.
        outside: The cut for the eyes outside, of what stands behind the opening.
        light_before: (J,) share of the light of other eyes outside, in the direction of the opening, that comes from
            Gaussians that eyes inside see and that stay.
        light_after: The same once the rest has gone.
    """

    kept: Mask
    blocking: Mask
    opening: Opening
    inside: Cut
    outside: Cut
    light_before: F64
    light_after: F64

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain numbers for JSON."""
        return {
            "gaussians_in": len(self.kept),
            "gaussians_out": int(np.count_nonzero(self.kept)),
            "blocking": int(np.count_nonzero(self.blocking)),
            "direction": self.opening.axes[2].tolist(),
            "light_before": float(self.light_before.mean()),
            "light_after": float(self.light_after.mean()),
            "least_light_after": float(self.light_after.min()),
            "inside": self.inside.as_dict(),
            "outside": self.outside.as_dict(),
        }


def cut_from_outside(
    g: Gaussians,
    eyes: EyesInSpace,
    direction: ArrayLike | None = None,
    config: CutConfig | None = None,
    *,
    progress: Progress = silent,
) -> OutsideCut:
    """Find what to keep so that eyes outside see into a space.

    Args:
        g: The scene, N Gaussians.
        eyes: The eyes inside.
        direction: (3,) where the eyes outside are, any length; None is up.
        config: Options of both cuts; None means `CutConfig()`.
        progress: Called with stages "opening" and "light", and those of `cut`, twice.

    Raises:
        SceneError: If eyes inside see nothing, or nothing covers the space on this side.
        ValueError: If the direction has no length.
    """
    config = config or CutConfig()
    progress("opening", 0, 1)
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    side = eyes.space.up if direction is None else direction
    opening = Opening.from_space(eyes.space, tracer, side, config.seed)
    del tracer  # frees memory for both cuts
    blocking = opening.blocks(g)
    progress("opening", 1, 1)
    inside = cut(g, eyes, config, progress=progress)
    seen = inside.kept & ~blocking
    behind = np.flatnonzero(~blocking & (opening.holds(g.means) | seen))
    looks = outside_cameras(opening, eyes.space.up, _LOOKS)
    outside = cut(g[behind], EyesOfCameras(looks, 0.05 * opening.radius), config, progress=progress)
    kept = seen.copy()
    kept[behind[outside.kept]] = True
    judges = outside_cameras(opening, eyes.space.up, _JUDGES, seed=config.seed + 1)
    judges = judges.resize(*_SMALL)
    progress("light", 0, 2)
    before = light_from_inside(g, seen, opening, judges)
    progress("light", 1, 2)
    after = light_from_inside(g[kept], seen[kept], opening, judges)
    progress("light", 2, 2)
    return OutsideCut(kept, blocking, opening, inside, outside, before, after)


def outside_cameras(opening: Opening, up: ArrayLike, count: int, *, seed: int | None = None) -> Cameras:
    """Return cameras outside that look at an opening, all of it in their images.

    Args:
        opening: The opening.
        up: (3,) up direction of the images.
        count: Number of cameras.
        seed: Draws directions at random; None spreads them evenly.
    """
    share = (np.arange(count) + 0.5) / count
    turn = _GOLDEN * np.arange(count)
    if seed is not None:
        share, turn = np.random.default_rng([seed, 29]).random((2, count)) * [[1.0], [2.0 * np.pi]]
    cosines = 1.0 - share * (1.0 - np.cos(np.radians(_CAP)))
    sines = np.sqrt(1.0 - cosines**2)
    ways = np.column_stack([sines * np.cos(turn), sines * np.sin(turn), cosines]) @ opening.axes
    half = 0.5 * np.radians(_FOV) * _FRAME[1] / _FRAME[0]
    eyes = opening.middle + _ROOM * opening.radius / np.sin(half) * ways
    return Cameras.look_at(eyes, opening.middle, up=up, width=_FRAME[0], height=_FRAME[1], fov=_FOV)


def light_from_inside(g: Gaussians, inside: Mask, opening: Opening, cameras: Cameras) -> F64:
    """Return the share of the light that comes from some Gaussians, in pixels that look through the opening.

    Args:
        g: N Gaussians.
        inside: (N,) those that count.
        opening: The opening.
        cameras: J cameras outside.

    Returns:
        (J,) shares of the pixels' light; what reaches the background counts as light from elsewhere.
    """
    colors = np.repeat(np.asarray(inside, np.float32)[:, None], 3, axis=1)
    shares = np.zeros(len(cameras))
    for c in range(len(cameras)):
        rays_o, rays_d = (rays.reshape(-1, 3) for rays in cameras[c].rays())
        through = opening.enters(rays_o, rays_d)
        image = rasterize(g, cameras[c], colors=colors, backend="cpu").images[0][..., 0].ravel()
        shares[c] = float(image[through].mean()) if through.any() else 0.0
    return shares
