"""Save and load Gaussians and levels as results of tasks: archives of arrays, with rows ordered by content.

Scene frame and units. Arrays are stored without rounding, so loading gives the same bits.
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

_PROBED = 4096  # most Gaussians from which a spacing is measured
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def save_gaussians(path: Path, g: Gaussians) -> None:
    """Write a scene with its facts."""
    save_arrays(path, _arrays(g))


def load_gaussians(path: Path) -> Gaussians:
    """Return a scene that `save_gaussians` wrote.

    Raises:
        FormatError: If the file is damaged.
    """
    return _parse_gaussians(path, load_arrays(path, sealed=True))


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
        return Levels(_parse_gaussians(path, found), found["first"], found["last"], names)
    except (KeyError, ValueError) as error:
        raise FormatError(path, "", "levels", str(error), DAMAGED) from error


def load_rows(paths: list[Path]) -> Gaussians:
    """Return the Gaussians of several files as one scene, ordered by content, whatever the order of files and rows.

    Raises:
        FormatError: If a file is damaged.
    """
    joined = Gaussians.concatenate([load_gaussians(path) for path in paths])
    return joined[content_order(joined)]


def content_order(g: Gaussians) -> NDArray[np.int64]:
    """Return the order (N,) of a scene by center, x first; equal centers are ordered by all other values."""
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
    """Return the median distance from a Gaussian to its nearest neighbor, from a few thousand; 0 for one Gaussian.

    If the median extent of a Gaussian is larger, return that: finer details are not visible.
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
    """Return the arrays of a scene by name, and its facts as the bytes of a JSON text."""
    facts = np.frombuffer((spell_facts(g.facts) or "{}").encode(), np.uint8)
    return {**{name: getattr(g, name) for name in _ARRAYS}, "facts": facts}


def _parse_gaussians(path: Path, found: dict[str, NDArray[Any]]) -> Gaussians:
    """Return the scene in the arrays of an archive; raise FormatError if it is damaged."""
    try:
        facts = parse_facts(found["facts"].tobytes())
        return Gaussians(*(found[name] for name in _ARRAYS), facts=facts)
    except (KeyError, ValueError) as error:
        raise FormatError(path, "", "a scene", str(error), DAMAGED) from error
