"""Edit scenes by what can be seen, and turn the space from which they are seen into meshes and voxels."""

from gsvis.edit.space import SpaceMeshes, mesh_space, solid_voxels

__all__ = ["SpaceMeshes", "mesh_space", "solid_voxels"]


def __dir__() -> list[str]:
    return sorted(__all__)
