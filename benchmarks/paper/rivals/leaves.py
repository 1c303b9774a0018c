"""Streamed SOG, loaded leaf by leaf: by the rules of PlayCanvas' engine, of Spark, and of Octree-GS.

All load the same files, with the bytes that they have here: one for each leaf and level of detail. A client decides
from its own pose and from what it has, so its requests arrive half a round trip later, and each file that it waits for
costs a round trip. Files are never unloaded and never loaded twice. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr.classes import FieldOfView
from gsvis.abr.predict import Pose
from gsvis.package.contents import Contents
from gsvis.scene.gaussians import rotations_from_quats
from paper.rivals.flow import Files
from paper.rivals.pieces import Sender, boxes_in_view, distances_to
from paper.rivals.segments import Segments, level_files

__all__ = ["RULES", "LeafFiles", "LeafStream", "leaf_sizes"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

RULES = ("playcanvas", "spark", "octree-gs")

# PlayCanvas: the finest level up to 5 units, the next up to 15, and so on
_BASE = 5.0
_MULTIPLIER = 3.0
_BEHIND = 1.5  # PlayCanvas: factor on the distance straight behind the eye
_SHRINK = 0.75  # PlayCanvas: of what a box has beyond the median box
# Spark: half of 70 and of 120 degrees
_CONE = np.cos(np.radians(35.0))
_WIDE = np.cos(np.radians(60.0))
# Spark: of the size on the screen at the outer cone, and behind
_CONE_SHARE = 0.4
_BEHIND_SHARE = 0.2
_FAR = 1e6  # units, more than any distance
_FILES = {"playcanvas": 2, "spark": 3, "octree-gs": 3}


@dataclass(frozen=True, eq=False)
class LeafFiles:
    """The files of a streamed SOG of a package, as measured.

    Attributes:
        of: (N,) leaf of each Gaussian of the package; -1 for none.
        sizes: (L, B) bytes of the files of each level and leaf, lowest level first; 0 for none.
        header: Bytes of the description of the tree.
        environment: Ids that viewers draw always.
        environment_bytes: Bytes of their file.
    """

    of: I64
    sizes: I64
    header: int
    environment: I64
    environment_bytes: int = 0


class LeafStream(Sender):
    """Streamed SOG, leaf by leaf.

    - "playcanvas": the rule of the engine 2.23. The level of detail of a leaf follows from its distance, which grows
      by up to a half behind the eye; nearest leaves first, two files at a time. With "underfill", as in its examples:
      a leaf is shown at its coarsest level at first, and one level finer is put behind the queue of requests, up to the
      level of its distance; so the coarsest level of all leaves comes first. Simplified: the queue is sorted again at
      each pose, and the budget of Gaussians to draw is not reached.
    - "spark": the fetch order of Spark 2. Its tree of merged splats is opened where a splat is largest on the screen,
      less outside of a cone of 70 degrees and least behind; what is opened is fetched, three at a time. Simplified: our
      levels stand for its tree, and the largest splat of a leaf at the level before for the splat that is opened.
    - "octree-gs": the rule for levels of Octree-GS, by the logarithm of the distance, here relative to half of the size
      of the scene; leaves in view first. The paper has no order of transmission: that lower levels and near leaves come
      first is ours. Its anchors are trained for its levels; these levels are ours.

    Args:
        contents: The package.
        files: Files of its levels.
        view: Field of view of the client.
        rule: One of `RULES`.
        segments: Segments of the package that belong to `files`, if they are known; computed otherwise.

    References:
        PlayCanvas engine, `gsplat-octree-instance.js`; Spark, `lod_tree.rs` and `SplatPager.ts`; Ren et al.,
        "Octree-GS", 2024, section 4.
    """

    def __init__(
        self,
        contents: Contents,
        files: LeafFiles,
        view: FieldOfView,
        rule: str = "playcanvas",
        *,
        segments: Segments | None = None,
        measured: str = "streamed SOG, as gsvis writes it",
    ) -> None:
        self.rule = _check.one_of("rule", rule, RULES)
        self.name = f"leaves, {self.rule}"
        found = segments or Segments.of_contents(contents, files.of)
        super().__init__(
            contents,
            level_files(contents, found, files.sizes),
            Files(_FILES[self.rule]),
            header=files.header + files.environment_bytes,
            always=files.environment,
            waits=True,
            measured=measured,
        )
        self._view = view
        self._boxes = found.boxes
        self._levels = len(contents.names)
        self._near_boxes = _shrunk(found.boxes)
        self._sizes = _splat_sizes(contents, found)
        low = found.boxes[:, 0].min(axis=0)
        high = found.boxes[:, 1].max(axis=0)
        self._half = max(float(np.linalg.norm(high - low)) / 2.0, 1e-9)

    def urgency(self, t: float, pose: Pose) -> F64:
        """Return the urgency of each file; see `Sender`."""
        eye = np.asarray(pose.position, np.float64)
        forward = rotations_from_quats(pose.quat[None])[0, :, 2]
        if self.rule == "playcanvas":
            return self._by_distance(eye, forward)
        if self.rule == "spark":
            return self._by_size(eye, forward)
        return self._by_octree(eye, pose.quat)

    def describe(self) -> dict[str, Any]:
        """Return facts for reports; see `Delivery`."""
        return {**super().describe(), "rule": self.rule, "files_at_once": _FILES[self.rule]}

    def _by_distance(self, eye: F64, forward: F64) -> F64:
        away = np.clip(eye, self._near_boxes[:, 0], self._near_boxes[:, 1]) - eye
        plain = np.linalg.norm(away, axis=1)
        behind = np.where(plain > 0.01, np.maximum(-(away @ forward) / np.maximum(plain, 1e-9), 0.0), 0.0)
        distances = plain * (1.0 + (_BEHIND - 1.0) * behind)
        coarser = np.floor(np.log(np.maximum(distances / _BASE, 1e-9)) / np.log(_MULTIPLIER)) + 1.0
        finest = self._levels - 1 - np.clip(coarser, 0, self._levels - 1).astype(np.int64)
        return self._up_to(finest, -distances)

    def _by_size(self, eye: F64, forward: F64) -> F64:
        middle = self._boxes.mean(axis=1) - eye
        cosines = (middle @ forward) / np.maximum(np.linalg.norm(middle, axis=1), 1e-9)
        inner = np.clip((cosines - _WIDE) / (_CONE - _WIDE), 0.0, 1.0)
        outer = np.clip(cosines / _WIDE, 0.0, 1.0)
        share = _BEHIND_SHARE + (_CONE_SHARE - _BEHIND_SHARE) * outer + (1.0 - _CONE_SHARE) * inner
        near = np.maximum(distances_to(eye, self._boxes), 1e-2 * self._half)
        return np.asarray((self._sizes * share / near).reshape(-1))

    def _by_octree(self, eye: F64, quat: F64) -> F64:
        distances = distances_to(eye, self._boxes)
        levels = np.floor(np.log2(np.maximum(self._half / np.maximum(distances, 1e-9), 1.0)))
        finest = np.clip(levels, 0, self._levels - 1).astype(np.int64)
        inside = boxes_in_view(self._view.planes(eye, quat), self._boxes)
        return self._up_to(finest, np.where(inside, _FAR * _FAR, 0.0) - distances)

    def _up_to(self, finest: I64, urgency: F64) -> F64:
        """Return the urgency of each leaf at its levels up to the finest wanted: lower levels first, none beyond."""
        levels = np.arange(self._levels)[:, None]
        return np.where(levels <= finest, urgency - _FAR * levels, -np.inf).reshape(-1)


def _shrunk(boxes: F64) -> F64:
    """Return boxes without three quarters of what they have beyond the median box, so that few giants do not count."""
    half = (boxes[:, 1] - boxes[:, 0]) / 2.0
    excess = _SHRINK * np.maximum(half - np.median(half, axis=0), 0.0)
    return np.stack([boxes[:, 0] + excess, boxes[:, 1] - excess], axis=1)


def _splat_sizes(contents: Contents, segments: Segments) -> F64:
    """Return (L, B) the largest splat that is opened to get a level: of the level before, or all of the leaf."""
    largest = segments.scales.max(axis=1).astype(np.float64)
    sizes = np.zeros((len(contents.names), len(segments)))
    sizes[0] = np.linalg.norm(segments.boxes[:, 1] - segments.boxes[:, 0], axis=1)
    for level in range(1, len(sizes)):
        before = (contents.first <= level - 1) & (level - 1 <= contents.last)
        sizes[level] = [largest[ids].max(initial=0.0) for ids in segments.ids(np.asarray(before))]
    return sizes


def leaf_sizes(sizes: ArrayLike) -> I64:
    """Return (L, B) sizes with the lowest level first, from those of a streamed SOG, which has the finest first."""
    return np.ascontiguousarray(np.asarray(sizes, np.int64)[::-1])
