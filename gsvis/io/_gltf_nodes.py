"""Walk the nodes of a glTF scene, and find the transform of each mesh."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.fields import Fields
from gsvis.scene.gaussians import rotations_from_quats

__all__ = ["Placed", "place_meshes"]

F64 = NDArray[np.float64]
Placed = tuple[F64, F64, float]
"""Rotation (3, 3), translation (3,) and scale: x -> scale * R x + t."""

_STRAIGHT = 1e-4  # tolerance of a float32 rotation matrix
_SNAP = 1e-6
_MOST = 1e30


def place_meshes(root: Fields) -> Iterator[tuple[Fields, Placed | None]]:
    """Yield each mesh of a scene with its transform, None for the identity; depth first, children in their order.

    Args:
        root: The document. Its default scene counts, else its first, else all nodes that are no children.

    Raises:
        FormatError: If a node is referenced twice, a number is out of range, or a transform is not made of a rotation,
            a translation and one positive scale.
    """
    nodes = root.items("nodes") if "nodes" in root else []
    meshes = root.items("meshes") if "meshes" in root else []
    stack = [(index, np.eye(4)) for index in reversed(_roots(root, nodes))]
    seen: set[int] = set()
    while stack:
        index, parent = stack.pop()
        node = Fields(root.path, f"nodes[{index}]", nodes[index])
        if index in seen:
            raise FormatError(root.path, node.trail, "a node with one parent", "a node with two")
        seen.add(index)
        with np.errstate(all="ignore"):
            matrix = parent @ _matrix(node)
        if "mesh" in node:
            mesh = node.integer("mesh", 0, len(meshes) - 1)
            yield Fields(root.path, f"meshes[{mesh}]", meshes[mesh]), _decompose(node, matrix)
        stack.extend((child, matrix) for child in reversed(_numbers(node, "children", len(nodes))))


def _roots(root: Fields, nodes: list[object]) -> list[int]:
    """Return the root nodes of the scene to read."""
    if root.raw("scenes"):
        scenes = root.items("scenes")
        index = root.integer("scene", 0, len(scenes) - 1) if "scene" in root else 0
        return _numbers(Fields(root.path, f"scenes[{index}]", scenes[index]), "nodes", len(nodes))
    inner: set[int] = set()
    for k, node in enumerate(nodes):
        inner.update(_numbers(Fields(root.path, f"nodes[{k}]", node), "children", len(nodes)))
    return [k for k in range(len(nodes)) if k not in inner]


def _numbers(fields: Fields, key: str, count: int) -> list[int]:
    """Return the list of node numbers at a key; empty if it is missing."""
    if key not in fields:
        return []
    found = fields.items(key)
    for value in found:
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < count:
            raise FormatError(fields.path, fields.where(key), f"numbers below {count}", repr(value)[:60])
    return found


def _matrix(node: Fields) -> F64:
    """Return the (4, 4) matrix of a node to its parent."""
    if "matrix" in node:
        return np.asarray(node.numbers("matrix", 16).reshape(4, 4).T)
    matrix = np.eye(4)
    if "rotation" in node:
        xyzw = node.numbers("rotation", 4)
        if not 0.9 < float(np.linalg.norm(xyzw)) < 1.1:
            raise FormatError(node.path, node.where("rotation"), "a unit quaternion", f"{xyzw.tolist()}")
        matrix[:3, :3] = rotations_from_quats((xyzw / np.linalg.norm(xyzw))[None, [3, 0, 1, 2]])[0]
    if "scale" in node:
        matrix[:3, :3] *= node.numbers("scale", 3)
    if "translation" in node:
        matrix[:3, 3] = node.numbers("translation", 3)
    return matrix


def _decompose(node: Fields, matrix: F64) -> Placed | None:
    """Return rotation, translation and scale of a matrix, None for the identity; cleans near-exact rotations."""
    good = bool((np.abs(matrix) < _MOST).all())  # false for NaN as well
    linear, shift = (matrix[:3, :3], matrix[:3, 3]) if good else (np.zeros((3, 3)), np.zeros(3))
    lengths = np.linalg.norm(linear, axis=0)
    scale = float(lengths.mean())
    good = scale > 1.0 / _MOST
    rotation = linear / scale if good else np.eye(3)
    straight = np.allclose(rotation @ rotation.T, np.eye(3), atol=_STRAIGHT) and np.linalg.det(rotation) > 0.0
    last = np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0])
    if not (good and straight and last and np.allclose(lengths, scale, rtol=_STRAIGHT)):
        remedy = "apply the transform of the node in the program that made it"
        along = ", ".join(f"{length:.4g}" for length in lengths)
        got = f"axes of lengths {along}, or a shear or a mirror" if (lengths > 0).all() else "zero or huge numbers"
        raise FormatError(node.path, node.trail, "a rotation, a translation and one scale above 0", got, remedy)
    left, _, right = np.linalg.svd(rotation)
    whole = np.rint(rotation)
    rotation = left @ right
    rotation = whole if np.allclose(whole, rotation, atol=_SNAP) else rotation
    scale = 1.0 if abs(scale - 1.0) < _SNAP else scale
    if scale == 1.0 and np.array_equal(rotation, np.eye(3)) and not shift.any():
        return None
    return rotation, shift, scale
