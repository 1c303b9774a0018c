"""Evaluate SRBF colors in plain torch: any float type, any device, gradients by everything that is not an integer.

The twin of `gsvis.color.evaluate` for training and for other devices: same values, frame and conventions. The
other modules of this room import torch only for tensor arguments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from gsvis import _check
from gsvis.color.spaces import hsl_to_rgb
from gsvis.color.srbf import SrbfColors
from gsvis.color.variants import Variant, variant

__all__ = ["SrbfTensors", "evaluate_torch"]

_FLOATS = ("base", "scales", "centers", "decays", "intensities")
_INTEGERS = ("offsets", "functions")


@dataclass(frozen=True, eq=False, repr=False)
class SrbfTensors:
    """Colors of N Gaussians as tensors on one device: a base and T terms, named as in `SrbfColors`.

    Shapes are checked here, values are not, to keep training steps fast. `to_colors` checks them.

    Args:
        variant: One of `VARIANTS`.
        base: (N, 3) base colors in the variant's space.
        scales: (N,) > 0; divisor that fits RGB into its space.
        offsets: (N + 1,) int64; the terms of Gaussian i are offsets[i]:offsets[i + 1].
        functions: (T,) int64, index into the variant's functions.
        centers: (T, 2) polar angle and azimuth of the center, radians.
        decays: (T,) lambda of equation 3, > 0.
        intensities: (T, I), I given by the variant.

    Raises:
        ValueError: If a shape, a dtype or a device does not fit; the message names the argument.
    """

    variant: str
    base: Tensor
    scales: Tensor
    offsets: Tensor
    functions: Tensor
    centers: Tensor
    decays: Tensor
    intensities: Tensor

    def __post_init__(self) -> None:
        kind = variant(self.variant)
        n = len(self.base)
        t = len(self.functions)
        shapes = ((n, 3), (n,), (t, 2), (t,), (t, kind.intensities), (n + 1,), (t,))
        for name, shape in zip(_FLOATS + _INTEGERS, shapes, strict=True):
            value = getattr(self, name)
            want = torch.int64 if name in _INTEGERS else self.base.dtype
            if value.dtype != want or not (name in _INTEGERS or value.is_floating_point()):
                expected = "int64" if name in _INTEGERS else "one float dtype for all"
                raise ValueError(f"{name}: expected {expected}, got {value.dtype}")
            if value.device != self.base.device:
                raise ValueError(f"{name}: expected all on {self.base.device}, got {value.device}")
            if tuple(value.shape) != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {tuple(value.shape)}")

    @classmethod
    def from_colors(
        cls,
        colors: SrbfColors,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        requires_grad: bool = False,
    ) -> SrbfTensors:
        """Return a copy of colors as leaf tensors.

        Args:
            colors: The colors.
            dtype: A float type; the colors hold float32.
            device: Device of the tensors.
            requires_grad: Whether base, centers, decays and intensities collect gradients; scales do not.
        """
        fields = {
            name: torch.tensor(
                getattr(colors, name), dtype=dtype, device=device, requires_grad=requires_grad and name != "scales"
            )
            for name in _FLOATS
        }
        integers = {
            name: torch.tensor(getattr(colors, name).astype(np.int64), dtype=torch.int64, device=device)
            for name in _INTEGERS
        }
        return cls(colors.variant, **fields, **integers)

    def to_colors(self) -> SrbfColors:
        """Return a checked copy as arrays.

        Raises:
            ValueError: If a value is not finite or out of its range.
        """
        arrays = {name: getattr(self, name).detach().cpu().numpy().copy() for name in _FLOATS + _INTEGERS}
        return SrbfColors(self.variant, **arrays)

    def __len__(self) -> int:
        return len(self.base)

    def __repr__(self) -> str:
        place = f"{self.base.dtype} on {self.base.device}"
        return f"SrbfTensors({self.variant!r}, {len(self):,} Gaussians, {self.num_terms:,} terms, {place})"

    @property
    def kind(self) -> Variant:
        """The variant's definition."""
        return variant(self.variant)

    @property
    def num_terms(self) -> int:
        """Number of terms, T."""
        return len(self.functions)

    @property
    def requires_grad(self) -> bool:
        """Whether any of the tensors collects gradients."""
        return any(getattr(self, name).requires_grad for name in _FLOATS)

    @property
    def gaussian_ids(self) -> Tensor:
        """(T,) index of the Gaussian of each term."""
        every = torch.arange(len(self), device=self.base.device)
        return torch.repeat_interleave(every, self.offsets.diff(), output_size=self.num_terms)

    def amplitudes(self) -> Tensor:
        """Return (T, 3) what each term adds to the base, in the variant's space, where its SRBF is 1."""
        kind = self.kind
        if not kind.components:
            return self.intensities
        component = torch.tensor(kind.components, device=self.base.device)[self.functions]
        chosen = torch.nn.functional.one_hot(component, 3).to(self.base)
        return self.intensities * self.base[self.gaussian_ids] * chosen


