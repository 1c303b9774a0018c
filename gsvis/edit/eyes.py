"""Define the eyes for which a scene is cut: anywhere in a space, or at cameras.

Eyes in a space look all around. Eyes of cameras see only what falls into their images. Both give places to look from,
independent rays that certify a set, and views to render. Scene frame and units; OpenCV cameras.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.certificate import Certificate, CertificateConfig, Certifier
from gsvis.pvs.look import Look, Sight
from gsvis.pvs.viewpoints import CellViewpoints, FreeVoxels, SharedViewpoints
from gsvis.render.weights import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.solid import Solid
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["Eyes", "EyesInSpace", "EyesOfCameras"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_TRIES = 32  # draws of places until enough lie outside everything solid
_ALONG = 96  # most places on a walk to look from; through a door one sees far things from few places
_RIM = 1  # random stream of the places beside cameras
_TIMES = 2  # random stream of the instants of a walk
_CHOSEN = 3  # random stream of the cameras that are drawn


class Eyes(Protocol):
    """Eyes that a scene is cut for."""

    @property
    def repeats(self) -> bool:
        """Whether rendered views may include some from which the set was collected."""
        ...

    def count_looks(self) -> int:
        """Return the number of looks of `iter_looks`, including those inside something solid."""
        ...

    def iter_looks(self, look: Look, seed: int) -> Iterator[Sight | None]:
        """Yield the Gaussians that each place sees; None for a place inside something solid."""
        ...

    def look_again(self, look: Look, origin: F64) -> Sight | None:
        """Return the Gaussians seen from the origin of a ray that missed some; None if eyes see only their rays."""
        ...

    def certify(
        self,
        certifier: Certifier,
        ids: ArrayLike,
        config: CertificateConfig,
        stage: int,
        earlier: Sequence[Certificate],
    ) -> Certificate | None:
        """Bound the light that a set misses for these eyes; None if all of them lie inside something solid."""
        ...

    def draw_views(self, g: Gaussians, sampling: ViewSampling) -> Cameras:
        """Return random views of these eyes, at most `sampling.count`."""
        ...


@dataclass(frozen=True, eq=False)
class EyesInSpace:
    """Eyes anywhere in a space that look all around.

    Attributes:
        space: Allowed viewpoints.
        path: A walk in the middle of the space, which adds places to look from and provides the views; None draws views
            in the space.
        boxes: Largest number of boxes of the space; places to look from lie near their corners.
    """

    space: NavigableSpace
    path: HeadPath | None = None
    boxes: int = 16

    def __post_init__(self) -> None:
        _check.positive_int("boxes", self.boxes)

    @property
    def repeats(self) -> bool:
        """False: places are drawn at random."""
        return False

    @cached_property
    def viewpoints(self) -> F64:
        """(V, 3) places to look from."""
        grid = CellGrid.over(self.space, max_cells=self.boxes)
        corners = SharedViewpoints(CellViewpoints(grid, self.space)).points
        if self.path is None:
            return corners
        return np.concatenate([_thin(self.path.positions, self.space.voxel_size), corners])

    @cached_property
    def voxels(self) -> FreeVoxels:
        """All free voxels of the space, as one cell."""
        return FreeVoxels(0, np.argwhere(self.space.free), self.space.origin, self.space.voxel_size)

    def count_looks(self) -> int:
        """Return the number of places to look from."""
        return len(self.viewpoints)

    def iter_looks(self, look: Look, seed: int) -> Iterator[Sight | None]:
        """Yield the Gaussians that an eye at each place sees; None for a place inside something solid."""
        lost = Solid.from_scene(look.gaussians).buries(self.viewpoints)
        for place, inside in zip(self.viewpoints, lost, strict=True):
            yield None if inside else look(place)

    def look_again(self, look: Look, origin: F64) -> Sight | None:
        """Return the Gaussians that an eye at a place sees all around."""
        return look(origin)

    def certify(
        self,
        certifier: Certifier,
        ids: ArrayLike,
        config: CertificateConfig,
        stage: int,
        earlier: Sequence[Certificate],
    ) -> Certificate | None:
        """Bound the light that a set misses, by rays from points uniform over the space in uniform directions."""
        return certifier.certify(self.voxels, ids, config, stage=stage, earlier=earlier)

    def draw_views(self, g: Gaussians, sampling: ViewSampling) -> Cameras:
        """Return poses of the walk at random instants; without a walk, random views in the space."""
        if self.path is None:
            return sampling.cameras(g, self.space)
        rng = np.random.default_rng([sampling.seed, sampling.stream, _TIMES])
        times = np.unique(self.path.duration * rng.random(sampling.count))
        walk = self.path.resample(times=times) if len(times) > 1 else self.path.resample(times=[0.0])
        return walk.cameras(sampling.width, sampling.height, sampling.fov)


@dataclass(frozen=True, eq=False)
class EyesOfCameras:
    """Eyes at cameras, or near them, that see what falls into the images.

    Attributes:
        cameras: C cameras.
        margin: Largest distance of an eye from its camera, scene units; it looks in the same direction.
        looks: Largest number of cameras to look from, evenly spaced; None for all. Rays start from all cameras.
    """

    cameras: Cameras
    margin: float = 0.0
    looks: int | None = None

    def __post_init__(self) -> None:
        if len(self.cameras) == 0:
            raise ValueError("cameras: expected at least one camera, got none")
        if not (np.isfinite(self.margin) and self.margin >= 0.0):
            raise ValueError(f"margin: expected a finite distance of at least 0, got {self.margin!r}")
        if self.looks is not None:
            _check.positive_int("looks", self.looks)

    @property
    def repeats(self) -> bool:
        """Whether all cameras are looked from, and eyes are nowhere else."""
        return not self.margin and len(self._sample) == len(self.cameras)

    @cached_property
    def _sample(self) -> I64:
        """Indices of the cameras to look from."""
        count = len(self.cameras) if self.looks is None else min(self.looks, len(self.cameras))
        return np.floor(np.arange(count) * len(self.cameras) / count).astype(np.int64)

    def count_looks(self) -> int:
        """Return the number of cameras to look from; with a margin each looks twice."""
        return len(self._sample) * (2 if self.margin else 1)

    def iter_looks(self, look: Look, seed: int) -> Iterator[Sight | None]:
        """Yield the Gaussians that each camera shows, then from places at its margin; None inside something solid."""
        solid = Solid.from_scene(look.gaussians)
        for c in self._sample.tolist():
            yield self._show(look, self.cameras[c])
        rng = np.random.default_rng([seed, _RIM])
        for c in self._sample.tolist() if self.margin else ():
            camera = self.cameras[c]
            place = camera.viewpoints + self.margin * _on_sphere(1, rng)
            yield None if solid.buries(place)[0] else self._show(look, _move(camera, place))

    def look_again(self, look: Look, origin: F64) -> Sight | None:
        """Return None, because an eye that looks all around sees more than the images show."""
        return None

    def certify(
        self,
        certifier: Certifier,
        ids: ArrayLike,
        config: CertificateConfig,
        stage: int,
        earlier: Sequence[Certificate],
    ) -> Certificate | None:
        """Bound the light that a set misses, by rays through random places of the images of random cameras."""
        solid = Solid.from_scene(certifier.tracer.proxies.gaussians) if self.margin else None

        def draw(count: int, rng: np.random.Generator) -> tuple[F64, F64] | None:
            """Return origins and directions of random rays."""
            return self._draw_rays(count, rng, solid)

        return certifier.certify_rays(draw, ids, config, stage=stage, earlier=earlier)

    def draw_views(self, g: Gaussians, sampling: ViewSampling) -> Cameras:
        """Return random cameras, preferably not used for looking, at most as wide as `sampling`.

        With a margin they are moved to the side, unless that is inside something solid.
        """
        rng = np.random.default_rng([sampling.seed, sampling.stream, _CHOSEN])
        others = np.setdiff1d(np.arange(len(self.cameras)), () if self.margin else self._sample)
        pool = others if len(others) else np.arange(len(self.cameras))
        views = self.cameras[np.sort(rng.choice(pool, min(sampling.count, len(pool)), replace=False))]
        if views.width > sampling.width:
            views = views.resize(sampling.width, max(1, round(views.height * sampling.width / views.width)))
        if not self.margin:
            return views
        places = views.viewpoints + self.margin * _in_ball(len(views), rng)
        lost = Solid.from_scene(g).buries(places)
        return _move(views, np.where(lost[:, None], views.viewpoints, places))

    def _show(self, look: Look, camera: Cameras) -> Sight:
        """Return the Gaussians that a camera shows."""
        largest = view_weights(look.gaussians, camera).largest[0]
        ids = np.flatnonzero(largest >= look.options.floor)
        return ids, largest[ids]

    def _draw_rays(self, count: int, rng: np.random.Generator, solid: Solid | None) -> tuple[F64, F64] | None:
        """Return (count, 3) origins and directions; with a margin none begins inside something solid."""
        origins = np.zeros((0, 3))
        directions = np.zeros((0, 3))
        for _ in range(_TRIES):
            chosen = rng.integers(len(self.cameras), size=count)
            pixels = np.ones((count, 3))
            pixels[:, :2] = rng.random((count, 2)) * (self.cameras.width, self.cameras.height)
            local = np.linalg.solve(self.cameras.Ks[chosen], pixels[:, :, None])[:, :, 0]
            ahead = np.einsum("nji,nj->ni", self.cameras.viewmats[chosen, :3, :3], local)
            places = self.cameras.viewpoints[chosen] + self.margin * _in_ball(count, rng)
            kept = np.ones(count, bool) if solid is None else ~solid.buries(places)
            origins = np.concatenate([origins, places[kept]])
            directions = np.concatenate([directions, ahead[kept]])
            if len(origins) >= count:
                lengths = np.linalg.norm(directions[:count], axis=1, keepdims=True)
                return origins[:count], np.asarray(directions[:count] / lengths)
        return None


def _thin(points: F64, apart: float) -> F64:
    """Return some of the points (T, 3) of a walk, at least `apart` from each other, at most 96."""
    while True:
        kept = points[:1]
        for point in points[1:]:
            if np.sum((kept - point) ** 2, axis=1).min() >= apart * apart:
                kept = np.concatenate([kept, point[None]])
                if len(kept) > _ALONG:
                    break
        if len(kept) <= _ALONG:
            return kept
        apart *= 1.25


def _move(cameras: Cameras, places: F64) -> Cameras:
    """Return the cameras at new places (C, 3), with the same directions of view."""
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], places)
    return Cameras(viewmats, cameras.Ks, cameras.width, cameras.height, cameras.names)


def _on_sphere(count: int, rng: np.random.Generator) -> F64:
    """Return (count, 3) unit vectors, uniform over the sphere."""
    vectors = rng.normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _in_ball(count: int, rng: np.random.Generator) -> F64:
    """Return (count, 3) points, uniform over the unit ball."""
    return _on_sphere(count, rng) * np.cbrt(rng.random((count, 1)))
