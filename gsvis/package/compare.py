"""Measure the image quality at a client: draw the source scene, and the scene after each step toward a client."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.color.evaluate import Evaluator
from gsvis.color.srbf import SrbfColors
from gsvis.files.mapped import release_mapped
from gsvis.package.active_terms import ActiveTerms
from gsvis.package.cell_terms import CellTerms
from gsvis.package.contents import Contents
from gsvis.package.fidelity import Fidelity
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["ExactLevel", "measure_fidelity"]

Active = CellTerms | ActiveTerms

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_CAP = 100.0


class ExactLevel(NamedTuple):
    """The highest level before rounding.

    Attributes:
        gaussians: N Gaussians with their SH colors; those that are not of the level have no opacity.
        colors: Their colors as base colors and terms.
    """

    gaussians: Gaussians
    colors: SrbfColors


def measure_fidelity(
    scene: Gaussians,
    contents: Contents,
    cameras: Cameras,
    *,
    exact: ExactLevel | None = None,
    sets: VisibilityStore | None = None,
    active: Active | Callable[[], Active] | None = None,
    progress: Progress = silent,
) -> Fidelity:
    """Measure the final quality at a client against the source scene, over views.

    Args:
        scene: The source scene.
        contents: The records of its package; at the end a client shows their highest level.
        cameras: C > 0 held-out views.
        exact: The highest level before rounding. Without it, only the step "cells" is measured on its own.
        sets: Visible sets of the package; None skips the step "cells".
        active: The terms that its cells need; None with `sets` means that no terms are sent. A function is called when
            the images of the source are drawn, and what it returns is dropped before records are drawn.
        progress: Called with stage "fidelity", in images.

    Raises:
        ValueError: If there is no camera, or lengths do not match.
    """
    if len(cameras) == 0:
        raise ValueError("cameras: expected at least one, got none")
    done = -1
    total = (2 if exact is None else 3) * len(cameras)

    def advance() -> None:
        """Report another image of a view."""
        nonlocal done
        done += 1
        progress("fidelity", done, total)

    advance()
    wanted = []
    for c in range(len(cameras)):
        wanted.append(_rasterize(scene, cameras[c]))
        advance()
    release_mapped(vars(scene).values())
    exactly = [dict[str, F32]() for _ in wanted] if exact is None else _draw_exact(exact, cameras, advance)
    needed = {}
    if sets is not None and active is not None:
        needed = _terms_of_cells(sets, active, cameras, len(contents.term_records))
    draw = _Steps(contents, sets, needed)
    values: dict[str, list[float]] = {}
    for c in range(len(cameras)):
        images = {"scene": wanted[c], **exactly[c], **draw(cameras[c])}
        found = {"records": _psnr(images["rounding"], images["scene"])}
        if "cells" in images:
            found["cell"] = _psnr(images["cells"], images["scene"])
        for before, after in pairwise(images):
            if exact is not None or after == "cells":
                found[after] = _psnr(images[after], images[before])
        for name, value in found.items():
            values.setdefault(name, []).append(value)
        advance()
    return Fidelity.from_values(values, cameras)


def _draw_exact(exact: ExactLevel, cameras: Cameras, advance: Callable[[], None]) -> list[dict[str, F32]]:
    """Return the images of views of the highest level before rounding, with SH and with terms, by name."""
    g = exact.gaussians
    if len(g) != len(exact.colors):
        raise ValueError(f"exact: expected colors of {len(g):,} Gaussians, got {len(exact.colors):,}")
    evaluator = Evaluator(exact.colors, keep=False)
    found = []
    for c in range(len(cameras)):
        with_terms = evaluator.colors(g.means, cameras[c].viewpoints[0])
        found.append({"levels": _rasterize(g, cameras[c]), "terms": _rasterize(g, cameras[c], with_terms)})
        advance()
    release_mapped(vars(g).values())
    return found


def _terms_of_cells(
    sets: VisibilityStore, active: Active | Callable[[], Active], cameras: Cameras, count: int
) -> dict[int, U8]:
    """Return the terms that the cells of cameras need: by cell, a bit for each of `count` terms."""
    found = active() if callable(active) else active
    needed = {}
    for c in range(len(cameras)):
        cell = sets.grid.nearest(cameras[c].viewpoints[0])
        if cell not in needed:
            terms = np.zeros(count, bool)
            terms[found.active_ids(cell)] = True
            needed[cell] = np.packbits(terms)
    return needed


class _Steps:
    """Draws views of the records of a scene, and of what a client has of them in a cell."""

    def __init__(self, contents: Contents, sets: VisibilityStore | None, needed: dict[int, U8]) -> None:
        self._sets = sets
        self._needed = needed
        self._decoded = contents.gaussians()
        self._highest = contents.last == len(contents.names) - 1
        self._after = Evaluator(contents.colors().dequantize(), keep=False)

    def __call__(self, camera: Cameras) -> dict[str, F32]:
        """Return images (H, W, 3) by name: one for each of `STEPS` that is known."""
        eye = camera.viewpoints[0]
        images: dict[str, F32] = {}
        images["rounding"] = self._draw_records(camera, eye, self._highest, None)
        if self._sets is not None:
            cell = self._sets.grid.nearest(eye)
            seen = np.zeros(len(self._decoded), bool)
            seen[self._sets.visible_ids(cell)] = True
            count = self._after.num_terms
            bits = self._needed.get(cell, np.zeros(-(-count // 8), np.uint8))
            terms = np.unpackbits(bits, count=count).view(bool)
            images["cells"] = self._draw_records(camera, eye, self._highest & seen, terms)
        return images

    def _draw_records(self, camera: Cameras, eye: F64, held: Mask, active: Mask | None) -> F32:
        """Return an image of the decoded Gaussians in `held` (N,), with the terms in `active` (T,) or all."""
        colors = self._after.colors(self._decoded.means, eye, active=active)
        return _rasterize(self._decoded.showing(held), camera, colors)


def _rasterize(g: Gaussians, camera: Cameras, colors: F32 | None = None) -> F32:
    """Return the image (H, W, 3) of Gaussians from a camera, clipped to [0, 1]."""
    return np.asarray(np.clip(rasterize(g, camera, colors=colors).images[0], 0.0, 1.0), np.float32)


def _psnr(image: F32, target: F32) -> float:
    """Return the PSNR of two images in dB, at most 100."""
    return min(_CAP, float(psnr(image, target)))
