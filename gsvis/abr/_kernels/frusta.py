"""Kernel that computes the frusta of poses: two for each plan of each client, so NumPy's calls would take most time."""

from __future__ import annotations

from gsvis._kernels.compiled import kernel


@kernel(error_model="numpy")
def frusta_of(normals, quats, eyes, near, out):
    """Write the planes of F poses: unit normals that point inward, and offsets.

    Args:
        normals: (5, 3) unit normals of the planes in the frame of the camera; the near plane is the last.
        quats: (F, 4) unit quaternions wxyz, world from camera.
        eyes: (F, 3) positions, scene frame.
        near: Distance from the eye at which the frusta begin, scene units.
        out: (F, 5, 4) float32, receives the planes.
    """
    for f in range(len(quats)):
        w = quats[f, 0]
        x = quats[f, 1]
        y = quats[f, 2]
        z = quats[f, 3]
        for k in range(len(normals)):
            p = normals[k, 0]
            q = normals[k, 1]
            r = normals[k, 2]
            a = p * (1 - 2 * (y * y + z * z)) + q * (2 * (x * y - w * z)) + r * (2 * (x * z + w * y))
            b = p * (2 * (x * y + w * z)) + q * (1 - 2 * (x * x + z * z)) + r * (2 * (y * z - w * x))
            c = p * (2 * (x * z - w * y)) + q * (2 * (y * z + w * x)) + r * (1 - 2 * (x * x + y * y))
            out[f, k, 0] = a
            out[f, k, 1] = b
            out[f, k, 2] = c
            out[f, k, 3] = -(a * eyes[f, 0] + b * eyes[f, 1] + c * eyes[f, 2])
        out[f, len(normals) - 1, 3] -= near
