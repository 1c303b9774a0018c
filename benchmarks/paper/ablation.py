"""Our own stream with one of its ideas left out, to see what each is worth.

The server, its window and its messages stay the same. What is left out is replaced by what a system without it does.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.index import CellSets, SceneIndex
from gsvis.package.layout import RECORD_BYTES
from gsvis.simulate.baselines import terms_of
from gsvis.simulate.delivery import Adaptive, Parcel
from gsvis.stream.scene import StreamedScene
from gsvis.stream.source import EveryCell

__all__ = ["ABLATIONS", "ablated", "without_levels", "without_sets", "without_terms"]

I64 = NDArray[np.int64]

ABLATIONS = {
    "sets": "every cell sees everything",
    "levels": "the highest level alone",
    "terms": "full SH with each Gaussian",
    "prediction": "the current pose and cell alone",
}
"""What each ablation does, by what is left out."""


def ablated(
    scene: StreamedScene,
    left_out: str,
    view: FieldOfView,
    config: AbrConfig | None = None,
    *,
    sh_bytes: float = 0.0,
) -> Adaptive:
    """Return our delivery without one of its ideas.

    Args:
        scene: The scene, or what `without_sets`, `without_levels` or `without_terms` returned for this idea, so that
            several deliveries share it.
        left_out: One of `ABLATIONS`.
        view: Field of view of the client.
        config: Settings; None means `AbrConfig()`.
        sh_bytes: Without terms: measured bytes of the SH coefficients of a Gaussian beyond its base color.
    """
    _check.one_of("left_out", left_out, tuple(ABLATIONS))
    config = config or AbrConfig()
    name = f"gsvis without {left_out}"
    if left_out == "terms":
        return _FullSh(scene, view, config, sh_bytes)
    if left_out == "prediction":
        return Adaptive(scene, view, replace(config, predictor="last", lead=0.0, ahead=0.0), name=name)
    return Adaptive(scene, view, config, name=name)


def without_sets(scene: StreamedScene) -> StreamedScene:
    """Return a scene whose cells see all Gaussians, each with its opacity as weight."""
    index = scene.index
    every = EveryCell(len(scene), len(scene.contents.term_records))
    opacities = scene.contents.gaussians().opacities
    plain = replace(index, sets=every, class_weights=np.ones(1, np.float32), importance=opacities)
    return scene.with_index(plain if index.active is None else replace(plain, active=every))


def without_levels(scene: StreamedScene) -> StreamedScene:
    """Return a scene with the Gaussians of the highest level alone, as one level."""
    contents = scene.contents
    highest = np.asarray(contents.last == len(contents.names) - 1)
    nothing = np.zeros(len(contents), np.uint8)
    index = replace(
        scene.index,
        first=nothing,
        last=nothing,
        level_names=contents.names[-1:],
        replacement_offsets=np.zeros(len(contents) + 1, np.int64),
        replacement_ids=np.zeros(0, np.int32),
        sets=_Some(scene.index.sets, highest),
        sent=highest,
    )
    if index.active is not None:
        index = replace(index, active=_SomeTerms(scene.index, highest[scene.records.owners]))
    return scene.with_index(index)


def without_terms(scene: StreamedScene, sh_bytes: float) -> StreamedScene:
    """Return a scene without terms, in which each Gaussian is as large as one with SH coefficients.

    Args:
        scene: The scene.
        sh_bytes: Measured bytes of these coefficients.
    """
    if not (np.isfinite(sh_bytes) and sh_bytes >= 0):
        raise ValueError(f"sh_bytes: expected a finite number >= 0, got {sh_bytes!r}")
    n = len(scene)
    index = replace(
        scene.index,
        term_offsets=np.zeros(n + 1, np.int64),
        term_bytes=np.zeros(0, np.float32),
        active=None,
        cones=None,
        gaussian_bytes=np.full(n, RECORD_BYTES + sh_bytes, np.float32),
    )
    return scene.with_index(index)


class _Some(CellSets):
    """Visible sets, restricted to some Gaussians."""

    def __init__(self, sets: CellSets, some: NDArray[np.bool_]) -> None:
        self._sets = sets
        self._some = some

    def classes(self, cell: int) -> tuple[I64, NDArray[np.uint8]]:
        """Return ids and classes; see `CellSets`."""
        ids, classes = self._sets.classes(cell)
        kept = self._some[ids]
        return ids[kept], classes[kept]


class _SomeTerms:
    """Active terms, restricted to some."""

    def __init__(self, index: SceneIndex, some: NDArray[np.bool_]) -> None:
        assert index.active is not None
        self._active = index.active
        self._some = some

    def active_ids(self, cell: int) -> I64:
        """Return ids; see `ActiveSets`."""
        ids = self._active.active_ids(cell)
        return ids[self._some[ids]]


class _FullSh(Adaptive):
    """Our stream with the SH coefficients of each Gaussian beside its record, and no terms.

    The session measures the link by the bytes of its messages, which have no coefficients. Both grow alike, so that its
    window and the size of its messages keep their seconds. Images are those of all terms: the same quality as ours.
    """

    def __init__(self, scene: StreamedScene, view: FieldOfView, config: AbrConfig, sh_bytes: float) -> None:
        share = RECORD_BYTES / (RECORD_BYTES + sh_bytes)
        super().__init__(scene, view, replace(config, start_rate=config.start_rate * share), name="gsvis without terms")
        self._contents = scene.contents
        self._sh_bytes = sh_bytes

    def next(self, t: float) -> Parcel | None:
        """Return the next parcel with its coefficients; see `Delivery`."""
        parcel = super().next(t)
        if parcel is None:
            return None
        more = int(np.ceil(self._sh_bytes * len(parcel.gaussians)))
        ids = np.sort(parcel.gaussians).astype(np.int64)
        return replace(parcel, nbytes=parcel.nbytes + more, terms=terms_of(self._contents, ids))

    def describe(self) -> dict[str, Any]:
        """Return facts for reports; see `Delivery`."""
        return {**super().describe(), "sh_bytes": self._sh_bytes}
