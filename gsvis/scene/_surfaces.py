"""Build opaque rectangles with holes and spheres from flat Gaussians, and decide what they certainly hide.

A surface is a lattice of overlapping thin discs with opacity 0.995. Hardly any light passes: less than 1/2550 on
straight lines through a rectangle more than a lattice step off its rim, less than 1/500 through a sphere. Each verdict
is geometry alone: a segment from eye to center against the surface, with margins for soft rims and for the extent of
the target Gaussian. Frame and units are the scene's own; color plays no part.

On a flat sheet, a line to one disc's center meets all neighbors at nearly the same depth. Whatever the order of these
depths, about half of the neighbors come first, and the disc keeps some 6% of the light. On a sphere seen from outside,
all planes of the neighbors come first. Spheres therefore use smaller discs, so that a disc keeps 1%.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import quats_from_rotations

__all__ = ["Patch", "Sheet", "Shell", "Surface"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Pair = tuple[float, float]
Triple = tuple[float, float, float]

OPACITY = 0.995
WIDTH = 0.95  # standard deviation of a disc, in lattice steps
SPHERE_WIDTH = 0.87  # the same on spheres
THICKNESS = 0.02  # the same across the sheet
REACH = 3.4  # standard deviations at which alpha has fallen below 1/255
OFFSETS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.4])[
    :, None
]  # standard deviations off a center, to look past a rim
CLEAR = 1.2  # lattice steps off a rim from which a sheet no longer dims enough to matter
# Least optical depth by lattice steps inside a rim; the true depth is 4.3 on the rim and 7.7 one step inside.
RIM_STEPS = (-1.5, -1.0, 0.0, 1.0)
RIM_DEPTHS = (0.0, 0.3, 3.4, 7.0)
SPENT = 6.0  # optical depth behind which everything is hidden: 0.6 of what 1/255 allows
GRAZING = 0.08  # least cosine between a line and a normal for a verdict of visible
GRAZING_SPHERE = 0.12


def _largest_sigma(covars: F64) -> F64:
    """Return (M,) upper bounds of the largest standard deviation; for a disc at most 1.2 times it."""
    return np.asarray(np.einsum("mij,mij->m", covars, covars) ** 0.25)


@dataclass(frozen=True)
class Patch:
    """Discs of one surface: (M, 3) means, (M, 4) quats (third axis is the normal), (M, 3) scales, (M, 3) normals."""

    means: F64
    quats: F64
    scales: F64
    normals: F64


@dataclass(frozen=True)
class Sheet:
    """A rectangle perpendicular to one axis, with rectangular holes.

    Args:
        axis: 0, 1 or 2, the normal.
        at: Position on that axis.
        low: Lowest corner on the other two axes, in order.
        high: Highest corner.
        holes: (low, high) pairs of corners; `snapped` has them on the lattice.
        step: Requested lattice step; the actual two divide the sides.
    """

    axis: int
    at: float
    low: Pair
    high: Pair
    step: float
    holes: tuple[tuple[Pair, Pair], ...] = ()

    @property
    def across(self) -> list[int]:
        """The two axes in the plane of the sheet."""
        return [i for i in range(3) if i != self.axis]

    @property
    def cells(self) -> NDArray[np.int64]:
        """(2,) lattice cells along the sides."""
        return np.asarray(np.maximum(np.round(np.subtract(self.high, self.low) / self.step), 1), np.int64)

    @property
    def steps(self) -> F64:
        """(2,) actual lattice steps."""
        return np.asarray(np.subtract(self.high, self.low) / self.cells)

    @property
    def snapped(self) -> list[tuple[F64, F64]]:
        """The holes with their rims moved to the nearest lattice lines."""
        low = np.array(self.low)
        steps = self.steps
        return [
            (low + np.round((a - low) / steps) * steps, low + np.round((b - low) / steps) * steps)
            for a, b in self.holes
        ]

    @property
    def count(self) -> int:
        """Number of discs."""
        return len(self._middles())

    def _middles(self) -> F64:
        """Return the middles (M, 2) of the cells outside holes."""
        u, v = (a + (np.arange(n) + 0.5) * s for a, n, s in zip(self.low, self.cells, self.steps, strict=True))
        flat = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
        for low, high in self.snapped:
            flat = flat[~np.all((flat > low) & (flat < high), axis=1)]
        return np.asarray(flat)

    def patch(self) -> Patch:
        """Return the discs, one in the middle of each cell that is not in a hole."""
        flat = self._middles()
        means = np.full((len(flat), 3), self.at)
        means[:, self.across] = flat
        frame = np.eye(3)[:, [*self.across, self.axis]]
        if np.linalg.det(frame) < 0:
            frame[:, 0] *= -1.0
        scales = np.append(WIDTH * self.steps, THICKNESS * self.steps.min())
        return Patch(
            means,
            np.tile(quats_from_rotations(frame[None]), (len(flat), 1)),
            np.tile(scales, (len(flat), 1)),
            np.tile(np.eye(3)[self.axis], (len(flat), 1)),
        )

    def depth_inside(self, flat: F64) -> F64:
        """Return (M,) distances from the nearest rim of (M, 2) points of the plane, negative off the sheet."""
        depth = np.minimum(flat - self.low, self.high - flat).min(axis=1)
        for low, high in self.snapped:
            depth = np.minimum(depth, np.maximum(low - flat, flat - high).max(axis=1))
        return np.asarray(depth)

    def verdict(self, eye: F64, means: F64, covars: F64) -> tuple[F64, Mask]:
        """Return the least optical depth before each of (M, 3) centers seen from `eye`, and whether it is certainly 0.

        The depth is (K, M): on lines that pass the center at each of the K `OFFSETS`, on the side of the nearest rim.

        Args:
            eye: (3,) viewpoint.
            means: (M, 3) centers of Gaussians of other surfaces.
            covars: (M, 3, 3) their covariances.
        """
        step = float(self.steps.max())
        axis = self.axis
        eye_side = eye[axis] - self.at
        side = means[:, axis] - self.at
        on_plane = np.abs(side) <= 4.0 * THICKNESS * step
        crossing = (eye_side * side < 0.0) & ~on_plane
        span = np.where(crossing, eye_side - side, 1.0)
        t = np.where(crossing, eye_side / span, 1.0)
        ray = means - eye
        depth = self.depth_inside((eye + t[:, None] * ray)[:, self.across])
        length = np.linalg.norm(ray, axis=1)
        shift = OFFSETS * t * _largest_sigma(covars) * length / np.abs(span)
        apart = np.abs(side) >= REACH * np.sqrt(covars[:, axis, axis])
        dims = np.where(crossing & apart, np.interp((depth - shift) / step, RIM_STEPS, RIM_DEPTHS), 0.0)
        steep = np.abs(ray[:, axis]) >= 0.05 * length
        clear = (~crossing & ~on_plane) | ((depth <= -CLEAR * step) & (steep | on_plane))
        return dims, clear

    def own_verdict(self, eye: F64, patch: Patch) -> tuple[F64, Mask]:
        """Return the verdict for its own discs: none hides another unless the line grazes the sheet."""
        ray = patch.means - eye
        return np.zeros((len(OFFSETS), len(ray))), np.abs(ray[:, self.axis]) >= GRAZING * np.linalg.norm(ray, axis=1)

    def distance(self, points: F64) -> F64:
        """Return (M,) distances of (M, 3) points: exact off the holes, a lower bound near them."""
        depth = np.minimum(self.depth_inside(points[:, self.across]), 0.0)
        return np.asarray(np.hypot(points[:, self.axis] - self.at, depth))


@dataclass(frozen=True)
class Shell:
    """A spherical surface.

    Args:
        center: Center, scene units.
        radius: > 0; the step shrinks if this is below 8 lattice steps.
        step: Requested lattice step.
    """

    center: Triple
    radius: float
    step: float

    @property
    def count(self) -> int:
        """Number of discs."""
        return int(np.ceil(4.0 * np.pi * self.radius**2 / min(self.step, self.radius / 8.0) ** 2))

    @property
    def real_step(self) -> float:
        """The root of the area of a disc's cell."""
        return float(np.sqrt(4.0 * np.pi * self.radius**2 / self.count))

    def patch(self) -> Patch:
        """Return the discs on a Fibonacci lattice."""
        n = self.count
        z = 1.0 - (2.0 * np.arange(n) + 1.0) / n
        turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(n)
        out = np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z], axis=1)
        east = np.stack([-np.sin(turn), np.cos(turn), np.zeros(n)], axis=1)
        frames = np.stack([east, np.cross(out, east), out], axis=2)
        scales = self.real_step * np.array([SPHERE_WIDTH, SPHERE_WIDTH, THICKNESS])
        return Patch(
            np.array(self.center) + self.radius * out, quats_from_rotations(frames), np.tile(scales, (n, 1)), out
        )

    @property
    def soft(self) -> float:
        """The largest distance that its discs reach out of the sphere."""
        reach = REACH * SPHERE_WIDTH * self.real_step
        return 0.5 * reach**2 / self.radius + 4.0 * THICKNESS * self.real_step

    def verdict(self, eye: F64, means: F64, covars: F64) -> tuple[F64, Mask]:
        """Return the verdict for other Gaussians; see `Sheet.verdict`."""
        start = eye - self.center
        ray = means - eye
        end = np.linalg.norm(means - self.center, axis=1)
        radial = (means - self.center) / np.maximum(end, 1e-12)[:, None]
        reach = REACH * np.sqrt(np.einsum("mi,mij,mj->m", radial, covars, radial))
        t = np.clip(-(ray @ start) / np.maximum(np.einsum("ij,ij->i", ray, ray), 1e-30), 0.0, 1.0)
        nearest = np.linalg.norm(start + t[:, None] * ray, axis=1)
        apart = np.abs(end - self.radius) >= reach + self.soft
        if np.linalg.norm(start) < self.radius:
            return SPENT * np.tile(apart & (end > self.radius), (len(OFFSETS), 1)), end <= self.radius - self.soft
        cut = self.radius * np.sqrt(1.0 - GRAZING_SPHERE**2)
        outside = end > self.radius
        hides = apart & (~outside | ((nearest <= cut - OFFSETS * t * _largest_sigma(covars)) & (t > 0.0) & (t < 1.0)))
        return SPENT * hides, outside & (nearest >= self.radius + self.soft)

    def own_verdict(self, eye: F64, patch: Patch) -> tuple[F64, Mask]:
        """Return the verdict for its own discs: from outside the near half hides the far half."""
        ray = patch.means - eye
        cosine = np.einsum("ij,ij->i", ray, patch.normals) / np.linalg.norm(ray, axis=1)
        if np.linalg.norm(eye - self.center) < self.radius:
            return np.zeros((len(OFFSETS), len(ray))), cosine >= GRAZING_SPHERE
        # A tail of length x sticks out above the sphere, so it is visible up to 2 x / radius behind the horizon.
        tail = OFFSETS * SPHERE_WIDTH * self.real_step * (2.0 / self.radius + 1.0 / np.linalg.norm(ray, axis=1))
        hides = np.arcsin(np.clip(cosine, -1.0, 1.0)) >= GRAZING_SPHERE + tail
        return SPENT * hides, cosine <= -GRAZING_SPHERE

    def distance(self, points: F64) -> F64:
        """Return (M,) distances of (M, 3) points."""
        return np.asarray(np.abs(np.linalg.norm(points - np.array(self.center), axis=1) - self.radius))


Surface = Sheet | Shell
