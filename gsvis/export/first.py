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
Useful = tuple[I64, F64]

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
        useful = self.useful_terms(self.lights.grid.nearest(eye), eye, light)
        return self.encode_some(light, ids[order], lights[order], useful, most)

    def useful_terms(self, cell: int, eye: F64, light: CellLight) -> Useful:
        """Return the terms (T,) of the package that are active in a cell, and the worth of each at an eye."""
        if self.worth is None:
            return np.zeros(0, np.int64), np.zeros(0)
        return self.worth.of_terms(cell, eye, light)

    def encode_some(self, light: CellLight, ids: I64, lights: F64, useful: Useful, most: int) -> bytes:
        """Return a file with Gaussians and those of their terms that are of use, of about `most` bytes at most.

        Args:
            light: What the cell of the file sees.
            ids: (M,) ids of the static form, the most useful first.
            lights: (M,) what each is worth.
            useful: Terms and their worth, from `useful_terms`.
            most: Bytes at most, about.
        """
        if not len(ids):
            return b""
        every, is_term, sizes = self._ranked(ids, lights, *self._terms(ids, useful))
        end = int(np.searchsorted(sizes, most)) + 1
        here = every[:end][~is_term[:end]]
        return b"".join([self._left(light, here), *self._pieces(every[:end], is_term[:end], sizes[:end])])

    def _in_view(self, start: Start) -> tuple[I64, F64]:
        """Return the ids of the static form that a view shows, and the weight times solid angle of each, drawn exactly.

        What the cell says of light holds for all of the cell, so it ranks a single view much worse.
        """
        camera = _camera_of(start)
        weights = view_weights(self.g[self.placing.order], camera).summed[0].astype(np.float64)
        ids = np.flatnonzero(weights > 0.0)
        return ids, weights[ids] / float(camera.Ks[0, 0, 0] * camera.Ks[0, 1, 1])

    def _terms(self, ids: I64, useful: Useful) -> tuple[I64, F64]:
        """Return those useful terms (M,) that Gaussians `ids` have, and the worth of a byte of each."""
        terms, values = useful
        if self.worth is None:
            return terms, values
        placed = self.placing.placed[self.worth.owners[terms]]
        here = np.zeros(len(self.coder.contents) + 1, np.bool_)
        here[ids] = True
        kept = here[placed]
        offsets = self.coder.contents.term_offsets
        numbers = self.worth.numbers(terms[kept])
        return offsets[placed[kept]] + numbers, values[kept] / _TERM

    def _ranked(self, ids: I64, lights: F64, terms: I64, values: F64) -> tuple[I64, NDArray[np.bool_], F64]:
        """Return Gaussians and terms, those of most worth a byte first; which are terms; and the bytes up to each."""
        owners = np.repeat(np.arange(len(self.coder.contents)), self.coder.contents.term_counts)[terms]
        worth_of = np.zeros(len(self.coder.contents))
        worth_of[ids] = lights / _RECORD
        keys = np.concatenate([lights / _RECORD, np.minimum(values, worth_of[owners])])
        every = np.concatenate([ids, terms])
        is_term = np.repeat([False, True], [len(ids), len(terms)])
        order = np.lexsort((is_term, -keys))
        is_term = is_term[order]
        return every[order], is_term, np.cumsum(np.where(is_term, _TERM, _RECORD))

    def _pieces(self, every: I64, is_term: NDArray[np.bool_], sizes: F64) -> Iterator[bytes]:
        """Yield pieces with all that is ranked."""
        known = np.zeros(len(self.coder.contents.table), np.bool_)
        at = 0
        size = _PIECE[0]
        while at < len(every):
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
