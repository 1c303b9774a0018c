"""Draw maps of a scene from above: which Gaussians a view needs, and from how many directions each is visible.

From above means along the up axis, whatever axis of the scene it is; map coordinates are scene units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm, Normalize, to_rgb
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import Formatter, MaxNLocator, PercentFormatter
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.pvs.cells import CellGrid
from gsvis.raycast import directions
from gsvis.raycast.analysis import Analysis
from gsvis.report.plan import axes_from_above
from gsvis.report.theme import Theme
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["CellMap", "Ground", "draw_cells", "draw_directions", "draw_seen_map"]

F64 = NDArray[np.float64]

_CELLS = 420  # along the longer side, at most


@dataclass(frozen=True, eq=False)
class Ground:
    """The plane of a map.

    Attributes:
        right: (3,) unit vector to the right of the map.
        onward: (3,) unit vector to the top of the map; right x onward is up.
        places: (N, 2) centers of the Gaussians on the map, scene units.
        box: (2, 2) lowest and highest corner of the map.
    """

    right: F64
    onward: F64
    places: F64
    box: F64

    @classmethod
    def from_scene(cls, g: Gaussians, up: ArrayLike, eyes: ArrayLike | None = None) -> Ground:
        """Return the map of a scene, N > 0.

        Args:
            g: The scene.
            up: (3,) up axis.
            eyes: (C, 3) viewpoints that the map must cover, even outside the scene's robust bounds.
        """
        axis = _check.unit_vectors("up", np.reshape(np.asarray(up, np.float64), (1, -1)))[0]
        right, onward = axes_from_above(axis)
        frame = np.stack([right, onward])
        places = g.means.astype(np.float64) @ frame.T
        low, high = np.quantile(places, [0.01, 0.99], axis=0)
        if eyes is not None:
            standing = _check.floats("eyes", eyes, ("C", 3), np.float64) @ frame.T
            low = np.minimum(low, standing.min(axis=0))
            high = np.maximum(high, standing.max(axis=0))
        margin = 0.04 * max(float((high - low).max()), 1e-9)
        return cls(right, onward, places, np.stack([low - margin, high + margin]))

    def project(self, points: F64) -> F64:
        """Return (M, 2) map coordinates of (M, 3) points."""
        return np.asarray(points @ np.stack([self.right, self.onward]).T)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in inches of a plot of at most 5.2 inches."""
        width, height = self.box[1] - self.box[0]
        return 5.2, float(np.clip(5.2 * height / width, 2.2, 6.5))

    @property
    def size_with_bar(self) -> tuple[float, float]:
        """Width and height in inches of a map with a color bar beside it."""
        width, height = self.box[1] - self.box[0]
        return 5.2, float(np.clip(3.3 * height / width + 0.6, 2.2, 6.5))


@dataclass(frozen=True, eq=False)
class CellMap:
    """Values of cells for a map.

    Attributes:
        grid: C cells.
        values: (C,) value behind the color; NaN if unknown.
        label: Name of the values.
        low: Value of the darkest color.
        high: Value of the brightest.
        logarithmic: Whether the color scale is logarithmic.
        ticks: Format of values; None means plain numbers.
        unknown: Label of cells without a value.
    """

    grid: CellGrid
    values: F64
    label: str
    low: float
    high: float
    logarithmic: bool = False
    ticks: Formatter | None = None
    unknown: str = "not measured"

    def columns(self, ground: Ground) -> tuple[F64, F64]:
        """Return (P, 4, 2) corners of squares on a map, and (P,) the largest value of the cells in each; NaN if none.

        Cells above each other share one square: those whose middles are nearest to its own. Where up is oblique, these
        are not rows of the grid.

        Args:
            ground: The map.
        """
        middles = ground.project(self.grid.centers)
        low = middles.min(axis=0)
        lattice = np.rint((middles - low) / self.grid.cell_size).astype(np.int64)
        places, column = np.unique(lattice, axis=0, return_inverse=True)
        most = np.full(len(places), -np.inf)
        known = np.isfinite(self.values)
        np.maximum.at(most, column.reshape(-1)[known], self.values[known])
        corners = places[:, None, :] + np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        return low + self.grid.cell_size * corners, np.where(np.isfinite(most), most, np.nan)


