"""Gaussians and levels as files of a graph: archives of arrays, and the order of rows by content.

Scene frame and units. Arrays are stored as they are, so what is read equals what was written to the last bit.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.files.limits import DAMAGED
from gsvis.io.facts import parse_facts, spell_facts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = [
    "box_of",
    "content_order",
    "flatten",
    "load_gaussians",
    "load_rows",
    "load_tile_levels",
    "median_spacing",
    "save_gaussians",
    "save_tile_levels",
]

_PROBED = 4096
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def save_gaussians(path: Path, g: Gaussians) -> None:
    """Write a scene and what is known of it."""
    save_arrays(path, _arrays(g))


def load_gaussians(path: Path) -> Gaussians:
    """Return a scene that `save_gaussians` wrote.

    Raises:
        FormatError: If the file is damaged.
    """
    return _gaussians(path, load_arrays(path, sealed=True))


def save_tile_levels(path: Path, levels: Levels) -> None:
    """Write levels."""
    names = np.frombuffer("\n".join(levels.names).encode(), np.uint8)
    save_arrays(path, {**_arrays(levels.union), "first": levels.first, "last": levels.last, "names": names})


def load_tile_levels(path: Path) -> Levels:
    """Return levels that `save_tile_levels` wrote.

    Raises:
        FormatError: If the file is damaged.
    """
    found = load_arrays(path, sealed=True)
    try:
        names = found["names"].tobytes().decode().split("\n")
        return Levels(_gaussians(path, found), found["first"], found["last"], names)
    except (KeyError, ValueError) as error:
        raise FormatError(path, "", "levels", str(error), DAMAGED) from error


def load_rows(paths: list[Path]) -> Gaussians:
    """Return the Gaussians of several files as one scene, ordered by content.

    So the order does not depend on that of the files or of the rows in them.

    Raises:
        FormatError: If a file is damaged.
    """
    joined = Gaussians.concatenate([load_gaussians(path) for path in paths])
    return joined[content_order(joined)]


def content_order(g: Gaussians) -> NDArray[np.int64]:
    """Return (N,) the order of a scene by center, x first; where centers are equal, by everything else."""
    x, y, z = g.means.T
    order = np.lexsort((z, y, x))
    same = (g.means[order][1:] == g.means[order][:-1]).all(axis=1)
    tied = np.flatnonzero(np.append(same, False) | np.insert(same, 0, False))
    if len(tied) == 0:
        return order
    some = g[order[tied]]
    rows = np.concatenate([getattr(some, name).reshape(len(some), -1) for name in _ARRAYS], axis=1)
    order[tied] = order[tied][np.lexsort(rows.T[::-1])]
    return order


def median_spacing(g: Gaussians) -> float:
    """Return the median distance from a Gaussian to the nearest other one, of some thousands; 0 for a single one.

    The median extent of a Gaussian counts where it is larger: nothing finer than that is to be seen.
    """
    from scipy.spatial import cKDTree  # here: it takes long to import

    if len(g) < 2:
        return 0.0
    some = np.linspace(0, len(g) - 1, min(len(g), _PROBED)).astype(np.int64)
    means = g.means.astype(np.float64)
    near = cKDTree(means).query(means[some], k=2)[0][:, 1]
    return max(float(np.median(near)), float(np.median(np.sort(g.scales[some], axis=1)[:, 1])))


def flatten(g: Gaussians) -> Gaussians:
    """Return a scene with SH degree 0."""
    return g if g.sh_degree == 0 else replace(g, shN=g.shN[:, :0])


def box_of(means: NDArray[np.float32]) -> dict[str, list[float]]:
    """Return the corners `low` and `high` of the box around centers (N, 3), for JSON."""
    low = means.min(axis=0).astype(np.float64)
    high = means.max(axis=0).astype(np.float64)
    return {"low": low.tolist(), "high": high.tolist()}


def _arrays(g: Gaussians) -> dict[str, NDArray[Any]]:
    """Return the arrays of a scene by name, and what is known of it as the bytes of a JSON text."""
    facts = np.frombuffer((spell_facts(g.facts) or "{}").encode(), np.uint8)
    return {**{name: getattr(g, name) for name in _ARRAYS}, "facts": facts}


def _gaussians(path: Path, found: dict[str, NDArray[Any]]) -> Gaussians:
    try:
        facts = parse_facts(found["facts"].tobytes())
        return Gaussians(*(found[name] for name in _ARRAYS), facts=facts)
    except (KeyError, ValueError) as error:
        raise FormatError(path, "", "a scene", str(error), DAMAGED) from error
