"""Gather evidence on each Gaussian by rays: whether eyes see it, from where, and whether it lies in air.

Scene frame and units; decisive lengths are measured in voxels of a grid over the scene. Eyes are viewpoints of
navigable space and of photographs, if any. A voxel is *air* if it connects with the outside or with light from eyes,
and no surface is near. This module knows no class.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis.edit._kernels import air as kernels
from gsvis.edit.shape import FEW, Shape, affordable_resolution, find_surfaces
from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.scene.density import MOST_RESOLUTION, Density
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import face_directions
from gsvis.scene.inspection import MIN_ALPHA
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import Solid

if TYPE_CHECKING:
    from gsvis.edit.classes import CleanConfig

__all__ = ["Air", "Evidence", "find_air", "gather_evidence", "part_of_backdrop"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

STOPS = float(np.log(2.0))  # optical depth at which a ray ends
CLOSED = 0.29  # optical depth of a voxel that closes a wall: a quarter of the light
REACH = 4.0  # distance in voxels within which Gaussians count as neighbors
BACKDROP = 0.05  # share of a direction's solid angle that Gaussians far outside must cover to be a backdrop
_EYES = 512  # least number of eyes that find air
_FINE = 0.4  # voxels of air in those of a space that was found in parcels, as where both grids are over all of a scene
_RAYS = 8_000_000  # most outward rays for a second test of hidden Gaussians
_SAMPLES = 32  # sample points of the mass of a Gaussian


@dataclass(frozen=True, eq=False)
class Air:
    """The air and the surfaces of a scene, and eyes in the air.

    Attributes:
        origin: (3,) lowest corner of voxel (0, 0, 0), scene frame.
        voxel_size: Side of a voxel, scene units.
        labels: (X, Y, Z) uint8, 1 for open air away from surfaces, 2 at a surface, else 0.
        open_air: (X, Y, Z) voxels that open air touches.
        eyes: (E, 3) viewpoints outside everything solid.
    """

    origin: F64
    voxel_size: float
    labels: NDArray[np.uint8]
    open_air: Mask
    eyes: F64


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence on each of N Gaussians.

    Attributes:
        seen: (N,) whether an eye sees it, in a look around or on an outward ray to navigable space.
        faces: (N,) uint8, number of the 80 directions from which eyes see it.
        air: (N,) float32 in [0, 1], share of its mass in air, relative to its mass in air and at surfaces; 0 in a scene
            without surfaces.
        alone: (N,) whether at least half of its mass is in air and few others are near.
        large: (N,) whether it is wide compared with the scene.
        far: (N,) whether it lies far outside of the scene.
        backdrop: (N,) whether it lies far outside and is part of a backdrop that fills its direction.
        enclosed: (N,) whether no open air reaches the voxels around it.
        opacities: (N,) in [0, 1].
        voxel_size: Side of a voxel of the grid, scene units.
        eyes: Number of viewpoints that looked around.
    """

    seen: Mask
    faces: NDArray[np.uint8]
    air: F32
    alone: Mask
    large: Mask
    far: Mask
    backdrop: Mask
    enclosed: Mask
    opacities: F32
    voxel_size: float
    eyes: int


def gather_evidence(
    g: Gaussians,
    shape: Shape,
    navigable: NavigableSpace,
    config: CleanConfig,
    *,
    viewpoints: F64 | None = None,
    air: Air | None = None,
    judged: int | None = None,
    progress: Progress = silent,
) -> Evidence:
    """Gather the evidence on each Gaussian.

    Haze and Gaussians far outside hide nothing here, because they may be removed.

    Args:
        g: The scene, N Gaussians.
        shape: Its shape.
        navigable: Allowed viewpoints.
        config: Number of eyes, size of their faces, strength.
        viewpoints: (V, 3) further eyes, such as those of photographs.
        air: The air and the eyes of a larger scene that contains `g`; None finds those of `g`.
        judged: Number of first Gaussians for which evidence is needed, None for all; the others only hide.
        progress: Called with stages "air", "viewpoints", "structure" and "directions".
    """
    count = len(g) if judged is None else judged
    ids = np.flatnonzero(shape.core & (g.opacities >= MIN_ALPHA))
    core = g[ids]
    if len(core) == 0:
        raise SceneError("the scene has nothing but haze and Gaussians far outside: no surface is left to look at")
    progress("air", 0, 1)
    if air is None:
        given = np.zeros((0, 3)) if viewpoints is None else viewpoints
        air = find_air([core], shape.low, shape.high, navigable, config, given)
    shares, met = _shares_in_air(g, air)
    voxels, within = _voxels_of(g.means, air)
    enclosed = within & ~air.open_air[tuple(voxels.T)]
    progress("air", 1, 1)
    seen = np.zeros(len(g), bool)
    faces = np.zeros(len(g), np.uint8)
    seen[ids], faces[ids] = _look(core, air.eyes, config, progress)
    rest = np.flatnonzero(~seen[ids] & (ids < count))
    seen[ids[rest]] = _look_outward(core, navigable, rest, config.tau, progress)
    hazy = ~shape.core & ~shape.far & (g.opacities >= MIN_ALPHA)
    seen[hazy] = met[hazy]  # light reaches it
    far = np.flatnonzero(shape.far)
    backdrop = np.zeros(len(g), bool)
    backdrop[far] = part_of_backdrop(g[far], 0.5 * (shape.low + shape.high))
    some = slice(count)
    return Evidence(
        seen=seen[some],
        faces=faces[some],
        air=shares[some],
        alone=_find_alone(g[some], core, air.voxel_size, shares[some], config.strength),
        large=shape.large[some],
        far=shape.far[some],
        backdrop=backdrop[some],
        enclosed=enclosed[some],
        opacities=g.opacities[some],
        voxel_size=air.voxel_size,
        eyes=len(air.eyes),
    )