def draw_cells(axes: Axes, theme: Theme, ground: Ground, cells: CellMap) -> None:
    """Draw the cells from above in the colors of their values, with the scene's walls as shadows over them."""
    squares, values = cells.columns(ground)
    known = np.isfinite(values)
    edges: dict[str, Any] = {"edgecolors": theme.paper, "linewidths": 0.6}
    if not known.all():
        axes.add_collection(PolyCollection(list(squares[~known]), facecolors=theme.hidden, alpha=0.55, **edges))
        patch = Patch(facecolor=theme.hidden, alpha=0.55, label=cells.unknown)
        axes.figure.legend(handles=[patch], loc="outside upper center")
    norm = (LogNorm if cells.logarithmic else Normalize)(cells.low, cells.high, clip=True)
    drawn = PolyCollection(list(squares[known]), array=values[known], cmap="viridis", norm=norm, **edges)
    axes.add_collection(drawn)
    extent, count, _ = _raster(ground, np.zeros(len(ground.places), bool))
    dense = np.clip(count / max(float(np.quantile(count[count > 0], 0.98)), 1.0), 0.0, 1.0) if count.any() else count
    shadow = np.concatenate([np.broadcast_to(to_rgb(theme.ink), (*dense.shape, 3)), 0.8 * dense[..., None]], axis=2)
    axes.imshow(shadow, extent=extent, origin="lower", interpolation="nearest", aspect="equal", zorder=3)
    bar = axes.figure.colorbar(drawn, ax=axes, shrink=0.9, pad=0.02, format=cells.ticks)
    bar.set_label(cells.label, color=theme.ink)
    bar.outline.set_visible(False)
    _frame(axes, ground)


def draw_seen_map(axes: Axes, theme: Theme, ground: Ground, visible: NDArray[np.bool_], camera: Cameras) -> None:
    """Draw the scene from above with the camera: what it sees in color, the rest in gray.

    Args:
        axes: Axes to draw on.
        theme: Colors.
        ground: The map.
        visible: (N,) whether the camera sees each Gaussian.
        camera: One camera.
    """
    extent, count, seen = _raster(ground, visible)
    share = seen / np.maximum(count, 1.0)
    strength = np.log1p(count) / np.log1p(max(np.quantile(count[count > 0], 0.95), 1.0)) if count.any() else count
    strength = np.where(count > 0, np.clip(0.4 + 0.6 * strength, 0.0, 1.0), 0.0)[..., None]
    hue = np.sqrt(share)[..., None]  # keeps a few visible Gaussians among many recognizable
    color = hue * to_rgb(theme.gathered) + (1.0 - hue) * np.asarray(to_rgb(theme.hidden))
    image = strength * color + (1.0 - strength) * np.asarray(to_rgb(theme.paper))
    axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", aspect="equal")
    _draw_camera(axes, theme, ground, camera)
    _frame(axes, ground)


def draw_directions(axes: Axes, theme: Theme, ground: Ground, analysis: Analysis) -> None:
    """Draw the traced sample from above, colored by the share of directions from which each Gaussian is visible."""
    fractions = directions.direction_fractions(analysis.traced_sets)
    places = ground.places[analysis.sample]
    order = np.argsort(fractions, kind="stable")
    x, y = places[order].T
    dots = axes.scatter(x, y, c=fractions[order], s=5, cmap="viridis", vmin=0.0, vmax=1.0, linewidths=0)
    bar = axes.figure.colorbar(dots, ax=axes, shrink=0.8, pad=0.02, format=PercentFormatter(1.0))
    bar.set_label("directions it can be seen from", color=theme.ink)
    bar.outline.set_visible(False)
    axes.set_aspect("equal")
    _frame(axes, ground)


