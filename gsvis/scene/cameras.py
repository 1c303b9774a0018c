"""Define pinhole cameras: poses, intrinsics and image size.

OpenCV axes (+x right, +y down, +z forward). `viewmats` map world to camera, `Ks` are in pixels, pixel centers lie at
+0.5. A field of view is only ever an argument. This module knows no scene and no file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = ["Cameras", "intrinsics"]

F64 = NDArray[np.float64]


def intrinsics(width: int, height: int, fov: float) -> F64:
    """Return the (3, 3) pinhole matrix with square pixels and a centered principal point.

    Args:
        width: Pixels.
        height: Pixels.
        fov: Horizontal field of view in degrees, in (0, 180).

    Raises:
        ValueError: If a size is not positive or `fov` is out of range.

    Examples:
        >>> intrinsics(200, 100, 90.0).tolist()
        [[100.0, 0.0, 100.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]]
    """
    _check.positive_int("width", width)
    _check.positive_int("height", height)
    if not 0.0 < fov < 180.0:
        raise ValueError(f"fov: expected degrees in (0, 180), got {fov!r}")
    focal = 0.5 * width / np.tan(np.radians(fov) / 2.0)
    return np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Cameras:
    """C pinhole cameras of one image size, validated and read-only.

    Args:
        viewmats: (C, 4, 4) camera from world, rigid.
        Ks: (C, 3, 3) intrinsics in pixels, focal lengths > 0, last row 0 0 1.
        width: Image width in pixels.
        height: Image height in pixels.
        names: C names, such as those of image files; optional.

    Raises:
        ValueError: If a shape is wrong, a pose is not rigid, or intrinsics are not invertible.
    """

    viewmats: F64
    Ks: F64
    width: int
    height: int
    names: tuple[str, ...]

    def __init__(
        self,
        viewmats: ArrayLike,
        Ks: ArrayLike,  # noqa: N803  the field's own name
        width: int,
        height: int,
        names: tuple[str, ...] | list[str] | None = None,
    ) -> None:
        poses = _check.floats("viewmats", viewmats, ("C", 4, 4), np.float64)
        ks = _check.floats("Ks", Ks, ("C", 3, 3), np.float64)
        _check.same_length(viewmats=poses, Ks=ks)
        rotations = poses[:, :3, :3]
        if not np.allclose(rotations @ np.swapaxes(rotations, 1, 2), np.eye(3), atol=1e-4) or (
            len(poses) and np.linalg.det(rotations).min() < 0
        ):
            raise ValueError("viewmats: expected rotations (orthonormal, determinant 1), got a pose that is not rigid")
        lasts = np.isclose(poses[:, 3], [0.0, 0.0, 0.0, 1.0], atol=1e-6).all(axis=1)
        if not lasts.all():
            got = " ".join(f"{value:g}" for value in poses[int(np.argmin(lasts)), 3])
            raise ValueError(f"viewmats: expected a last row of 0 0 0 1, got {got}; are the matrices transposed?")
        if len(ks) and (min(ks[:, 0, 0].min(), ks[:, 1, 1].min()) <= 0 or not np.allclose(ks[:, 2], [0.0, 0.0, 1.0])):
            raise ValueError("Ks: expected focal lengths > 0 and a last row of 0 0 1, got a matrix without one or both")
        names = tuple(names) if names is not None else tuple(f"{i:05d}" for i in range(len(poses)))
        if len(names) != len(poses):
            raise ValueError(f"names: expected {len(poses)} names, one for each camera, got {len(names)}")
        for array in (poses := poses.view(), ks := ks.view()):
            array.flags.writeable = False
        object.__setattr__(self, "viewmats", poses)
        object.__setattr__(self, "Ks", ks)
        object.__setattr__(self, "width", _check.positive_int("width", width))
        object.__setattr__(self, "height", _check.positive_int("height", height))
        object.__setattr__(self, "names", names)

    @classmethod
    def look_at(
        cls,
        eyes: ArrayLike,
        targets: ArrayLike,
        *,
        up: ArrayLike = (0.0, 0.0, 1.0),
        width: int = 256,
        height: int = 192,
        fov: float = 60.0,
    ) -> Cameras:
        """Return cameras at `eyes` that look at `targets`, with `up` upward in the image.

        Args:
            eyes: (C, 3) viewpoints, world frame.
            targets: (C, 3) or (3,) points to look at, world frame.
            up: (3,) world direction; replaced by an axis if it is parallel to the view.
            width: Pixels.
            height: Pixels.
            fov: Horizontal field of view, degrees.

        Raises:
            ValueError: If an eye lies on its target.
        """
        eye = _check.floats("eyes", eyes, ("C", 3), np.float64)
        target = _check.floats("targets", targets, (3,) if np.ndim(targets) == 1 else (len(eye), 3), np.float64)
        forward = target - eye
        distance = np.linalg.norm(forward, axis=1)
        if len(eye) and distance.min() <= 0:
            raise ValueError(
                f"eyes: expected eyes apart from their targets, got camera {int(distance.argmin())} on its target"
            )
        forward = forward / distance[:, None]
        upward = _check.unit_vectors("up", _check.floats("up", up, (3,), np.float64)[None])
        down = np.repeat(-upward, len(eye), axis=0)
        down -= np.sum(down * forward, axis=1, keepdims=True) * forward
        parallel = np.linalg.norm(down, axis=1) < 1e-6
        if parallel.any():
            axis = np.eye(3)[np.abs(forward[parallel]).argmin(axis=1)]
            down[parallel] = axis - np.sum(axis * forward[parallel], axis=1, keepdims=True) * forward[parallel]
        down /= np.linalg.norm(down, axis=1, keepdims=True)
        right = np.cross(down, forward)
        viewmats = np.tile(np.eye(4), (len(eye), 1, 1))
        viewmats[:, :3, :3] = np.stack([right, down, forward], axis=1)
        viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], eye)
        return cls(viewmats, np.tile(intrinsics(width, height, fov), (len(eye), 1, 1)), width, height)

    @classmethod
    def orbit(
        cls,
        center: ArrayLike,
        radius: float,
        count: int,
        *,
        up: ArrayLike = (0.0, 0.0, 1.0),
        elevation: float = 20.0,
        width: int = 256,
        height: int = 192,
        fov: float = 60.0,
    ) -> Cameras:
        """Return `count` cameras evenly spaced on a circle around `center`, all looking at it.

        Args:
            center: (3,) world point.
            radius: Radius of the circle, scene units, > 0.
            count: Number of cameras.
            up: (3,) axis of the circle.
            elevation: Degrees above the plane through `center`, in (-90, 90).
            width: Pixels.
            height: Pixels.
            fov: Horizontal field of view, degrees.
        """
        middle = _check.floats("center", center, (3,), np.float64)
        axis = _check.unit_vectors("up", _check.floats("up", up, (3,), np.float64)[None])[0]
        if not 0 < radius < np.inf:
            raise ValueError(f"radius: expected a finite number > 0, got {radius!r}")
        if not -90 < elevation < 90:
            raise ValueError(f"elevation: expected degrees in (-90, 90), got {elevation!r}")
        first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        first /= np.linalg.norm(first)
        turn = 2.0 * np.pi * np.arange(_check.positive_int("count", count)) / count
        ring = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(axis, first)
        tilt = np.radians(elevation)
        eyes = middle + radius * (np.cos(tilt) * ring + np.sin(tilt) * axis)
        return cls.look_at(eyes, middle, up=axis, width=width, height=height, fov=fov)

    @classmethod
    def cubemap(cls, viewpoints: ArrayLike, size: int) -> Cameras:
        """Return six square cameras of 90 degrees around each viewpoint: +x, -x, +y, -y, +z, -z of the world.

        Args:
            viewpoints: (V, 3) positions, world frame.
            size: Side of each face in pixels.

        Returns:
            6 V cameras; the six faces of a viewpoint are consecutive.

        Examples:
            >>> around = Cameras.cubemap([[0, 0, 0], [1, 0, 0]], size=32)
            >>> around
            Cameras(12 of 32 x 32)
            >>> len(around.rays()[0])
            12288
        """
        points = _check.floats("viewpoints", viewpoints, ("V", 3), np.float64)
        _check.positive_int("size", size)
        forwards = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
        downs = np.array([[0, 0, -1]] * 4 + [[0, -1, 0]] * 2, np.float64)
        rotations = np.stack([np.cross(downs, forwards), downs, forwards], axis=1)
        viewmats = np.tile(np.eye(4), (len(points), 6, 1, 1))
        viewmats[:, :, :3, :3] = rotations
        viewmats[:, :, :3, 3] = -np.einsum("fij,vj->vfi", rotations, points)
        ks = np.tile(intrinsics(size, size, 90.0), (6 * len(points), 1, 1))
        return cls(viewmats.reshape(-1, 4, 4), ks, size, size)

    def __len__(self) -> int:
        return len(self.viewmats)

    def __getitem__(self, index: Any) -> Cameras:
        """Select cameras by a slice, a mask, an index array, or one integer (one camera)."""
        where = np.arange(len(self))[index].reshape(-1)
        return Cameras(
            self.viewmats[where], self.Ks[where], self.width, self.height, tuple(self.names[int(i)] for i in where)
        )

    def __repr__(self) -> str:
        return f"Cameras({len(self)} of {self.width} x {self.height})"

    @property
    def viewpoints(self) -> F64:
        """(C, 3) positions, world frame."""
        return np.asarray(-np.einsum("cji,cj->ci", self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]))

    @property
    def forwards(self) -> F64:
        """(C, 3) unit view directions, world frame."""
        return np.asarray(self.viewmats[:, 2, :3])

    def with_origin(self, origin: ArrayLike) -> Cameras:
        """Return the same cameras in a frame whose (0, 0, 0) lies at `origin` in this one; axes are kept.

        Args:
            origin: (3,) the new origin, such as that of a scene's facts, if the cameras are in coordinates of its
                source.
        """
        moved = self.viewmats.copy()
        moved[:, :3, 3] += self.viewmats[:, :3, :3] @ _check.floats("origin", origin, (3,), np.float64)
        return Cameras(moved, self.Ks, self.width, self.height, self.names)

    def evenly(self, count: int) -> Cameras:
        """Return `count` of the cameras, evenly spaced, in their order; all if there are no more."""
        if count >= len(self):
            return self
        return self[np.floor(np.arange(count) * len(self) / count).astype(int)]

    def resize(self, width: int, height: int) -> Cameras:
        """Return the same views at another resolution."""
        _check.positive_int("width", width)
        _check.positive_int("height", height)
        factor = np.array([width / self.width, height / self.height, 1.0])
        return Cameras(self.viewmats, self.Ks * factor[None, :, None], width, height, self.names)

    def rays(self) -> tuple[F64, F64]:
        """Return rays through all pixel centers.

        Returns:
            rays_o: (C * height * width, 3) origins, world frame.
            rays_d: (C * height * width, 3) unit directions; camera by camera, row by row.
        """
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        pixels = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        local = np.linalg.solve(self.Ks, np.broadcast_to(pixels, (len(self), *pixels.shape)))
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        rays_d = np.einsum("cji,cjp->cpi", self.viewmats[:, :3, :3], local)
        rays_o = np.repeat(self.viewpoints, x.size, axis=0)
        return rays_o, np.ascontiguousarray(rays_d).reshape(-1, 3)
