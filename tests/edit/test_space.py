"""Navigable space as meshes and voxels."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import trimesh

from gsvis.edit.space import mesh_space, solid_voxels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.similarity import upright_matrix

pytest.importorskip("skimage", reason="needs scikit-image")


def hall(up: Any = (0.0, 0.0, 1.0)) -> NavigableSpace:
    """A closed hall of 8 x 6 x 4 voxels, eyes a voxel from its walls, and a closed chamber beside it."""
    occupied = np.ones((15, 10, 8), bool)
    occupied[2:10, 2:8, 2:6] = False
    occupied[11:13, 3:5, 3:5] = False  # nobody can enter it
    free = np.zeros_like(occupied)
    free[3:9, 3:7, 3:5] = True
    return NavigableSpace(np.array([1.0, -2.0, 3.0]), 0.5, free, np.asarray(up, np.float64), occupied)


def test_what_cannot_be_reached_is_solid() -> None:
    space = hall()
    solid = solid_voxels(space).solid
    assert not solid[2:10, 2:8, 2:6].any()
    assert np.count_nonzero(~solid) == 8 * 6 * 4  # the chamber is solid


def test_meshes_are_watertight_and_follow_the_voxels() -> None:
    space = hall()
    meshes = mesh_space(space, frame="scene")
    for mesh, sides in ((meshes.navigable, (6, 4, 2)), (meshes.surface, (8, 6, 4))):
        assert mesh.is_watertight
        size = np.array(sides) * space.voxel_size
        assert np.allclose(np.ptp(mesh.bounds, axis=0), size)
        assert 0.8 * size.prod() < abs(mesh.volume) < size.prod()
    assert meshes.navigable.volume > 0  # normals point outwards
    assert meshes.surface.volume < 0  # normals point to the visitor, inwards
    corner = space.origin + 2 * space.voxel_size
    assert np.allclose(meshes.surface.bounds[0], corner)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (-1, 0, 0), (0.6, 0.0, 0.8)])
def test_upright_meshes_have_y_up_and_meters(up: tuple[float, float, float]) -> None:
    matrix = upright_matrix(np.array(up, np.float64), 2.0)
    assert np.allclose(matrix[:3, :3] @ up, [0, 2, 0])
    assert np.isclose(np.linalg.det(matrix[:3, :3]), 8.0)
    plain, turned = (mesh_space(hall(up), frame=frame) for frame in ("scene", "upright"))
    long = mesh_space(hall(up), meters_per_unit=2.0)
    assert np.isclose(turned.navigable.volume, plain.navigable.volume)
    assert np.isclose(long.navigable.volume, 8 * plain.navigable.volume)
    assert np.allclose(plain.navigable.vertices @ matrix[:3, :3].T, long.navigable.vertices)


def test_a_grid_without_walls_has_no_skin() -> None:
    free = np.zeros((6, 6, 6), bool)
    free[2:4, 2:4, 2:4] = True
    meshes = mesh_space(NavigableSpace(np.zeros(3), 1.0, free, np.array([0.0, 0.0, 1.0])))
    assert len(meshes.surface.faces) == 0
    assert len(meshes.navigable.faces) > 0


def test_a_file_holds_both_meshes_and_the_way_back() -> None:
    meshes = mesh_space(hall(), meters_per_unit=2.0)
    read = trimesh.load(io.BytesIO(meshes.to_glb()), file_type="glb")
    assert isinstance(read, trimesh.Scene)
    assert set(read.geometry) == {"navigable", "surface"}
    assert np.isclose(read.geometry["navigable"].volume, meshes.navigable.volume, rtol=1e-5)
    assert np.allclose(np.reshape(read.metadata["scene_to_mesh"], (4, 4)), meshes.matrix)


def test_arguments_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="frame"):
        mesh_space(hall(), frame="sideways")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="meters_per_unit"):
        mesh_space(hall(), meters_per_unit=0.0)
    with pytest.raises(ValueError, match="meters_per_unit"):
        mesh_space(hall(), frame="scene", meters_per_unit=2.0)
