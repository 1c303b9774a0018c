"""Evaluate and rotate the real spherical harmonics of 3DGS, degrees 0 to 3.

Directions are unit vectors from the eye to the Gaussian, in the scene's frame, as in 3DGS. This module knows no
Gaussians and no cameras. It defines the meaning of the numbers in `sh0` and `shN`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = ["SH_C0", "rotation_of_sh", "sh_basis", "sh_degree_of"]

SH_C0 = 0.28209479177387814
"""Value of the constant harmonic: base color = 0.5 + SH_C0 * sh0. The factors of the higher degrees follow."""

SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def sh_degree_of(num_coefficients: int) -> int:
    """Return the degree of a set of 1, 4, 9 or 16 coefficients.

    Raises:
        ValueError: If the number is not one of these.
    """
    degrees = {1: 0, 4: 1, 9: 2, 16: 3}
    if num_coefficients not in degrees:
        raise ValueError(f"sh0 and shN: expected 1, 4, 9 or 16 coefficients together, got {num_coefficients}")
    return degrees[num_coefficients]


def sh_basis(directions: ArrayLike, degree: int) -> NDArray[np.float64]:
    """Evaluate the real spherical harmonics, in the order and with the signs of 3DGS.

    Args:
        directions: (D, 3) unit vectors, eye to Gaussian, scene frame.
        degree: 0 to 3.

    Returns:
        (D, (degree + 1)^2) float64.

    Raises:
        ValueError: If the shape or the degree is wrong.

    References:
        Sloan, "Efficient spherical harmonic evaluation", JCGT 2013; sign convention of Kerbl et al., 3DGS, 2023.

    Examples:
        >>> sh_basis([[0, 0, 1]], 1).round(3).tolist()
        [[0.282, -0.0, 0.489, -0.0]]
    """
    d = _check.floats("directions", directions, ("D", 3), np.float64)
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree: expected 0, 1, 2 or 3, got {degree!r}")
    x, y, z = d.T
    columns = [np.full(len(d), SH_C0)]
    if degree >= 1:
        columns += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        columns += [
            SH_C2[0] * x * y,
            SH_C2[1] * y * z,
            SH_C2[2] * (2 * z * z - x * x - y * y),
            SH_C2[3] * x * z,
            SH_C2[4] * (x * x - y * y),
        ]
    if degree >= 3:
        columns += [
            SH_C3[0] * y * (3 * x * x - y * y),
            SH_C3[1] * x * y * z,
            SH_C3[2] * y * (4 * z * z - x * x - y * y),
            SH_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            SH_C3[4] * x * (4 * z * z - x * x - y * y),
            SH_C3[5] * z * (x * x - y * y),
            SH_C3[6] * x * (x * x - 3 * y * y),
        ]
    return np.stack(columns, axis=1)


def rotation_of_sh(rotation: ArrayLike, degree: int) -> NDArray[np.float64]:
    """Return the matrix that rotates SH coefficients with the scene.

    If `f(d) = sh_basis(d) @ c` is a color, then `sh_basis(d) @ (M @ c) == f(R^T d)`: the rotated scene shows in
    direction
    `R d` what the original shows in direction `d`.

    Args:
        rotation: (3, 3) rotation R, new frame from old frame.
        degree: 0 to 3.

    Returns:
        (K, K) float64, block diagonal by degree, orthogonal; K = (degree + 1)^2.

    Raises:
        ValueError: If `rotation` is not a rotation.

    References:
        The harmonics of one degree span a rotation-invariant space, so a least-squares fit over enough directions
        is exact.
    """
    r = _check.floats("rotation", rotation, (3, 3), np.float64)
    if not np.allclose(r @ r.T, np.eye(3), atol=1e-6) or np.linalg.det(r) < 0:
        got = (
            f"determinant {np.linalg.det(r):.4g}, R R^T up to {np.abs(r @ r.T - np.eye(3)).max():.2g} from the identity"
        )
        raise ValueError(f"rotation: expected an orthonormal matrix with determinant 1, got {got}")
    golden = np.pi * (3.0 - np.sqrt(5.0))
    i = np.arange(64)
    z = 1.0 - (2.0 * i + 1.0) / len(i)
    rho = np.sqrt(1.0 - z * z)
    directions = np.stack([rho * np.cos(golden * i), rho * np.sin(golden * i), z], axis=1)
    matrix, *_ = np.linalg.lstsq(sh_basis(directions, degree), sh_basis(directions @ r, degree), rcond=None)
    for band in range(degree + 1):  # entries off the blocks are rounding errors
        rows = slice(band * band, (band + 1) ** 2)
        matrix[rows, : rows.start] = 0.0
        matrix[rows, rows.stop :] = 0.0
    return np.asarray(matrix, np.float64)
