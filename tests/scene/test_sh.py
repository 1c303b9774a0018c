"""Spherical harmonics: orthonormal, in the order and with the signs of 3DGS, and turning with the scene."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.scene.gaussians import rotations_from_quats
from gsvis.scene.sh import SH_C0, rotation_of_sh, sh_basis, sh_degree_of

DEGREES = (0, 1, 2, 3)


def rotation(seed: int) -> np.ndarray:
    quat = np.random.default_rng(seed).normal(size=(1, 4))
    return rotations_from_quats(quat / np.linalg.norm(quat))[0]


def directions(seed: int, count: int = 40) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_known_values() -> None:
    x, y, z = np.eye(3)
    c1 = np.sqrt(3 / (4 * np.pi))
    np.testing.assert_allclose(sh_basis([x, y, z], 0), np.full((3, 1), SH_C0))
    np.testing.assert_allclose(sh_basis([x, y, z], 1)[:, 1:], [[0, 0, -c1], [-c1, 0, 0], [0, c1, 0]], atol=1e-15)
    # At the pole only the zonal harmonics live; their value there is sqrt((2 l + 1) / 4 pi).
    pole = np.zeros(16)
    pole[[0, 2, 6, 12]] = np.sqrt((2 * np.arange(4) + 1) / (4 * np.pi))
    np.testing.assert_allclose(sh_basis([z], 3)[0], pole, atol=1e-15)


def test_the_basis_is_orthonormal_over_the_sphere() -> None:
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = 2 * np.pi * np.arange(16) / 16
    rho = np.sqrt(1 - z**2)[:, None]
    sphere = np.stack(np.broadcast_arrays(rho * np.cos(angle), rho * np.sin(angle), z[:, None]), axis=-1).reshape(-1, 3)
    basis = sh_basis(sphere, 3)
    gram = basis.T @ (np.repeat(weight, 16)[:, None] * basis) * 2 * np.pi / 16
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-13)


def test_parity_is_that_of_the_degree() -> None:
    d = directions(0)
    sign = np.repeat([1.0, -1.0, 1.0, -1.0], [1, 3, 5, 7])
    np.testing.assert_allclose(sh_basis(-d, 3), sign * sh_basis(d, 3), atol=1e-14)


def test_lower_degrees_are_the_first_columns() -> None:
    d = directions(1)
    for degree in DEGREES:
        np.testing.assert_array_equal(sh_basis(d, degree), sh_basis(d, 3)[:, : (degree + 1) ** 2])


@pytest.mark.parametrize("degree", DEGREES)
@given(a=st.integers(0, 10**6), b=st.integers(0, 10**6))
def test_turning_is_a_homomorphism_into_orthogonal_matrices(degree: int, a: int, b: int) -> None:
    ra, rb = rotation(a), rotation(b)
    ma, mb = rotation_of_sh(ra, degree), rotation_of_sh(rb, degree)
    np.testing.assert_allclose(rotation_of_sh(ra @ rb, degree), ma @ mb, atol=1e-12)
    np.testing.assert_allclose(ma @ ma.T, np.eye((degree + 1) ** 2), atol=1e-12)
    np.testing.assert_allclose(rotation_of_sh(ra.T, degree), ma.T, atol=1e-12)
    np.testing.assert_allclose(rotation_of_sh(np.eye(3), degree), np.eye((degree + 1) ** 2), atol=1e-12)


@given(seed=st.integers(0, 10**6))
def test_the_turned_scene_shows_what_the_old_one_showed(seed: int) -> None:
    r, d = rotation(seed), directions(seed)
    coefficients = np.random.default_rng(seed).normal(size=16)
    before = sh_basis(d, 3) @ coefficients
    after = sh_basis(d @ r.T, 3) @ (rotation_of_sh(r, 3) @ coefficients)
    np.testing.assert_allclose(after, before, atol=1e-12)


def test_bad_arguments_name_themselves() -> None:
    with pytest.raises(ValueError, match="directions"):
        sh_basis([1, 0, 0], 1)
    for degree in (-1, 4, 1.5):
        with pytest.raises(ValueError, match="degree: expected 0, 1, 2 or 3"):
            sh_basis(np.eye(3), degree)  # type: ignore[arg-type]
    for bad in (2 * np.eye(3), np.diag([1.0, 1.0, -1.0])):
        with pytest.raises(ValueError, match="rotation: expected an orthonormal matrix"):
            rotation_of_sh(bad, 2)
    with pytest.raises(ValueError, match="expected 1, 4, 9 or 16 coefficients together, got 5"):
        sh_degree_of(5)
    assert [sh_degree_of((d + 1) ** 2) for d in DEGREES] == list(DEGREES)
