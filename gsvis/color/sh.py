"""Evaluate colors of Gaussians from their spherical harmonics: from one eye, or along many directions at once.

Color is 0.5 plus the sum of coefficients times harmonics, clipped below at 0 and never above. Harmonics are evaluated
at the unit vector from the eye to the Gaussian, scene frame. Direction sets point the other way; `towards_gaussian`
changes the sign. `gsvis.scene.sh` defines the basis.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color._kernels import sh as _kernels_sh
from gsvis.color._kinds import is_tensor, numbers
from gsvis.files.mapped import release_mapped
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import sh_basis, sh_degree_of

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "seen_sh_colors",
    "sh_colors",
    "sh_colors_along",
    "towards_gaussian",
    "write_sh_colors",
    "write_sh_gradients",
]

_BLOCK = 1 << 18  # Gaussians whose harmonics are read at a time


class _Tensors(Protocol):
    """An object with tensors under the names of `Gaussians`, such as `gsvis.render.GaussianTensors`."""

    @property
    def means(self) -> Tensor: ...
    @property
    def sh0(self) -> Tensor: ...
    @property
    def shN(self) -> Tensor: ...  # noqa: N802  the field's own name


@overload
def towards_gaussian(directions: Tensor) -> Tensor: ...
@overload
def towards_gaussian(directions: ArrayLike) -> NDArray[np.floating[Any]]: ...
def towards_gaussian(directions: Any) -> Any:
    """Return directions of a direction set (Gaussian to eye) as color functions take them (eye to Gaussian).

    Args:
        directions: (..., 3) from the Gaussian to the eye.

    Returns:
        (..., 3) from the eye to the Gaussian: the same with the opposite sign. float64 and tensors keep their type; all
        else becomes float32.

    Raises:
        ValueError: If they are not numbers or, in an array, not finite.
    """
    return -numbers("directions", directions)[1]


@overload
def sh_colors(
    g: Gaussians, eye: ArrayLike, *, sh_degree: int | None = None, clipped: bool = True
) -> NDArray[np.float32]: ...
@overload
def sh_colors(
    g: _Tensors, eye: ArrayLike | Tensor, *, sh_degree: int | None = None, clipped: bool = True
) -> Tensor: ...
def sh_colors(g: Any, eye: Any, *, sh_degree: int | None = None, clipped: bool = True) -> Any:
    """Return the colors of all Gaussians from one eye.

    Args:
        g: N Gaussians, as arrays or as tensors.
        eye: (3,) viewpoint, world frame.
        sh_degree: Degree to evaluate, from 0 to the degree of `g`, which is the default.
        clipped: Clip below at 0, as images need it.

    Returns:
        (N, 3) RGB: float32, or a tensor of the dtype and device of `g` with gradients by means, sh0, shN and eye. A
        Gaussian centered at the eye is seen along +z.

    Raises:
        ValueError: If the eye is not three finite numbers, or the degree exceeds that of `g`.
    """
    own = sh_degree_of(1 + g.shN.shape[1])
    degree = own if sh_degree is None else _check.positive_int("sh_degree", sh_degree, at_least=0)
    if degree > own:
        raise ValueError(f"sh_degree: expected 0 to {own}, the scene's own, got {degree}")
    if is_tensor(g.means):
        from gsvis.color.sh_torch import sh_colors_torch

        return sh_colors_torch(g.means, g.sh0, g.shN[:, : (degree + 1) ** 2 - 1], eye, clipped=clipped)
    viewpoint = _check.floats("eye", eye, (3,), np.float64)
    colors = np.empty((len(g.means), 3), np.float32)
    lowest = np.float32(0.0 if clipped else -np.inf)
    every = np.arange(len(g.means), dtype=np.int32)
    _kernels_sh.colors_from_sh(every, *_check.read_only(g.means, g.sh0, g.shN), degree, viewpoint, lowest, colors)
    return colors


def write_sh_colors(
    ids: NDArray[np.int32],
    coefficients: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    degree: int,
    eye: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Write the colors of some Gaussians from one eye; for renderers, which have checked their arrays.

    Args:
        ids: (M,) Gaussians.
        coefficients: means (N, 3), sh0 (N, 1, 3) and shN (N, K - 1, 3), C-contiguous.
        degree: Degree to evaluate.
        eye: (3,) viewpoint, world frame.
        out: (M, at least 3); the first three columns are written, clipped below at 0.
    """
    _kernels_sh.colors_from_sh(ids, *_check.read_only(*coefficients), degree, eye, np.float32(0.0), out)


