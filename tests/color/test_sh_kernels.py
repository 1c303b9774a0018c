"""The SH kernels against the basis that defines them, and their slopes against differences."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.color._kernels import sh as _kernels_sh
from gsvis.scene.sh import sh_basis


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_and_slopes(degree: int) -> None:
    rng = np.random.default_rng(degree)
    points = rng.normal(size=(20, 3))
    size = (degree + 1) ** 2
    values, slopes = np.zeros(16), np.zeros((16, 3))
    for point in points:
        unit = point / np.linalg.norm(point)
        _kernels_sh.basis(*unit, degree, values)
        np.testing.assert_allclose(values[:size], sh_basis(unit[None], degree)[0], atol=1e-12)
        _kernels_sh.basis_slopes(*point, degree, slopes)
        for axis in range(3):
            step = np.eye(3)[axis] * 1e-5
            after, before = np.zeros(16), np.zeros(16)
            _kernels_sh.basis(*(point + step), degree, after)
            _kernels_sh.basis(*(point - step), degree, before)
            np.testing.assert_allclose(slopes[:size, axis], (after - before)[:size] / 2e-5, atol=1e-6)
