"""Convert navigable space to meshes and voxels, for collision and walking in other programs.

A visitor can be in all voxels that let light pass and connect with navigable space. Everything else is solid, so closed
rooms and floaters inside walls leave no surface. Meshes follow the boundary of voxels by
marching cubes (Lorensen and Cline, 1987): watertight, and at most half a voxel from the voxels' faces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._extras import require
from gsvis.io.voxels import Voxels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.similarity import upright_matrix

if TYPE_CHECKING:
    import trimesh

__all__ = ["Frame", "SpaceMeshes", "mesh_space", "solid_voxels"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Frame = Literal["upright", "scene"]


def solid_voxels(space: NavigableSpace) -> Voxels:
    """Return the voxels that a visitor of a navigable space cannot reach.

    Args:
        space: The navigable space. Free voxels close to walls also count as free if they can be reached.
    """
    from scipy import ndimage  # here: it takes long to import

    labels, _ = ndimage.label(~space.occupied | space.free)
    reached = np.isin(labels, np.unique(labels[space.free]))
    return Voxels(space.origin, space.voxel_size, ~reached)


@dataclass(frozen=True, eq=False)
class SpaceMeshes:
    """Meshes of a navigable space.

    Attributes:
        navigable: Boundary of the navigable voxels; normals point outwards.
        surface: Boundary of the solid voxels; normals point to the visitor.
        matrix: (4, 4) from the scene frame to that of the meshes.
    """

    navigable: trimesh.Trimesh
    surface: trimesh.Trimesh
    matrix: F64

    def to_glb(self, origin: ArrayLike = (0.0, 0.0, 0.0)) -> bytes:
        """Return both meshes as binary glTF, named `navigable` and `surface`; `matrix` is in the scene's extras.

        Args:
            origin: (3,) origin of the scene, in the coordinates of its source; stored in the extras unless (0, 0, 0).
        """
        import trimesh

        about = {"scene_to_mesh": self.matrix.ravel().tolist()}
        if np.any(origin):
            about["origin"] = np.asarray(origin, np.float64).tolist()
        scene = trimesh.Scene(metadata=about)
        for name, mesh in (("navigable", self.navigable), ("surface", self.surface)):
            scene.add_geometry(mesh, node_name=name, geom_name=name)
        return bytes(scene.export(file_type="glb"))  # type: ignore[no-untyped-call]


def mesh_space(space: NavigableSpace, *, frame: Frame = "upright", meters_per_unit: float = 1.0) -> SpaceMeshes:
    """Return the boundary of a navigable space, and that of solid voxels, as triangles.

    Args:
        space: The navigable space.
        frame: "upright" rotates the scene so that +y points upward, as in glTF; "scene" keeps the scene frame.
        meters_per_unit: Length of a scene unit in the result; only for "upright".

    Raises:
        ValueError: If an argument is out of range, or the frame is "scene" and a length is given.
        MissingExtraError: If scikit-image is not installed.
    """
    require("gsvis.edit.mesh_space", "skimage")
    _check.one_of("frame", frame, ("upright", "scene"))
    if not (np.isfinite(meters_per_unit) and meters_per_unit > 0.0):
        raise ValueError(f"meters_per_unit: expected a finite number > 0, got {meters_per_unit!r}")
    if frame == "scene" and meters_per_unit != 1.0:
        raise ValueError("meters_per_unit: expected none with frame='scene', whose unit is that of the scene")
    matrix = np.eye(4) if frame == "scene" else upright_matrix(space.up, meters_per_unit)
    solid = solid_voxels(space).solid
    # Outside of the grid everything is solid: navigable space ends there, and the surface has no shell around the grid.
    navigable = _boundary(np.pad(space.free, 1), space)
    surface = _boundary(np.pad(solid, 1, mode="edge"), space)
    for mesh in (navigable, surface):
        mesh.apply_transform(matrix)
    return SpaceMeshes(navigable, surface, matrix)


def _boundary(inside: Mask, space: NavigableSpace) -> trimesh.Trimesh:
    """Return the boundary of voxels of a grid with one more voxel on each side."""
    import trimesh
    from skimage import measure

    if inside.all() or not inside.any():
        return trimesh.Trimesh()
    vertices, faces, _, _ = measure.marching_cubes(inside.astype(np.float32), 0.5)  # type: ignore[no-untyped-call]
    places = space.origin + (vertices - 0.5) * space.voxel_size  # vertex k lies at the center of voxel k - 1
    return trimesh.Trimesh(places, faces[:, ::-1], process=False)
