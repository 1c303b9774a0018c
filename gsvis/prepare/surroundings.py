"""Hold Gaussians around a scene that hide it or are seen from it, but belong to other packages.

Visible sets are found in the scene and its surroundings together. Then they are cut in two: a store of the scene, and
one of the same cells for what is seen around it, whose ids count the surroundings. Scene frame and units; this module
knows no tiles.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.pvs.store import CellSet, StoreInfo, StoreWriter, VisibilityStore
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, levels_record

__all__ = ["Surroundings"]

U8 = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """M Gaussians around a scene, each in levels `first` to `last` of that scene.

    Attributes:
        gaussians: The Gaussians; their SH above degree 0 changes nothing.
        first: (M,) lowest level of the scene with each Gaussian.
        last: (M,) highest level.
    """

    gaussians: Gaussians
    first: U8
    last: U8

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.gaussians)

    @property
    def digest(self) -> str:
        """Hash of the content, 64 hexadecimal digits."""
        found = hashlib.sha256(scene_hash(self.gaussians).encode())
        found.update(self.first.tobytes() + self.last.tobytes())
        return found.hexdigest()

    def joined(self, levels: Levels) -> Levels:
        """Return the levels of N Gaussians with the surroundings added, as ids N to N + M - 1."""
        union = Gaussians.concatenate([_flat(levels.union), _flat(self.gaussians)])
        first, last = (np.concatenate(each) for each in ((levels.first, self.first), (levels.last, self.last)))
        return Levels(union, first, last, levels.names)

    def joined_counts(self, levels: Levels) -> list[int]:
        """Return the number of Gaussians in each of the joined levels."""
        stands = [int(np.count_nonzero((self.first <= k) & (k <= self.last))) for k in range(len(levels))]
        return [own + more for own, more in zip(levels.counts, stands, strict=True)]

    def split(
        self, joint: VisibilityStore, levels: Levels, own: Path, around: Path, *, progress: Progress = silent
    ) -> None:
        """Split the store of joined levels into a store of the levels and a store of the surroundings.

        Args:
            joint: The store of `joined(levels)`.
            levels: The levels, N Gaussians.
            own: The store of the levels to write. Certificates are for both stores together.
            around: The store of the surroundings to write; its ids are 0 to M - 1.
            progress: Called with stage "store".

        Raises:
            SceneError: If no cell sees anything.
            OSError: If a file cannot be written.
        """
        n = len(levels.union)
        m = len(self)
        config = {name: value for name, value in joint.info.config.items() if name != "levels"}
        record = levels_record(levels)
        own_config = config if record is None else {**config, "levels": record}
        directions = joint.direction_sets
        parts = (
            (own, 0, n, StoreInfo(n, scene_hash(levels.union), joint.tau, joint.info.class_edges, own_config)),
            (around, n, n + m, StoreInfo(m, self.digest, joint.tau, joint.info.class_edges, config)),
        )
        if not joint.viewpoints.any():
            raise SceneError("every viewpoint lies inside something solid")
        for path, low, high, info in parts:
            with StoreWriter(path, joint.grid, info) as writer:
                for cell in range(len(joint)):
                    ids, classes = joint.classes(cell)
                    some = slice(*np.searchsorted(ids, [low, high]))
                    writer.add_cell(CellSet(ids[some] - low, classes[some], **_figures(joint, cell)))
                writer.finish(directions[low:high], progress=progress)


def _figures(store: VisibilityStore, cell: int) -> dict[str, Any]:
    """Return the figures of a cell, for a writer."""
    found = store.certificates
    counts = {"inner": int(found.inner[cell]), "rays": int(found.rays[cell])}
    shares = {name: float(getattr(found, name)[cell]) for name in ("missed", "bound", "tile")}
    return {"viewpoints": int(store.viewpoints[cell]), **counts, **shares}


def _flat(g: Gaussians) -> Gaussians:
    """Return a scene without SH, which does not affect visibility."""
    return g if g.sh_degree == 0 else replace(g, shN=g.shN[:, :0])