def _raster(ground: Ground, visible: NDArray[np.bool_]) -> tuple[tuple[float, float, float, float], F64, F64]:
    """Return the extent of the map, and the Gaussians and visible Gaussians in each of its cells."""
    low, high = ground.box
    cell = float((high - low).max()) / np.clip(0.6 * len(visible) ** 0.5, 60, _CELLS)
    cells = np.maximum(np.ceil((high - low) / cell).astype(int), 1)
    inside = np.all((ground.places >= low) & (ground.places < high), axis=1)
    at = np.minimum(((ground.places[inside] - low) / cell).astype(int), cells - 1)
    flat = at[:, 1] * cells[0] + at[:, 0]
    size = int(cells.prod())
    shape = (int(cells[1]), int(cells[0]))
    count, seen = (
        np.bincount(flat, weights=weights, minlength=size).reshape(shape).astype(np.float64)
        for weights in (np.ones(len(flat)), visible[inside].astype(np.float64))
    )
    end = low + cells * cell
    gaps = _find_gaps(count > 0)
    return (float(low[0]), float(end[0]), float(low[1]), float(end[1])), _bridge(count, gaps), _bridge(seen, gaps)


def _find_gaps(filled: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (H, W) empty cells between two filled neighbors: where rows of Gaussians lie wider apart than cells."""
    padded = np.pad(filled, 1)
    upright = padded[:-2, 1:-1] & padded[2:, 1:-1]
    level = padded[1:-1, :-2] & padded[1:-1, 2:]
    return ~filled & (upright | level)


def _bridge(values: F64, gaps: NDArray[np.bool_]) -> F64:
    """Return the values with the mean of the four neighbors in gaps."""
    padded = np.pad(values, 1)
    around = (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]) / 4.0
    return np.where(gaps, around, values)


def _draw_camera(axes: Axes, theme: Theme, ground: Ground, camera: Cameras) -> None:
    """Draw a dot at the camera and a wedge over its horizontal field of view."""
    eye = ground.project(camera.viewpoints)[0]
    focal = camera.Ks[0, 0, 0]
    center = camera.Ks[0, 0, 2]
    reach = 0.16 * float((ground.box[1] - ground.box[0]).max())
    rotation = camera.viewmats[0, :3, :3]
    corners = [eye]
    for x in np.linspace(-center / focal, (camera.width - center) / focal, 9):
        sight = ground.project((np.array([x, 0.0, 1.0]) @ rotation)[None])[0]
        length = float(np.linalg.norm(sight))
        corners.append(eye + reach * sight / max(length, 1e-9))
    axes.add_patch(Polygon(corners, closed=True, facecolor=theme.traced, alpha=0.28, edgecolor="none", zorder=3))
    edges = np.array([corners[1], eye, corners[-1]])
    axes.plot(*edges.T, color=theme.traced, linewidth=1.4, zorder=4)
    axes.plot(*eye, marker="o", markersize=6, color=theme.traced, markeredgecolor=theme.paper, zorder=5)


def _frame(axes: Axes, ground: Ground) -> None:
    """Set limits, ticks and labels of a map of the ground."""
    (left, bottom), (right, top) = ground.box
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.grid(visible=False)
    for locator in (axes.xaxis, axes.yaxis):
        locator.set_major_locator(MaxNLocator(5))
    axes.set_xlabel(f"{_name_axis(ground.right)}, scene units")
    axes.set_ylabel(f"{_name_axis(ground.onward)}, scene units")


def _name_axis(direction: F64) -> str:
    """Return 'x' or '-z' for an axis of the scene, 'across' for anything oblique."""
    which = int(np.abs(direction).argmax())
    if abs(direction[which]) < 0.999:
        return "across"
    return ("-" if direction[which] < 0 else "") + "xyz"[which]
