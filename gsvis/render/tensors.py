"""Gaussians as torch tensors, the inputs that the rasterizers can differentiate.

Values are activated, as in `gsvis.scene.Gaussians`: same names, shapes, frame and units. Nothing here renders.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import sh_degree_of

__all__ = ["GaussianTensors", "rotations_from_quats"]


@dataclass(frozen=True, eq=False, repr=False)
class GaussianTensors:
    """N 3D Gaussians as tensors of one float type on one device, any of which may require a gradient.

    The constructor checks shapes but not values, to keep training steps fast. `check_values` checks values.

    Args:
        means: (N, 3) centers, scene units.
        quats: (N, 4) rotations wxyz, any length > 0; normalized where they are used.
        scales: (N, 3) standard deviations along the rotated axes, scene units, > 0.
        opacities: (N,) in [0, 1].
        sh0: (N, 1, 3) constant SH coefficient of each color channel.
        shN: (N, K-1, 3) higher SH coefficients, K in {1, 4, 9, 16}.

    Raises:
        ValueError: If a shape, a dtype or a device does not fit; the message names the argument.

    Examples:
        >>> ball = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 2]], [0.5], [[[0, 0, 0]]])
        >>> GaussianTensors.from_gaussians(ball, torch.float64)
        GaussianTensors(1 of SH degree 0, torch.float64 on cpu)
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    shN: Tensor  # noqa: N815  the field's own name

    def __post_init__(self) -> None:
        for name, shape in _SHAPES.items():
            value = getattr(self, name)
            if not isinstance(value, Tensor):
                raise ValueError(f"{name}: expected a torch tensor, got {type(value).__name__}")
            if not value.is_floating_point() or value.dtype != self.means.dtype:
                raise ValueError(f"{name}: expected one float dtype for all, got {value.dtype}")
            if value.device != self.means.device:
                raise ValueError(f"{name}: expected all on {self.means.device}, got {value.device}")
            length = len(self.means) if self.means.ndim else "N"
            fits = value.ndim == 1 + len(shape) and all(
                want in (None, have) for want, have in zip((length, *shape), value.shape, strict=True)
            )
            if not fits:
                spelled = ", ".join(str(s) if s is not None else "K-1" for s in (length, *shape))
                raise ValueError(f"{name}: expected shape ({spelled}), got {tuple(value.shape)}")
        sh_degree_of(1 + self.shN.shape[1])

    @classmethod
    def from_gaussians(
        cls,
        gaussians: Gaussians,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        requires_grad: bool = False,
    ) -> GaussianTensors:
        """Return a copy of a scene as leaf tensors.

        Args:
            gaussians: The scene.
            dtype: A float type; the scene holds float32.
            device: Device of the tensors.
            requires_grad: Whether all six tensors require gradients.
        """
        return cls(
            **{
                name: torch.tensor(getattr(gaussians, name), dtype=dtype, device=device, requires_grad=requires_grad)
                for name in _SHAPES
            }
        )

    def check_values(self) -> None:
        """Raise unless every value is finite and in its range.

        Raises:
            ValueError: If a value is not finite, a quaternion is zero, a scale is not positive or an opacity lies
                outside [0, 1]; the message names the argument.
        """
        if len(self) == 0:
            return
        for name in _SHAPES:
            value = getattr(self, name).detach()
            if not bool(torch.isfinite(value).all()):
                index = tuple(torch.nonzero(~torch.isfinite(value))[0].tolist())
                raise ValueError(f"{name}: expected finite values, got {value[index].item()} at index {index}")
        lengths = self.quats.detach().abs().amax(dim=1)
        if lengths.min() <= 0:
            raise ValueError(f"quats: expected non-zero quaternions, got a zero one at index {int(lengths.argmin())}")
        if self.scales.detach().min() <= 0:
            raise ValueError(f"scales: expected values > 0, got {self.scales.detach().min().item():g}")
        low, high = self.opacities.detach().aminmax()
        if low < 0 or high > 1:
            worst = low if low < 0 else high
            raise ValueError(f"opacities: expected values in [0, 1], got {worst.item():g}")

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return (
            f"GaussianTensors({len(self):,} of SH degree {self.sh_degree}, {self.means.dtype} on {self.means.device})"
        )

    @property
    def sh_degree(self) -> int:
        """Degree of the SH colors, 0 to 3."""
        return sh_degree_of(1 + self.shN.shape[1])


_SHAPES: dict[str, tuple[int | None, ...]] = dict(
    zip((f.name for f in fields(GaussianTensors)), ((3,), (4,), (3,), (), (1, 3), (None, 3)), strict=True)
)


def rotations_from_quats(quats: Tensor) -> Tensor:
    """Return (N, 3, 3) rotations, world from Gaussian, of (N, 4) quaternions wxyz of any length."""
    w, x, y, z = normalize(quats, dim=1).unbind(dim=1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
