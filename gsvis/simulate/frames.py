"""Render the Gaussians of many clients at one pose: project and sort the view once, then draw it for each subset.

The result equals `gsvis.render.rasterize` of the same Gaussians on the CPU, on black, with values clipped as on a
display. Scene frame and units.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.qoe import FIRST_FRAME_DB
from gsvis.color.evaluate import Evaluator
from gsvis.package.contents import Contents
from gsvis.render import rasterize
from gsvis.render.splats import View, blend, project
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0
from gsvis.simulate._kernels import thin as kernels

__all__ = ["CONTENT_DB", "Frame", "Stage", "psnr_of"]

CONTENT_DB = FIRST_FRAME_DB
"""A view has content if a black image has a lower PSNR against the full scene, which is a RMS of more than 0.1."""

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene as clients draw it, and the full scene to compare with.

    Args:
        contents: The package; its decoded records are drawn.
        reference: The scene before packaging; None means the highest level of the package with all terms.
        members: (N,) mask of the Gaussians of the full scene; None means those of the highest level.
        whole: Name of `contents`, for `compared_with`.
    """

    contents: Contents
    reference: Gaussians | None = None
    members: Mask | None = None
    whole: str = "the package"

    @cached_property
    def drawn(self) -> Gaussians:
        """All Gaussians of all levels, with base colors."""
        return self.contents.gaussians()

    @cached_property
    def highest(self) -> Mask:
        """(N,) whether each Gaussian belongs to the full scene."""
        if self.members is not None:
            return self.members
        return np.asarray(self.contents.last == len(self.contents.names) - 1)

    @cached_property
    def evaluator(self) -> Evaluator | None:
        """Colors with terms; None if there are none."""
        return Evaluator(self.contents.colors().dequantize()) if len(self.contents.term_records) else None

    @property
    def size(self) -> tuple[int, int]:
        """N and T."""
        return len(self.contents), len(self.contents.term_records)

    @property
    def compared_with(self) -> str:
        """Description of the full scene."""
        if self.reference is not None:
            return "the scene before it became a package, unquantized, with its spherical harmonics"
        return f"the highest level of {self.whole}, as decoded, with all its terms"


class Frame:
    """A pose that is prepared for rendering any client.

    Args:
        stage: The scene.
        camera: One camera.

    Attributes:
        ids: (M,) Gaussians that reach a pixel, ascending.
        highest: (M,) whether each of them belongs to the full scene.
        reference: (H, W, 3) image of the full scene, in [0, 1].
    """

    def __init__(self, stage: Stage, camera: Cameras) -> None:
        g = stage.drawn
        self._stage = stage
        self._view = View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height)
        self._projected = project(g, self._view, antialiased=g.facts.antialiased, pairs=False)
        self.ids = self._projected.ids
        self.highest: Mask = stage.highest[self.ids]
        self._features = np.empty((len(self.ids), 4), np.float32)
        self._features[:, :3] = np.maximum(SH_C0 * g.sh0[self.ids, 0] + np.float32(0.5), 0.0)
        self._features[:, 3] = self._projected.depths
        self._kept: dict[bytes, float] = {}
        if stage.reference is not None:
            self.reference: F32 = np.clip(rasterize(stage.reference, camera, backend="cpu").images[0], 0.0, 1.0)
        else:
            self.reference = self.image(self.highest, np.ones(stage.size[1], bool))

    def image(self, shown: Mask, terms: Mask) -> F32:
        """Return the image (H, W, 3) in [0, 1].

        Args:
            shown: (M,) whether the client shows each of `ids`.
            terms: (T,) whether it has each term.
        """
        p = self._projected
        v = self._view
        offsets = np.empty_like(p.offsets)
        members = np.empty_like(p.members)
        count = kernels.keep_shown(p.offsets, p.members, shown, offsets, members)
        features = self._features
        evaluator = self._stage.evaluator
        if evaluator is not None and terms.any():
            features = features.copy()
            some = np.flatnonzero(shown)
            means = self._stage.drawn.means
            features[some, :3] = evaluator.colors(means, v.eye, active=terms, ids=self.ids[some])
        image = blend(p, v, features, np.zeros(3, np.float32), (offsets, members[:count]))[0]
        return np.clip(image, 0.0, 1.0)

    @property
    def has_content(self) -> bool:
        """Whether the full scene differs enough from a black image here (`CONTENT_DB`)."""
        return psnr_of(np.zeros_like(self.reference), self.reference) < CONTENT_DB

    def psnr(self, shown: Mask, terms: Mask) -> float:
        """Return the PSNR against the full scene, dB.

        Args:
            shown: (M,) whether the client shows each of `ids`.
            terms: (T,) whether it has each term.
        """
        key = hashlib.blake2b(np.packbits(shown).tobytes(), digest_size=16)
        if len(terms):
            key.update(np.packbits(terms).tobytes())
        found = self._kept.get(key.digest())
        if found is None:
            found = self._kept[key.digest()] = psnr_of(self.image(shown, terms), self.reference)
        return found


def psnr_of(image: F32, target: F32) -> float:
    """Return the PSNR of images with values in [0, 1], dB; inf if they are equal."""
    apart = (image - target).ravel()
    error = float(np.dot(apart, apart)) / len(apart)
    return float(-10.0 * np.log10(error)) if error > 0.0 else np.inf
