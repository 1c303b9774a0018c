"""Evaluate SRBF colors of all Gaussians from one eye, or of each along shared directions.

A color is its base plus its terms in the variant's space, converted to RGB. It is clipped below at 0, and never above,
except that HSL limits saturation and lightness to [0, 1] before rescaling. Directions run from the eye to
the Gaussian. `gsvis.color.reference` is the plain twin.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color._kernels import rgb as _kernels_rgb
from gsvis.color._kernels import srbf as _kernels_srbf
from gsvis.color._kinds import is_tensor
from gsvis.color.srbf import SrbfColors
from gsvis.files.mapped import release_mapped
from gsvis.files.scratch import Scratch

if TYPE_CHECKING:
    from torch import Tensor

    from gsvis.color.evaluate_torch import SrbfTensors

__all__ = ["Evaluator", "evaluate", "evaluate_along"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]


class Evaluator:
    """Evaluate colors for many eyes; lays terms out once for vector instructions, 28 bytes each.

    Args:
        colors: N Gaussians with T terms.
        keep: Whether the colors are kept beside what is laid out. Otherwise the memory of those that lie in mapped
            files is given back.
        scratch: Makes the arrays of what is laid out, whose memory its owner may give back; None keeps them in memory.

    Attributes:
        source: The colors; None if they are not kept.

    Raises:
        ValueError: If `colors` is not a `SrbfColors`.
    """

    def __init__(self, colors: SrbfColors, *, keep: bool = True, scratch: Scratch | None = None) -> None:
        if not isinstance(colors, SrbfColors):
            raise ValueError(f"colors: expected SrbfColors, got {type(colors).__name__}")
        self.source = colors if keep else None
        self._space = _kernels_rgb.SPACES[colors.kind.space]
        order, starts = _layout(colors.counts)
        place = scratch or Scratch()
        slots = place.zeros((int(starts[-1]) * _kernels_srbf.SLOT, _kernels_srbf.LANES))
        terms = _check.read_only(colors.centers, colors.decays, np.ascontiguousarray(colors.amplitudes()))
        _kernels_srbf.pack(order, colors.offsets, starts, terms, slots)
        base = _in_windows(colors.base, order)
        if scratch is not None:
            base = scratch.copy(base)
        scales = _in_windows(colors.scales[:, None], order)
        self._packed = order, colors.offsets, starts, slots, base, np.ascontiguousarray(scales[:, 0])
        if not keep:
            release_mapped(vars(colors).values())

    def __len__(self) -> int:
        return len(self._packed[1]) - 1

    def __repr__(self) -> str:
        return f"Evaluator({len(self):,} Gaussians, {self.num_terms:,} terms)"

    @property
    def num_terms(self) -> int:
        """T, the number of terms."""
        return int(self._packed[1][-1])

    def colors(
        self, means: ArrayLike, eye: ArrayLike, *, active: ArrayLike | None = None, ids: ArrayLike | None = None
    ) -> F32:
        """Return the colors that one eye sees.

        Args:
            means: (N, 3) centers of the Gaussians, world frame. An eye at a center looks along +z.
            eye: (3,) viewpoint.
            active: (T,) bool, the terms to use, such as those received or active; None means all.
            ids: (M,) Gaussians, in any order; None means all. The cost grows with their number.

        Returns:
            (N, 3) or (M, 3) RGB, >= 0.

        Raises:
            ValueError: If a shape does not fit, a value is not finite or an id is not in [0, N).
        """
        (centers,) = _check.read_only(_check.floats("means", means, (len(self), 3)))
        viewpoint = _check.floats("eye", eye, (3,), np.float64)
        mask = _mask(active, self.num_terms)
        if ids is None:
            out = np.empty((len(self), 3), np.float32)
            windows = np.arange(len(self._packed[4]))
            _kernels_srbf.colors_from_eye(windows, centers, viewpoint, self._space, self._packed, mask, out)
            return out
        chosen = _check.integers("ids", ids, ("M",))
        _check.in_range("ids", chosen, 0, len(self) - 1)
        windows, places = np.unique(chosen // _kernels_srbf.WINDOW, return_inverse=True)
        out = np.empty((len(windows) * _kernels_srbf.WINDOW, 3), np.float32)
        _kernels_srbf.colors_from_eye(windows, centers, viewpoint, self._space, self._packed, mask, out)
        return np.asarray(out[places * _kernels_srbf.WINDOW + chosen % _kernels_srbf.WINDOW])

    def along(self, directions: ArrayLike) -> F32:
        """Return the colors along directions that all Gaussians share.

        Args:
            directions: (D, 3) from the eye to the Gaussian, of any length > 0.

        Returns:
            (N, D, 3) RGB, >= 0: 12 N D bytes.

        Raises:
            ValueError: If a direction is zero or not finite.
        """
        units = _check.unit_vectors("directions", directions)
        padded = np.zeros((3, -(-len(units) // _kernels_srbf.LANES) * _kernels_srbf.LANES), np.float32)
        padded[:, : len(units)] = units.T
        out = np.empty((len(self), len(units), 3), np.float32)
        _kernels_srbf.colors_along(padded, self._space, self._packed, out)
        return out


@overload
def evaluate(
    colors: SrbfTensors, means: Tensor, eye: ArrayLike | Tensor, *, active: ArrayLike | Tensor | None = None
) -> Tensor: ...
@overload
def evaluate(colors: SrbfColors, means: ArrayLike, eye: ArrayLike, *, active: ArrayLike | None = None) -> F32: ...
def evaluate(colors: Any, means: Any, eye: Any, *, active: Any = None) -> Any:
    """Return the colors of all Gaussians as one eye sees them; `Evaluator` is faster for more than one eye.

    Args:
        colors: N Gaussians with T terms, as arrays, or as `SrbfTensors` if `means` is a tensor.
        means: (N, 3) centers of the Gaussians, world frame. An eye at a center looks along +z.
        eye: (3,) viewpoint.
        active: (T,) bool, the terms to use, such as those received or active; None means all.

    Returns:
        (N, 3) RGB, >= 0: float32, or a tensor with gradients (see `evaluate_torch`).

    Raises:
        ValueError: If a shape does not fit or a value is not finite.

    References:
        SRBF-Gaussian, equations 2 and 3.

    Examples:
        >>> lobe = SrbfColors("rgb", [[0.5, 0.5, 0.5]], [1], [0, 1], [0],
        ...                   [[0, 0]], [10.0], [[0.2, 0, 0]])
        >>> [evaluate(lobe, [[0, 0, 0]], eye)[0].round(3).tolist() for eye in ([0, 0, -1], [0, 0, 1])]
        [[0.7, 0.5, 0.5], [0.5, 0.5, 0.5]]
    """
    if is_tensor(means):
        from gsvis.color.evaluate_torch import evaluate_torch

        return evaluate_torch(colors, means, eye, active=active)
    return Evaluator(colors).colors(means, eye, active=active)


def evaluate_along(colors: SrbfColors, directions: ArrayLike) -> F32:
    """Return (N, D, 3) colors along shared (D, 3) directions; pass slices of `colors` if memory is short."""
    return Evaluator(colors).along(directions)


def _mask(active: ArrayLike | None, terms: int) -> NDArray[np.bool_]:
    """Return a (T,) mask, or (0,) for all terms."""
    if active is None:
        return np.zeros(0, bool)
    mask = np.ascontiguousarray(active)
    if mask.dtype != bool or mask.shape != (terms,):
        raise ValueError(f"active: expected bool of shape ({terms},), got {mask.dtype} of {mask.shape}")
    return mask


def _layout(counts: I64) -> tuple[NDArray[np.uint8], I64]:
    """Return (N,) order within windows by falling number of terms, and (groups + 1,) first slots of the groups."""
    window = _kernels_srbf.WINDOW
    lanes = _kernels_srbf.LANES
    n = len(counts)
    kind = np.int16 if counts.max(initial=0) < 2**15 else np.int64  # NumPy sorts short integers by radix
    padded = np.full(-(-n // window) * window, -1, kind)
    padded[:n] = counts
    rows = padded.reshape(-1, window)
    order = np.argsort(-rows, axis=1, kind="stable")
    most = np.take_along_axis(rows, order, axis=1)[:, ::lanes].ravel()[: -(-n // lanes)]
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(most, dtype=np.int64)])
    return order.astype(np.uint8).ravel()[:n], starts


def _in_windows(values: F32, order: NDArray[np.uint8]) -> F32:
    """Return (windows, K, WINDOW) from (N, K), ordered; padded with ones."""
    window = _kernels_srbf.WINDOW
    n, channels = values.shape
    padded = np.ones((-(-n // window) * window, channels), np.float32)
    padded[:n] = values[np.arange(n) // window * window + order]
    return np.ascontiguousarray(padded.reshape(-1, window, channels).transpose(0, 2, 1))
