"""Find viewpoints that judge a prepared scene: around its densest detail, and of given cameras or a walk.

The text calls them "judge's eyes". They do not depend on navigable space, so they show where that space is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.jobs.in_order import in_order
from gsvis.render.rasterizer import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judging import draw_judges
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import buried
from gsvis.scene.thinned import thin
from gsvis.scene.view_sampling import ViewSampling
from gsvis.scene.witnesses import Witnesses

__all__ = ["JUDGES", "Judges", "count_views", "find_judges", "judging_views"]

F32 = NDArray[np.float32]

JUDGES = 50
"""Views by each of the two rules, a hundred in total."""

_MOST = 12_000  # Gaussians of the sample of the scene that tests an eye


@dataclass(frozen=True, eq=False)
class Judges:
    """Views from judge's eyes.

    Attributes:
        cameras: The views: first those around the detail, then those of given cameras or a walk.
        given: Number of views of given cameras or a walk.
        named: Name of their source, such as "cameras"; empty if `given` is 0.
    """

    cameras: Cameras
    given: int = 0
    named: str = ""

    def __len__(self) -> int:
        return len(self.cameras)


def count_views(held_out: int, usual: int, most: int = JUDGES) -> int:
    """Return the number of views by each rule: fewer if few views are held out, such as in tests.

    Args:
        held_out: Number of views held out for other checks.
        usual: Number of held-out views at which the result is `most`.
        most: Largest result.
    """
    return most if held_out >= usual else held_out


def judging_views(
    g: Gaussians, views: ViewSampling, space: NavigableSpace, *, whole: Gaussians | Levels | None = None
) -> tuple[Cameras, Judges]:
    """Return the views by both rules: builder's eyes inside navigable space, and judge's eyes independent of it.

    Args:
        g: The scene that judge's eyes look at.
        views: Number of views by each rule, image size, field of view and seed.
        space: Navigable space, which holds the builder's eyes; its witnesses are judge's eyes.
        whole: The full scene; builder's eyes lie in no solid part of it. `g` by default.
    """
    return views.cameras(g if whole is None else whole, space), find_judges(g, views, space.witnesses)


def find_judges(g: Gaussians, views: ViewSampling, witnesses: Witnesses | None = None) -> Judges:
    """Return at most `views.count` views from judge's eyes, half of them from witnesses if there are any.

    Args:
        g: The scene.
        views: Number, size, field of view and seed.
        witnesses: Poses that were not used to find the navigable space.
    """
    _, few = thin(g, _MOST, seed=views.seed)

    def draw(camera: Cameras) -> tuple[F32, F32]:
        """Return alpha and depth of one camera."""
        drawn = rasterize(few, camera, backend="cpu")
        return drawn.alphas[0], drawn.depths[0]

    def look(cameras: Cameras) -> tuple[F32, F32]:
        """Return alphas and depths of cameras."""
        alphas, depths = zip(*in_order(draw, (cameras[k : k + 1] for k in range(len(cameras)))), strict=True)
        return np.stack(alphas), np.stack(depths)

    shape = views.width, views.height, views.fov
    theirs = None if witnesses is None else witnesses.views(views.count // 2, *shape)
    if theirs is not None:
        theirs = theirs[~buried(g, theirs.viewpoints)]
    count = views.count - (0 if theirs is None else len(theirs))
    drawn = draw_judges(g, count, look, seed=views.seed, width=shape[0], height=shape[1], fov=shape[2])
    if theirs is None or witnesses is None or len(theirs) == 0:
        return Judges(drawn)
    both = Cameras(np.concatenate([drawn.viewmats, theirs.viewmats]), np.concatenate([drawn.Ks, theirs.Ks]), *shape[:2])
    return Judges(both, len(theirs), witnesses.named)