def find_air(
    parts: Iterable[Gaussians], low: F64, high: F64, navigable: NavigableSpace, config: CleanConfig, given: F64
) -> Air:
    """Find the air of a scene, and eyes in it.

    Args:
        parts: The core of the scene, part by part; iterated over three times, one part in memory at a time.
        low: (3,) lowest corner of the robust box.
        high: (3,) highest corner.
        navigable: Allowed viewpoints.
        config: Number of eyes, resolution, strength, seed.
        given: (V, 3) further eyes.

    Raises:
        SceneError: If all eyes lie inside something solid.
    """
    from scipy import ndimage

    rng = np.random.default_rng([config.seed, 1])
    density, passed = _find_passed(parts, low, high, navigable, given, config, rng)
    open_air = _open_air(density, passed)
    surface = find_surfaces(parts, density, config.strength)
    near = ndimage.binary_dilation(surface, np.ones((3, 3, 3), bool))
    labels = np.where(near, np.uint8(2), open_air.astype(np.uint8))
    drawn = navigable.sample_viewpoints(4 * config.eyes, rng)
    solid = np.zeros(len(drawn), bool)
    for part in parts:
        solid |= Solid.from_scene(part).buries(drawn)
    eyes = np.concatenate([drawn[~solid][: config.eyes], given])
    if len(eyes) == 0:
        raise SceneError("all viewpoints drawn in navigable space lie inside something solid; say where eyes belong")
    return Air(density.origin, density.voxel_size, labels, open_air, eyes)


def _find_passed(
    parts: Iterable[Gaussians],
    low: F64,
    high: F64,
    navigable: NavigableSpace,
    given: F64,
    config: CleanConfig,
    rng: np.random.Generator,
) -> tuple[Density, Mask]:
    """Return a grid over the scene and navigable space, and (X, Y, Z) its voxels that light from eyes enters.

    Navigable space itself is lit, because eyes may be anywhere in it. If it was found in parcels, the grid is fine
    enough for their rooms.
    """
    voxels = np.argwhere(navigable.free)
    corners = navigable.origin + navigable.voxel_size * np.stack([voxels.min(axis=0), voxels.max(axis=0) + 1])
    low = np.minimum(low, corners[0])
    high = np.maximum(high, corners[1])
    resolution = config.resolution
    longest = float((high - low).max())
    if navigable.parcels > 1:
        resolution = max(resolution, int(np.ceil(longest / (_FINE * navigable.voxel_size))))
    resolution = affordable_resolution(high - low, min(resolution, MOST_RESOLUTION))
    margin = 2.0 * float((high - low).max()) / resolution
    density = Density.from_parts(parts, low - margin, high + margin, resolution)
    eyes = np.concatenate([navigable.sample_viewpoints(max(_EYES, config.eyes), rng), given])
    directions = np.ascontiguousarray(face_directions(16).reshape(-1, 3))
    x, y, z = density.depth.shape
    passed = np.zeros((x, y, z), bool)
    block, free, _ = navigable.on_grid(density.origin, density.voxel_size, (x, y, z))
    passed[block] = free  # known without rays
    starts = np.ascontiguousarray((eyes - density.origin) / density.voxel_size)
    kernels.mark_passed(density.depth, starts, directions, STOPS, passed)
    return density, passed


def _voxels_of(points: NDArray[np.float32], air: Air) -> tuple[NDArray[np.int64], Mask]:
    """Return the voxels (P, 3) of points (P, 3), 0 off the grid, and (P,) whether they lie on the grid."""
    with np.errstate(over="ignore"):
        places = (points.astype(np.float64) - air.origin) / air.voxel_size
    within = np.all((places >= 0.0) & (places < air.labels.shape), axis=1)
    return np.where(within[:, None], places, 0.0).astype(np.int64), within


