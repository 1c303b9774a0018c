"""Define the options of training and densification: plain values, checked on construction."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from gsvis import _check

__all__ = ["DensifyConfig", "TrainConfig", "decisive_options"]


@dataclass(frozen=True)
class DensifyConfig:
    """Rules for adding and removing Gaussians.

    Attributes:
        start: Step after which changes begin.
        stop: Step of the last change.
        every: Steps between changes.
        threshold: Mean gradient by projected centers, in half image sizes, above which a Gaussian is cloned or split.
        small: Largest scale of a cloned Gaussian, as a share of the extent; larger ones are split.
        split: Whether large ones are split in two; otherwise they are cloned too.
        most_share: Largest number of Gaussians to add at a time, as a share of all; those with the largest gradients
            are added.
        most_count: Number of Gaussians above which no more are added.
        least_opacity: Opacity below which a Gaussian is pruned.
        largest: Scale above which a Gaussian is pruned, as a share of the extent, after the first reset.
        reset_every: Steps between resets of opacities; 0 for none.
    """

    start: int = 500
    stop: int = 15_000
    every: int = 100
    threshold: float = 2e-4
    small: float = 0.01
    split: bool = True
    most_share: float = 1.0
    most_count: int = 5_000_000
    least_opacity: float = 0.005
    largest: float = 0.1
    reset_every: int = 3_000

    def __post_init__(self) -> None:
        for name in ("every", "most_count"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        for name in ("start", "stop", "reset_every"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")
        for name in ("threshold", "small", "largest"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite number > 0, got {getattr(self, name)}")
        if not 0.0 < self.most_share <= 1.0:
            raise ValueError(f"most_share: expected a share in (0, 1], got {self.most_share}")
        if not 0.0 <= self.least_opacity < 1.0:
            raise ValueError(f"least_opacity: expected a value in [0, 1), got {self.least_opacity}")


@dataclass(frozen=True)
class TrainConfig:
    """Options of training; defaults are the rates and rules of 3DGS.

    Attributes:
        iterations: Number of steps, one view each.
        sh_degree: Highest degree of color, 0 to 3.
        sh_every: Steps after which the degree rises by one, from 0; 0 starts at the highest.
        ssim_weight: Share of SSIM in the loss.
        means_rate: Learning rate of centers at the start, over the extent of the scene; falls exponentially.
        means_rate_end: Learning rate of centers at the last step.
        scales_rate, quats_rate, opacities_rate, sh0_rate, shN_rate: Learning rates of the other raw values.
        rates_end: Factor on these at the last step; they fall to it exponentially over the second half.
        densify: Rules for adding and removing Gaussians; None for no changes.
        evaluate_every: Steps between measurements on held-out views; 0 measures only at the end.
        seed: Seed of the order of views and of the positions of split Gaussians.
        backend: Backend of the rasterizer, which also says where training runs: "cuda" on a GPU.
    """

    iterations: int = 7_000
    sh_degree: int = 3
    sh_every: int = 1_000
    ssim_weight: float = 0.2
    means_rate: float = 1.6e-4
    means_rate_end: float = 1.6e-6
    scales_rate: float = 5e-3
    quats_rate: float = 1e-3
    opacities_rate: float = 5e-2
    sh0_rate: float = 2.5e-3
    shN_rate: float = 1.25e-4  # noqa: N815  the field's own name
    rates_end: float = 1.0
    densify: DensifyConfig | None = field(default_factory=DensifyConfig)
    evaluate_every: int = 1_000
    seed: int = 0
    backend: str = "auto"

    def __post_init__(self) -> None:
        _check.positive_int("iterations", self.iterations)
        for name in ("sh_degree", "sh_every", "evaluate_every", "seed"):
            _check.positive_int(name, getattr(self, name), at_least=0)
        if self.sh_degree > 3:
            raise ValueError(f"sh_degree: expected 0 to 3, got {self.sh_degree}")
        if not 0.0 <= self.ssim_weight <= 1.0:
            raise ValueError(f"ssim_weight: expected a share in [0, 1], got {self.ssim_weight}")
        for name in ("means", "means_end", "scales", "quats", "opacities", "sh0", "shN"):
            name = name.replace("means_end", "means_rate_end") if name == "means_end" else f"{name}_rate"
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite number > 0, got {getattr(self, name)}")
        if not 0.0 < self.rates_end <= 1.0:
            raise ValueError(f"rates_end: expected a factor in (0, 1], got {self.rates_end}")


def decisive_options(config: Any) -> dict[str, Any]:
    """Return the options that decide a result, as plain values for keys and records: the backend is always "auto".

    Results of two devices differ by rounding alone, and either is accepted. So a run that began on one device resumes
    on another.

    Args:
        config: A dataclass with a field `backend`, such as `TrainConfig`.

    Examples:
        >>> decisive_options(TrainConfig(backend="cuda")) == decisive_options(TrainConfig())
        True
    """
    return {**asdict(config), "backend": "auto"}
