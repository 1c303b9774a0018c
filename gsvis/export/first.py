"""Write the file of a first view: the Gaussians and terms that it needs, one by one, the most useful first.

A page reads it with one request while it comes, so the first view costs no more bytes than from a server. The file
begins with a byte for each part of the scene: the share of its light in the cell that this file does not bring.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.abr import FieldOfView
from gsvis.export.columns import compress
from gsvis.export.lights import CellLight, Lights
from gsvis.export.pieces import PieceCoder
from gsvis.export.placing import Placing
from gsvis.export.rows import TermWorth
from gsvis.export.start import Start
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, rotations_from_quats

__all__ = ["FirstViews"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_VIEW = FieldOfView(1.15, 1.15, 0.64, 0.64, margin=0.14)  # 16 to 9, 65 degrees high
_WIDTH = 640  # pixels of the picture that ranks Gaussians
_ENOUGH = 0.999  # share of the light in view that a file brings
_PIECE = (4096, 12288)  # bytes of the first piece, and of later ones
# bytes, about
_RECORD = 12.0
_TERM = 4.0


def _camera_of(start: Start) -> Cameras:
    """Return a camera of a view that sees its margin too."""
    right = np.tan(np.arctan(_VIEW.right) + _VIEW.margin)
    bottom = np.tan(np.arctan(_VIEW.bottom) + _VIEW.margin)
    height = round(_WIDTH * bottom / right)
    focal = 0.5 * _WIDTH / right
    Ks = np.array([[[focal, 0.0, 0.5 * _WIDTH], [0.0, 0.5 * height / bottom, 0.5 * height], [0.0, 0.0, 1.0]]])
    viewmats = np.eye(4)[None].copy()
    viewmats[0, :3, :3] = rotations_from_quats(np.array([start.rotation]))[0].T
    viewmats[0, :3, 3] = -viewmats[0, :3, :3] @ np.array(start.position)
    return Cameras(viewmats, Ks, _WIDTH, height)


@dataclass(frozen=True, eq=False)
class FirstViews:
    """Makes the files of the first views of a package.

    Attributes:
        lights: The light in its cells.
        g: Its N decoded Gaussians.
        worth: What terms are worth; None if cells do not choose terms.
        coder: Encodes pieces.
        placing: Ids and parts of the static form.
    """

    lights: Lights
    g: Gaussians
    worth: TermWorth | None
    coder: PieceCoder
    placing: Placing

    def encode(self, start: Start, most: int) -> bytes:
        """Return the file of a view, of about `most` bytes at most."""
        eye = np.array(start.position)
        light = self.lights.of_eye(eye)
        ids, lights = self._in_view(start)
        order = np.argsort(-lights, kind="stable")
        share = np.cumsum(lights[order]) / max(lights.sum(), 1e-300)
        order = order[: int(np.searchsorted(share, _ENOUGH)) + 1]
        ids = ids[order]
        pieces = [self._left(light, ids)]
        return b"".join([*pieces, *self._pieces(ids, lights[order], *self._terms(eye, light, ids), most)])

    def _in_view(self, start: Start) -> tuple[I64, F64]:
        """Return the ids of the static form that a view shows, and the weight times solid angle of each, drawn exactly.

        What the cell says of light holds for all of the cell, so it ranks a single view much worse.
        """
        camera = _camera_of(start)
        weights = view_weights(self.g[self.placing.order], camera).summed[0].astype(np.float64)
        ids = np.flatnonzero(weights > 0.0)
        return ids, weights[ids] / float(camera.Ks[0, 0, 0] * camera.Ks[0, 1, 1])

    def _terms(self, eye: F64, light: CellLight, ids: I64) -> tuple[I64, F64]:
        """Return the terms (M,) of Gaussians `ids` that are of use to an eye, and the worth of a byte of each."""
        none = np.zeros(0, np.int64), np.zeros(0)
        if self.worth is None:
            return none
        terms, values = self.worth.of_terms(self.lights.grid.nearest(eye), eye, light)
        placed = self.placing.placed[self.worth.owners[terms]]
        here = np.zeros(len(self.coder.contents) + 1, np.bool_)
        here[ids] = True
        kept = here[placed]
        offsets = self.coder.contents.term_offsets
        numbers = self.worth.numbers(terms[kept])
        return offsets[placed[kept]] + numbers, values[kept] / _TERM

    def _pieces(self, ids: I64, lights: F64, terms: I64, values: F64, most: int) -> Iterator[bytes]:
        """Yield pieces with Gaussians and terms, those of most worth a byte first, of about `most` bytes in all."""
        owners = np.repeat(np.arange(len(self.coder.contents)), self.coder.contents.term_counts)[terms]
        worth_of = np.zeros(len(self.coder.contents))
        worth_of[ids] = lights / _RECORD
        keys = np.concatenate([lights / _RECORD, np.minimum(values, worth_of[owners])])
        every = np.concatenate([ids, terms])
        is_term = np.repeat([False, True], [len(ids), len(terms)])
        order = np.lexsort((is_term, -keys))
        every = every[order]
        is_term = is_term[order]
        sizes = np.cumsum(np.where(is_term, _TERM, _RECORD))
        known = np.zeros(len(self.coder.contents.table), np.bool_)
        at = 0
        size = _PIECE[0]
        while at < len(every) and sizes[at] < most:
            end = int(np.searchsorted(sizes, sizes[at] + size)) + 1
            some = every[at:end]
            mask = is_term[at:end]
            yield self.coder.encode(np.sort(some[~mask]), np.sort(some[mask]), known)
            at = end
            size = _PIECE[1]

    def _left(self, light: CellLight, ids: I64) -> bytes:
        """Return the share of the light of each part that is left without the Gaussians `ids` of the static form."""
        count = int(self.placing.part_of.max()) + 1
        here = np.zeros(len(self.coder.contents), np.bool_)
        here[ids] = True
        seen, lights = light
        parts = self.placing.part_of[seen]
        kept = parts >= 0
        all_light = np.bincount(parts[kept], lights[kept], minlength=count)
        rest = kept & ~here[np.maximum(self.placing.placed[seen], 0)]
        left = np.bincount(parts[rest], lights[rest], minlength=count)
        share = np.divide(left, all_light, out=np.ones(count), where=all_light > 0)
        shares = compress(np.rint(255 * share).astype(np.uint8).tobytes())
        return len(shares).to_bytes(4, "little") + shares