def seen_sh_colors(g: Gaussians, ids: NDArray[np.int64], eye: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the SH colors (M, 3) of some Gaussians from one eye, clipped below at 0.

    The memory of harmonics that lie in a mapped file is given back block by block: few Gaussians lie in many pages.

    Args:
        g: N Gaussians.
        ids: (M,) Gaussians, best in ascending order.
        eye: (3,) viewpoint, world frame.
    """
    out = np.empty((len(ids), 3), np.float32)
    for start in range(0, len(ids), _BLOCK):
        some = slice(start, start + _BLOCK)
        write_sh_colors(ids[some].astype(np.int32), (g.means, g.sh0, g.shN), g.sh_degree, eye, out[some])
        release_mapped([g.shN])
    return out


def write_sh_gradients(
    ids: NDArray[np.int32],
    coefficients: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    degree: int,
    eye: NDArray[np.float64],
    colors: tuple[NDArray[np.float32], NDArray[np.float64]],
    out: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    """Propagate gradients back through `write_sh_colors`.

    Args:
        ids: (M,) Gaussians.
        coefficients: means (N, 3), sh0 (N, 1, 3) and shN (N, K - 1, 3), C-contiguous.
        degree: Degree that was evaluated.
        eye: (3,) viewpoint, world frame.
        colors: The written colors (M, at least 3), and the gradients by their first three columns (M, at least 3).
        out: Gradients by sh0, shN and means; the rows of `ids` are overwritten (of means: added to).
    """
    v_sh0, v_shN, v_means = out
    _kernels_sh.colors_from_sh_backward(ids, *coefficients, degree, eye, *colors, v_sh0, v_shN, v_means)


def sh_colors_along(
    sh0: ArrayLike,
    shN: ArrayLike,  # noqa: N803  the field's own name
    directions: ArrayLike,
    *,
    clipped: bool = True,
) -> NDArray[np.float32]:
    """Return the colors of all Gaussians along shared directions, by one matrix product.

    The result takes 12 N D bytes: pass slices of a large scene.

    Args:
        sh0: (N, 1, 3) constant coefficients.
        shN: (N, K-1, 3) higher coefficients, K in {1, 4, 9, 16}.
        directions: (D, 3) of any length > 0, from the eye to the Gaussian; see `towards_gaussian`.
        clipped: Clip below at 0. A fit of smooth functions to colors may not want this.

    Returns:
        (N, D, 3) float32 RGB.

    Raises:
        ValueError: If a shape is wrong, a value is not finite or a direction is zero.
    """
    base = _check.floats("sh0", sh0, ("N", 1, 3))
    higher = _check.floats("shN", shN, ("N", "K-1", 3))
    count = _check.same_length(sh0=base, shN=higher)
    size = 1 + higher.shape[1]
    basis = sh_basis(_check.unit_vectors("directions", directions), sh_degree_of(size))
    # One row per Gaussian, (coefficient, channel) and a 1 for the 0.5; one column per (direction, channel).
    # Two thirds of the matrix are zeros, but it is faster than many small products or a transposition.
    rows = np.ones((count, 3 * size + 1), np.float32)
    rows[:, :3] = base[:, 0]
    rows[:, 3:-1] = higher.reshape(count, 3 * size - 3)
    matrix = np.full((3 * size + 1, 3 * len(basis)), 0.5, np.float32)
    matrix[:-1] = np.einsum("dk,ce->kcde", basis, np.eye(3)).reshape(3 * size, 3 * len(basis))
    colors: NDArray[np.float32] = rows @ matrix
    if clipped:
        np.maximum(colors, 0.0, out=colors)
    return colors.reshape(count, len(basis), 3)
