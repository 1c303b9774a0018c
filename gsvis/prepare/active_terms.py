"""Find the terms that each cell of a PVS needs (equation 7 of the paper); `gsvis.package.active_terms` stores them."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from gsvis.color.activation import Activation
from gsvis.color.srbf import SrbfColors
from gsvis.package.active_terms import ActiveTerms, ActiveTermsInfo, colors_hash, sets_hash, write_active_terms
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians

__all__ = ["build_active_terms", "list_package_terms", "most_weights"]


def build_active_terms(
    colors: SrbfColors,
    g: Gaussians,
    store: VisibilityStore,
    epsilon: float,
    path: str | PathLike[str],
    *,
    weighted: bool = False,
    provenance: str = "given",
    progress: Progress = silent,
) -> ActiveTerms:
    """Find the terms that each cell of a PVS needs, and write them.

    A cell needs terms only of the Gaussians that it sees. A term belongs to a cell if it may be active for some eye in
    the box of the cell, so no active term is missing (`Activation.active_in_box`).

    Args:
        colors: Colors of the N Gaussians.
        g: The scene.
        store: Visible sets of the scene.
        epsilon: Contribution above which a term is active, >= 0.
        path: The file to write, suffix `.terms.arrow`; it is written atomically.
        weighted: Multiply contributions by the largest blending weight that the Gaussian's class in the cell allows.
            Epsilon is then a change of a pixel, not of a Gaussian, and fewer terms are active.
        provenance: Where epsilon comes from; stored in the file.
        progress: Called with stage "terms".

    Returns:
        The open store of active terms.

    Raises:
        ValueError: If lengths differ or epsilon is out of range.
        FormatError: If the visible sets belong to another scene, or are damaged.
        OSError: If the file cannot be written; an older file at the path stays.

    References:
        SRBF-Gaussian, section 6.2.
    """
    if len(colors) != len(g):
        raise ValueError(f"colors: expected those of {len(g):,} Gaussians, got {len(colors):,}")
    if colors.num_terms >= 1 << 32:
        raise ValueError(f"colors: expected fewer than 2^32 terms, got {colors.num_terms}; keep the first of each")
    store.check_scene(g)
    activation = Activation(colors, g.means, epsilon)
    write_active_terms(
        path,
        _describe(activation, store, str(provenance), bool(weighted)),
        _cells(activation, store, weighted, progress),
    )
    return ActiveTerms(path)


def list_package_terms(
    g: Gaussians,
    colors: SrbfColors,
    store: VisibilityStore,
    epsilon: float,
    path: str | PathLike[str],
    *,
    progress: Progress = silent,
) -> None:
    """Write the terms that each cell of a package needs, the same as `CellTerms` computes from the package.

    Args:
        g: N Gaussians as a client decodes them, so that centers are rounded.
        colors: Their colors, rounded.
        store: The visible sets of the package.
        epsilon: Contribution above which a term is active, >= 0.
        path: The file to write; it is written atomically.
        progress: Called with stage "terms".

    Raises:
        ValueError: If lengths differ or epsilon is out of range.
        OSError: If the file cannot be written.

    References:
        SRBF-Gaussian, section 6.2.
    """
    activation = Activation(colors, g.means, epsilon)
    info = _describe(activation, store, "the package", False)
    write_active_terms(path, info, _cells(activation, store, False, progress))


def _describe(activation: Activation, store: VisibilityStore, provenance: str, weighted: bool) -> ActiveTermsInfo:
    """Return the sources of lists of active terms."""
    colors = activation.colors
    return ActiveTermsInfo(
        len(store),
        colors.num_terms,
        len(colors),
        colors.variant,
        activation.epsilon,
        provenance,
        weighted,
        store.info.scene,
        colors_hash(colors),
        sets_hash(store),
    )


def most_weights(store: VisibilityStore, cell: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the (V,) ids that a cell sees, ascending, and the (V,) upper weight of the class of each."""
    ids, classes = store.classes(cell)
    ends = [store.class_interval(level)[1] for level in range(len(store.info.class_edges))]
    return ids, np.asarray(ends, np.float32)[classes]


def _cells(
    activation: Activation, store: VisibilityStore, weighted: bool, progress: Progress
) -> Iterator[tuple[NDArray[np.uint32], int]]:
    """Yield the active terms of each cell, and the number of terms of the Gaussians that it sees."""
    counts = activation.colors.counts
    progress("terms", 0, len(store))
    for cell in range(len(store)):
        ids, weights = most_weights(store, cell) if weighted else (store.visible_ids(cell), None)
        mask = activation.active_in_box(*store.grid.bounds(cell), ids, weights)
        yield np.flatnonzero(mask).astype(np.uint32), int(counts[ids].sum())
        progress("terms", cell + 1, len(store))