def _shares_in_air(g: Gaussians, air: Air) -> tuple[F32, Mask]:
    """Return (N,) shares of the mass in air, and (N,) whether any mass is in air or at a surface.

    Without any surface all shares are 0.
    """
    points = np.random.default_rng(0).normal(size=(_SAMPLES, 3))
    points[0] = 0.0
    counts = np.empty((len(g), 3), np.int32)
    step = 1 << 17
    for start in range(0, len(g), step):
        part = g[start : start + step]
        axes = part.rotations() * np.minimum(part.scales / air.voxel_size, 1e6)[:, None, :]
        means = (part.means.astype(np.float64) - air.origin) / air.voxel_size
        kernels.count_places(means, np.ascontiguousarray(axes), points, air.labels, counts[start : start + step])
    known = counts[:, 1] + counts[:, 2]
    in_air = counts[:, 1] if np.any(air.labels == 2) else np.zeros(len(g), np.int32)
    return (in_air / np.maximum(known, 1)).astype(np.float32), known > 0


def _find_alone(g: Gaussians, core: Gaussians, voxel_size: float, shares: F32, strength: float) -> Mask:
    """Return (N,) Gaussians in air with few centers of the core around them."""
    from scipy.spatial import KDTree

    alone = shares >= 0.5
    ids = np.flatnonzero(alone)
    most = int(FEW * strength) + 1  # includes itself
    reach = REACH * voxel_size
    distances, _ = KDTree(core.means).query(g.means[ids], [most + 1], distance_upper_bound=reach)
    alone[ids] = ~np.isfinite(distances[:, 0])
    return alone


def _open_air(density: Density, passed: Mask) -> Mask:
    """Return (X, Y, Z) voxels touched by open air, which connects with the outside or with light from eyes."""
    from scipy import ndimage

    labels, count = ndimage.label(density.depth < CLOSED)
    is_open = np.zeros(count + 1, bool)
    for axis in range(3):
        for end in (0, -1):
            is_open[np.take(labels, end, axis=axis)] = True
    is_open[labels[passed]] = True
    is_open[0] = False
    return np.asarray(ndimage.binary_dilation(is_open[labels] | passed, np.ones((3, 3, 3), bool)))


def _look(core: Gaussians, eyes: F64, config: CleanConfig, progress: Progress) -> tuple[Mask, NDArray[np.uint8]]:
    """Return whether eyes (E, 3) see each Gaussian (M,), and from how many of the 80 directions (M,)."""
    from gsvis.pvs.look import Look
    from gsvis.raycast.directions import face_of

    look = Look(core, "hybrid", config.size, config.tau)
    sets = np.zeros((len(core), 10), np.uint8)
    progress("viewpoints", 0, len(eyes))
    for done, eye in enumerate(eyes, 1):
        ids, weights = look(eye)
        ids = ids[weights > np.float32(config.tau)]  # doubtful Gaussians have exactly this weight; rays decide on them
        toward = eye - core.means[ids].astype(np.float64)
        toward[~toward.any(axis=1)] = (1.0, 0.0, 0.0)
        faces = face_of(toward)
        sets[ids, faces >> 3] |= (1 << (faces & 7)).astype(np.uint8)
        progress("viewpoints", done, len(eyes))
    return np.asarray(sets.any(axis=1)), np.unpackbits(sets, axis=1).sum(axis=1, dtype=np.uint8)


def _look_outward(
    core: Gaussians, navigable: NavigableSpace, ids: NDArray[np.int64], tau: float, progress: Progress
) -> Mask:
    """Return a mask (M,): whether an eye in navigable space sees each of the Gaussians ids (M,), by outward rays."""
    from gsvis.raycast import EllipsoidProxies, Tracer
    from gsvis.raycast.directions import seen_from_space

    if len(ids) == 0:
        return np.zeros(0, bool)
    progress("structure", 0, 1)
    tracer = Tracer(EllipsoidProxies.from_scene(core))
    _ = tracer.hierarchy
    progress("structure", 1, 1)
    seen = np.zeros(len(ids), bool)
    for fineness in (1, 4):
        rest = np.flatnonzero(~seen)
        if fineness > 1 and 80 * fineness * len(rest) > _RAYS:
            break
        show = progress if fineness == 1 else silent
        seen[rest] = seen_from_space(tracer, navigable, ids=ids[rest], rays_per_face=fineness, tau=tau, progress=show)
    return seen


def part_of_backdrop(far: Gaussians, middle: F64) -> Mask:
    """Return a mask (F,): which Gaussians far outside together fill enough of the direction in which they lie."""
    from gsvis.raycast.directions import NUM_FACES, face_of

    if len(far) == 0:
        return np.zeros(0, bool)
    toward = far.means.astype(np.float64) - middle
    squared = np.einsum("ij,ij->i", toward, toward)
    _, mid, most = np.sort(far.scales.astype(np.float64), axis=1).T
    whole = 4.0 * np.pi / NUM_FACES
    angle = np.minimum(far.opacities * 2.0 * np.pi * mid * most / squared, 0.5 * BACKDROP * whole)  # none is one alone
    faces = face_of(toward)
    covered = np.bincount(faces, weights=angle, minlength=NUM_FACES)
    return np.asarray(covered[faces] >= BACKDROP * whole)
