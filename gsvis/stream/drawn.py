"""The Gaussians and terms that a client draws, in arrays with room to grow.

New rows are appended; the last row takes the place of a removed one. So the cost of a batch depends on its own size
only. The geometry of a scene is a view of these arrays, not a copy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.color.records import has_scales
from gsvis.color.srbf import SrbfColors
from gsvis.package.codec import ChunkTable, decode_records
from gsvis.package.contents import base_places, base_rgb
from gsvis.package.layout import RecordLayout
from gsvis.package.terms import decode_terms
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0
from gsvis.stream._kernels import ids as kernels
from gsvis.stream.batch import Sections
from gsvis.stream.header import SceneHeader

__all__ = ["Drawn", "Rows"]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]


_ROOM = 1 << 20


class Rows:
    """Arrays of the same length that grow together.

    Args:
        room: Rows to reserve memory for. The system provides only the memory that is written to.
        **like: An empty array for each name, with the shape and type of its rows.
    """

    def __init__(self, room: int, **like: NDArray[Any]) -> None:
        self._arrays = {name: np.empty((room, *array.shape[1:]), array.dtype) for name, array in like.items()}
        self._room = room
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return the rows written so far of one array, as a view."""
        return self._arrays[name][: self._count]

    def append(self, **rows: NDArray[Any]) -> None:
        """Append rows to every array."""
        count = self._count + len(next(iter(rows.values())))
        if count > self._room:
            self._room = max(count, self._room * 3 // 2)
            for name, array in self._arrays.items():
                self._arrays[name] = np.empty((self._room, *array.shape[1:]), array.dtype)
                self._arrays[name][: self._count] = array[: self._count]
        for name, array in self._arrays.items():
            array[self._count : count] = rows[name]
        self._count = count

    def drop(self, places: I64) -> tuple[I64, I64]:
        """Remove rows and fill their places with the last rows; return the old and new places of the moved rows."""
        count = self._count - len(places)
        holes = places[places < count]
        behind = np.ones(len(places), bool)
        behind[places[places >= count] - count] = False
        moved = count + np.flatnonzero(behind)
        for array in self._arrays.values():
            array[holes] = array[moved]
        self._count = count
        return moved, holes


class Drawn:
    """The Gaussians that a client draws, with their terms.

    Args:
        about: Header of the scene.
    """

    def __init__(self, about: SceneHeader) -> None:
        grids = about.grids
        kind = about.grids.kind
        self._grids = grids
        self._layout = RecordLayout.from_variant(grids.variant)
        self._tables = [grids.base_table(k) for k in range(3)]
        self._scale_table = grids.scale_table() if has_scales(kind) else np.ones(1, np.float32)
        self._term_tables = grids.theta_table(), grids.phi_table(), grids.decay_table(), grids.intensity_table()

        def none(*shape: int) -> F32:
            return np.zeros((0, *shape), np.float32)

        self._gaussians = Rows(
            min(about.gaussians, _ROOM),
            ids=np.zeros(0, np.int32),
            means=none(3),
            quats=none(4),
            scales=none(3),
            opacities=none(),
            sh0=none(1, 3),
            base=none(3),
            color_scales=none(),
        )
        self._terms = Rows(
            min(about.terms, _ROOM),
            ids=np.zeros(0, np.uint32),
            owners=np.zeros(0, np.int32),
            functions=np.zeros(0, np.uint8),
            centers=none(2),
            decays=none(),
            intensities=none(kind.intensities),
        )
        # Slot of each Gaussian, from 1; 0 if it is not drawn. Zeros take no memory.
        self._slots = np.zeros(about.gaussians, np.int32)
        self._facts = SceneFacts(antialiased=about.antialiased)
        self._made: tuple[Gaussians, SrbfColors] | None = None

    def __len__(self) -> int:
        return len(self._gaussians)

    @property
    def ids(self) -> I32:
        """(M,) ids of the Gaussians that are drawn."""
        return self._gaussians["ids"]

    def add(self, s: Sections, chunks: I32, table: ChunkTable) -> None:
        """Add the Gaussians and terms of a checked batch.

        Args:
            s: The batch.
            chunks: (G,) for each Gaussian of the batch, the row of its chunk in `table`.
            table: Rows of chunks.
        """
        self._made = None
        if len(s.gaussians):
            self._add_gaussians(s, chunks, table)
        if len(s.terms):
            found = decode_terms(s.term_records, self._grids)
            theta, phi, decay, intensity = self._term_tables
            centers = np.stack([theta[found.centers[:, 0]], phi[found.centers[:, 1]]], axis=1)
            self._terms.append(
                ids=s.terms,
                owners=s.owners,
                functions=found.functions,
                centers=centers,
                decays=decay[found.decays],
                intensities=intensity[found.intensities],
            )

    def drop(self, ids: I64) -> None:
        """Remove Gaussians and their terms.

        Raises:
            ValueError: If an id is of a Gaussian that is not drawn.
        """
        self._made = None
        slots = self._slots[ids] - 1
        if (slots < 0).any():
            got = f"{int(ids[int(np.argmax(slots < 0))]):,}, which is not"
            raise ValueError(f"ids: expected Gaussians that are drawn, got {got}")
        self._slots[ids] = 0
        _, holes = self._gaussians.drop(slots.astype(np.int64))
        self._slots[self.ids[holes]] = holes + 1

    def terms_of(self, gaussians: I64) -> I64:
        """Return the ids of all terms of Gaussians that have been added, ascending."""
        return np.sort(self._terms["ids"][self._belong_to(gaussians)]).astype(np.int64)

    def forget(self, ids: I64) -> I64:
        """Remove those of these Gaussians that are drawn, and the terms of all; return the ids that were drawn."""
        if not len(ids):
            return ids
        drawn = ids[self._slots[ids] > 0]
        self.drop(drawn)
        self._terms.drop(np.flatnonzero(self._belong_to(ids)))
        return drawn

    def _belong_to(self, gaussians: I64) -> NDArray[np.bool_]:
        """Return whether each term (M,) belongs to one of these Gaussians."""
        chosen = np.zeros(len(self._slots), bool)
        chosen[gaussians] = True
        return np.asarray(chosen[self._terms["owners"]], np.bool_)

    def scene(self) -> tuple[Gaussians, SrbfColors]:
        """Return the Gaussians and their colors; see `Receiver.scene`."""
        if self._made is None:
            g = self._gaussians
            t = self._terms
            n = len(g)
            names = ("functions", "centers", "decays", "intensities")
            terms = tuple(t[name] for name in names)
            offsets = np.zeros(n + 1, np.int64)
            found = tuple(np.empty_like(array) for array in terms)
            count = kernels.group_terms(t["owners"], self._slots, terms, offsets, found)
            gaussians = _unchecked(
                Gaussians,
                shN=np.zeros((n, 0, 3), np.float32),
                **{name: g[name] for name in ("means", "quats", "scales", "opacities", "sh0")},
            )
            gaussians = gaussians.with_facts(self._facts)
            colors = _unchecked(
                SrbfColors,
                base=g["base"],
                scales=g["color_scales"],
                offsets=offsets,
                **{name: array[:count] for name, array in zip(names, found, strict=True)},
            )
            object.__setattr__(colors, "variant", self._grids.variant)
            self._made = gaussians, colors
        return self._made

    def _add_gaussians(self, s: Sections, chunks: I32, table: ChunkTable) -> None:
        """Decode and append the Gaussians of a batch; arguments as for `add`."""
        geometry = decode_records(s.records, table, self._layout, chunks=chunks)
        sh0 = ((base_rgb(s.records, self._grids) - np.float32(0.5)) / np.float32(SH_C0))[:, None]
        g = Gaussians(*geometry, sh0)
        places = base_places(s.records, self._grids)
        base = np.stack([self._tables[k][places[:, k]] for k in range(3)], axis=1)
        factors = self._scale_table[places[:, 3]] if self._layout.color_scale else np.ones(len(base), np.float32)
        self._slots[s.gaussians] = 1 + len(self) + np.arange(len(base), dtype=np.int32)
        self._gaussians.append(
            ids=s.gaussians,
            means=g.means,
            quats=g.quats,
            scales=g.scales,
            opacities=g.opacities,
            sh0=g.sh0,
            base=base,
            color_scales=factors,
        )


def _unchecked(kind: Any, **arrays: NDArray[Any]) -> Any:
    """Return a Gaussians or SrbfColors object without checking its arrays: each batch was checked on arrival."""
    made = object.__new__(kind)
    for name, array in arrays.items():
        view = array.view()
        view.flags.writeable = False
        object.__setattr__(made, name, view)
    return made