def evaluate_torch(
    colors: SrbfTensors, means: Tensor, eye: ArrayLike | Tensor, *, active: ArrayLike | Tensor | None = None
) -> Tensor:
    """Return the colors of all Gaussians as one eye sees them. Checks shapes, not values.

    Args:
        colors: N Gaussians with T terms.
        means: (N, 3) centers of the Gaussians, world frame. An eye at a center looks along +z.
        eye: (3,) viewpoint; a tensor keeps its gradient.
        active: (T,) bool, the terms to use; None means all.

    Returns:
        (N, 3) RGB, >= 0, of the dtype and device of `colors`, with gradients by its floats, means and eye. Clipped
        colors have no gradient.

    Raises:
        ValueError: If a shape does not fit, or an eye given as an array is not finite.
    """
    if tuple(means.shape) != (len(colors), 3):
        raise ValueError(f"means: expected shape ({len(colors)}, 3), got {tuple(means.shape)}")
    if isinstance(eye, Tensor) and tuple(eye.shape) != (3,):
        raise ValueError(f"eye: expected shape (3,), got {tuple(eye.shape)}")
    viewpoint = eye if isinstance(eye, Tensor) else torch.tensor(_check.floats("eye", eye, (3,), np.float64))
    offsets = means.to(colors.base) - viewpoint.to(colors.base)
    squares = offsets.square().sum(dim=1, keepdim=True)
    ahead = offsets.new_tensor([0.0, 0.0, 1.0])
    directions = torch.where(squares > 0, offsets / torch.where(squares > 0, squares, 1.0).sqrt(), ahead)
    ids = colors.gaussian_ids
    centers = colors.centers
    decays = colors.decays
    amplitudes = colors.amplitudes()
    if active is not None:
        mask = torch.as_tensor(active, device=ids.device)
        if mask.dtype != torch.bool or tuple(mask.shape) != (colors.num_terms,):
            got = f"{mask.dtype} of {tuple(mask.shape)}"
            raise ValueError(f"active: expected bool of shape ({colors.num_terms},), got {got}")
        ids = ids[mask]
        centers = centers[mask]
        decays = decays[mask]
        amplitudes = amplitudes[mask]
    # decay (x.c - 1) from the chord: x.c would lose the digits that a narrow lobe needs.
    chords = directions[ids] - _unit_vectors(centers)
    lobes = torch.exp(-0.5 * decays * chords.square().sum(dim=1))
    return _to_rgb(colors, colors.base.index_add(0, ids, lobes[:, None] * amplitudes))


def _unit_vectors(coordinates: Tensor) -> Tensor:
    """Return (T, 3) unit vectors from polar angles and azimuths."""
    theta, phi = coordinates.unbind(-1)
    return torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], dim=-1)


def _to_rgb(colors: SrbfTensors, values: Tensor) -> Tensor:
    """Return RGB of (N, 3) values in the variant's space."""
    if colors.kind.space == "rgb":
        return values.clamp(min=0.0)
    limited = torch.cat([values[:, :1], values[:, 1:].clamp(0.0, 1.0)], dim=1)
    return hsl_to_rgb(limited) * colors.scales[:, None]
