"""Learn colors by gradient: base colors and terms of SRBF colors, or SH, of Gaussians whose geometry stays fixed.

The targets are photographs, or renders of the scene itself. A step draws one view, compares it, and updates the colors
with Adam. Images, frames and cameras are those of `PosedImages`. This module writes no file and starts no fit: it takes
colors that `gsvis.color.fit_srbf` found.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsvis import _check
from gsvis.color.evaluate_torch import SrbfTensors, evaluate_torch
from gsvis.color.learning import LearnedValues, RowsOfView, SeenColors, see_rgb
from gsvis.color.sh import seen_sh_colors
from gsvis.color.srbf import MAX_DECAY, SrbfColors, spherical_coordinates, unit_vectors
from gsvis.files.mapped import release_mapped
from gsvis.files.scratch import Scratch
from gsvis.jobs.freed_memory import release_freed_memory
from gsvis.jobs.in_order import in_order
from gsvis.progress import Progress, silent
from gsvis.render.device import OnDevice
from gsvis.render.device_scene import DeviceScene
from gsvis.render.device_torch import DeviceView
from gsvis.render.fixed_view import FixedView
from gsvis.render.rasterizer import rasterize
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.images import PosedImages
from gsvis.train.lazy_adam import LazyAdam
from gsvis.train.loss import photometric_loss

__all__ = ["LearnConfig", "learn_colors", "learn_sh", "view_of_step"]

_BLOCK = 1 << 20  # terms whose centers are brought into range at a time
_REST = 4  # steps after which memory is given back; a view brings back half of the pages


@dataclass(frozen=True)
class LearnConfig:
    """Options of learning colors.

    Attributes:
        steps: Number of steps, one view each; 0 leaves the colors as they are.
        base_rate: Learning rate of base colors, and of the constant of SH.
        intensity_rate: Learning rate of intensities.
        center_rate: Learning rate of the angles of centers, radians.
        decay_rate: Learning rate of the logarithms of decays.
        sh_rate: Learning rate of the other coefficients of SH, for `learn_sh`.
        rates_end: Factor on all rates at the last step; they fall to it exponentially.
        ssim_weight: Share of SSIM in the loss; the rest is the mean absolute difference.
        squared: Whether the loss is the mean squared difference instead, which suits renders as targets.
        seed: Seed of the order of views.

    Raises:
        ValueError: If a value is out of range.
    """

    steps: int = 300
    base_rate: float = 5e-3
    intensity_rate: float = 5e-3
    center_rate: float = 1e-2
    decay_rate: float = 1e-2
    sh_rate: float = 1.25e-4
    rates_end: float = 0.1
    ssim_weight: float = 0.2
    squared: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "seed"):
            _check.positive_int(name, getattr(self, name), at_least=0)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_rate") and not 0.0 <= value < math.inf:
                raise ValueError(f"{field.name}: expected a finite number of at least 0, got {value!r}")
        if not 0.0 < self.rates_end <= 1.0:
            raise ValueError(f"rates_end: expected a factor in (0, 1], got {self.rates_end!r}")
        if not 0.0 <= self.ssim_weight <= 1.0:
            raise ValueError(f"ssim_weight: expected a share in [0, 1], got {self.ssim_weight!r}")

    @classmethod
    def for_renders(cls, steps: int = 300, seed: int = 0) -> LearnConfig:
        """Return options for renders of the scene, which the fitted colors resemble already: small steps, squares."""
        return cls(
            steps=steps,
            base_rate=2e-4,
            intensity_rate=5e-4,
            center_rate=4e-3,
            decay_rate=1e-2,
            squared=True,
            seed=seed,
        )

    @classmethod
    def for_records(cls, steps: int = 300, seed: int = 0) -> LearnConfig:
        """Return options for rounded records, whose lobes stay: base colors and intensities alone, and squares."""
        return cls(
            steps=steps,
            base_rate=2e-4,
            intensity_rate=1.5e-4,
            center_rate=0.0,
            decay_rate=0.0,
            squared=True,
            seed=seed,
        )


def learn_colors(
    g: Gaussians,
    colors: SrbfColors,
    views: PosedImages | Cameras,
    config: LearnConfig | None = None,
    *,
    shown: NDArray[np.bool_] | None = None,
    backend: str = "auto",
    folder: Path | None = None,
    progress: Progress = silent,
) -> SrbfColors:
    """Return SRBF colors that show given images better. Geometry and number of terms stay the same.

    Gaussians that no view shows keep their colors. A device draws views and finds gradients; the CPU evaluates colors
    and takes steps, and also draws from where the memory of the device runs out.

    Args:
        g: N Gaussians.
        colors: Colors to begin with, N Gaussians with T terms.
        views: Images to show, with their cameras; or cameras alone, for which the Gaussians drawn with their SH colors
            are the images. That needs `config.squared`, and no image is kept.
        config: Options; None means `LearnConfig()`.
        shown: (N,) bool, the Gaussians to draw, such as those of the highest of several levels; None means all.
        backend: Backend that draws, see `DeviceScene`.
        folder: Folder for temporary files of what is learned, so that memory holds what recent views show; None keeps
            all in memory. The memory of Gaussians and colors that lie in mapped files is given back then too.
        progress: Called with every step; stage "learn".

    Raises:
        ValueError: If lengths differ, there are no views, or there are cameras alone without `config.squared`.
    """
    config = config or LearnConfig()
    _check.same_length(g=g.means, colors=colors.base)
    if len(views) == 0:
        raise ValueError("views: expected at least one image to learn from, got none")
    if isinstance(views, Cameras) and not config.squared:
        raise ValueError("views: expected images for a loss that is not squared, got cameras alone; set squared")
    ids = np.arange(len(g)) if shown is None else np.flatnonzero(shown)
    if config.steps == 0 or len(colors) == 0 or len(ids) == 0:
        return colors
    cameras = views if isinstance(views, Cameras) else views.cameras
    student = _Student(g, colors, config, Scratch(folder))
    drawn = g.without_harmonics()[ids]
    there = DeviceScene(drawn, backend)
    work = OnDevice("colors are learned", there.on_device)

    def look(seen: FixedView | DeviceView) -> _Look:
        """Return a view, and what it is to show, unless that is an image."""
        where = ids[seen.ids]
        wanted = seen_sh_colors(g, where, seen.eye) if isinstance(views, Cameras) else None
        return _Look(seen, where, wanted)

    def look_ahead(step: int) -> _Look | None:
        """Return the view of a step, which no step changes, while another one is taken; None on a device."""
        if work.works or folder is not None:  # a view of a large scene takes most of a gigabyte
            return None
        return look(FixedView(drawn, cameras[view_of_step(step, len(views), config.seed)]))

    def descend(index: int, at: _Look) -> tuple[SeenColors, NDArray[np.float32]]:
        """Return the colors that a view shows, and the gradient by them."""
        found = student.see(at.where, at.seen.eye)
        if at.wanted is None:
            assert not isinstance(views, Cameras)
            return found, _by_image(at.seen, found.colors, views.image(index), config)
        return found, _by_own_image(at.seen, found.colors, at.wanted)

    def descend_there(index: int) -> tuple[SeenColors, NDArray[np.float32]]:
        seen = DeviceView(there.tensors, cameras[index], backend, antialiased=g.facts.antialiased)
        return descend(index, look(seen))

    def descend_here(index: int, ready: _Look | None) -> tuple[SeenColors, NDArray[np.float32]]:
        return descend(index, ready or look(FixedView(drawn, cameras[index])))

    progress("learn", 0, config.steps)
    for step, ready in enumerate(in_order(look_ahead, range(config.steps), threads=1)):
        index = view_of_step(step, len(views), config.seed)
        found, by_colors = work.run(partial(descend_there, index), partial(descend_here, index, ready))
        student.step(found, by_colors)
        progress("learn", step + 1, config.steps)
    return student.finish()


class _Look(NamedTuple):
    """A view to learn from.

    Attributes:
        seen: The view.
        where: (M,) the Gaussians that it shows.
        wanted: (M, 3) the colors that they should have; None where an image says it.
    """

    seen: FixedView | DeviceView
    where: NDArray[np.int64]
    wanted: NDArray[np.float32] | None


def view_of_step(step: int, count: int, seed: int) -> int:
    """Return the index of the view of a step: each view once per round, in random order."""
    turn, place = divmod(step, count)
    return int(np.random.default_rng([seed, turn]).permutation(count)[place])


def _by_own_image(
    seen: FixedView | DeviceView, found: NDArray[np.float32], wanted: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the gradient (M, 3) of the mean squared difference of two images, by the colors of the first.

    An image is linear in the colors, so that the difference of colors shows the difference of images.
    """
    difference = seen.image(found - wanted)
    return seen.by_colors(difference * np.float32(2.0 / difference.size))


def _by_image(
    seen: FixedView | DeviceView, found: NDArray[np.float32], target: NDArray[np.float32], config: LearnConfig
) -> NDArray[np.float32]:
    """Return the gradient (M, 3) of the loss of a drawn view against an image, by its colors."""
    image = torch.from_numpy(seen.image(found)).requires_grad_()
    (by_image,) = torch.autograd.grad(_loss(image, torch.from_numpy(target), config), [image])
    return seen.by_colors(by_image.numpy())


class _Student:
    """Colors that change step by step.

    Args:
        g: N Gaussians.
        colors: Colors to begin with.
        config: Steps and rates.
        scratch: Makes the arrays that change.
    """

    def __init__(self, g: Gaussians, colors: SrbfColors, config: LearnConfig, scratch: Scratch) -> None:
        self._scene = g
        self._begun = colors
        self._scratch = scratch
        fall = config.rates_end ** (1.0 / max(config.steps - 1, 1))
        terms = {
            "centers": scratch.copy(colors.centers),
            "growth": scratch.zeros((colors.num_terms, 1)),  # logarithms, so that no growth changes no bit
            "intensities": scratch.copy(colors.intensities),
        }
        rates = {
            "centers": config.center_rate,
            "growth": config.decay_rate,
            "intensities": config.intensity_rate,
        }
        bases = {"base": scratch.copy(colors.base)}
        self._bases = LazyAdam(bases, {"base": config.base_rate}, fall, config.steps, scratch)
        self._terms = LazyAdam(terms, rates, fall, config.steps, scratch)

    def see(self, rows: NDArray[np.int64], eye: NDArray[np.float64]) -> SeenColors:
        """Return the colors of some Gaussians, ascending, as an eye sees them."""
        begun = self._begun
        starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(begun.counts[rows])])
        terms = np.arange(starts[-1]) + np.repeat(begun.offsets[rows] - starts[:-1], np.diff(starts))
        self._bases.catch_up(rows)
        self._terms.catch_up(terms)
        see = see_rgb if begun.kind.space == "rgb" else _see_by_torch
        values = self._bases.values | self._terms.values
        return see(begun, values, RowsOfView(rows, terms, starts), self._scene.means, eye)

    def step(self, seen: SeenColors, by_colors: NDArray[np.float32]) -> None:
        """Take one step along the gradient (M, 3) of a loss by the colors that were seen; rest after some steps."""
        gradients = seen.gradients(by_colors)
        self._bases.step(seen.rows.gaussians, gradients)
        self._terms.step(seen.rows.terms, gradients)
        if self._bases.step_count % _REST == 1:
            self._rest()

    def _rest(self) -> None:
        """Give back what was freed, and the memory of what lies in files; the next step reads its rows again."""
        self._scratch.release()
        release_freed_memory()
        release_mapped([*vars(self._scene).values(), *vars(self._begun).values()])

    def finish(self) -> SrbfColors:
        """Return the colors; what never changed is the same to the bit."""
        self._bases.finish()
        self._terms.finish()
        begun = self._begun
        angles = self._terms.values["centers"]
        for start in range(0, len(angles), _BLOCK):
            part = angles[start : start + _BLOCK]
            moved = (part != begun.centers[start : start + _BLOCK]).any(axis=1)
            part[moved] = spherical_coordinates(unit_vectors(part[moved]))
        growth = torch.from_numpy(self._terms.values["growth"][:, 0])
        decays = _grow(torch.from_numpy(begun.decays.copy()), growth).numpy()
        return replace(
            begun,
            base=self._bases.values["base"],
            centers=angles,
            decays=decays,
            intensities=self._terms.values["intensities"],
        )


def _see_by_torch(
    begun: SrbfColors, values: LearnedValues, rows: RowsOfView, means: NDArray[np.float32], eye: NDArray[np.float64]
) -> SeenColors:
    """Evaluate colors of any variant, by torch."""
    leaves = {"base": torch.from_numpy(values["base"][rows.gaussians]).requires_grad_()}
    for name in ("centers", "growth", "intensities"):
        leaves[name] = torch.from_numpy(values[name][rows.terms]).requires_grad_()
    own = SrbfTensors(
        begun.variant,
        base=leaves["base"],
        scales=torch.from_numpy(begun.scales[rows.gaussians]),
        offsets=torch.from_numpy(rows.starts),
        functions=torch.from_numpy(begun.functions[rows.terms].astype(np.int64)),
        centers=leaves["centers"],
        decays=_grow(torch.from_numpy(begun.decays[rows.terms]), leaves["growth"][:, 0]),
        intensities=leaves["intensities"],
    )
    drawn = evaluate_torch(own, torch.from_numpy(means[rows.gaussians]), eye)

    def gradients(by_colors: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Return the gradients."""
        found = torch.autograd.grad(drawn, list(leaves.values()), torch.from_numpy(by_colors))
        return {name: each.numpy() for name, each in zip(leaves, found, strict=True)}

    return SeenColors(rows, drawn.detach().numpy(), gradients)


def _grow(decays: Tensor, growth: Tensor) -> Tensor:
    """Return decays (T,) times the exponential of their growth (T,)."""
    return (decays * growth.exp()).clamp(max=MAX_DECAY)


def learn_sh(
    g: Gaussians, views: PosedImages, config: LearnConfig | None = None, *, progress: Progress = silent
) -> Gaussians:
    """Return the same Gaussians with SH colors that show given images better, the baseline of `learn_colors`.

    Args:
        g: N Gaussians.
        views: Images to show, with their cameras.
        config: Options; None means `LearnConfig()`.
        progress: Called with every step; stage "learn".

    Raises:
        ValueError: If there are no views.
    """
    config = config or LearnConfig()
    if config.steps == 0 or len(g) == 0:
        return g
    start = GaussianTensors.from_gaussians(g)
    sh0 = start.sh0.clone().requires_grad_()
    shN = start.shN.clone().requires_grad_()
    scene = replace(start, sh0=sh0, shN=shN)

    def draw(camera: Cameras) -> Tensor:
        """Return the image of one camera."""
        return rasterize(scene, camera, antialiased=g.facts.antialiased).images[0]

    _descend({sh0: config.base_rate, shN: config.sh_rate}, draw, views, config, progress)
    return Gaussians(g.means, g.quats, g.scales, g.opacities, sh0.detach().numpy(), shN.detach().numpy(), facts=g.facts)


def _loss(image: Tensor, target: Tensor, config: LearnConfig) -> Tensor:
    """Return the loss of a drawn view against an image, both (H, W, 3)."""
    if config.squared:
        return (image - target).square().mean()
    return photometric_loss(image, target, config.ssim_weight)


def _descend(
    rates: dict[Tensor, float],
    draw: Callable[[Cameras], Tensor],
    views: PosedImages,
    config: LearnConfig,
    progress: Progress,
) -> None:
    """Change tensors in place, step by step, until drawn views resemble the images.

    Args:
        rates: Learning rate of each tensor at the first step.
        draw: Function from a camera to its image (H, W, 3).
        views: Images and cameras.
        config: Steps, loss and seed.
        progress: Called with every step; stage "learn".
    """
    if len(views) == 0:
        raise ValueError("views: expected at least one image to learn from, got none")
    adam = torch.optim.Adam([{"params": [each], "lr": rate} for each, rate in rates.items()], eps=1e-15)
    fall = torch.optim.lr_scheduler.ExponentialLR(adam, config.rates_end ** (1.0 / max(config.steps - 1, 1)))
    progress("learn", 0, config.steps)
    for step in range(config.steps):
        index = view_of_step(step, len(views), config.seed)
        image = draw(views.cameras[index])
        target = torch.from_numpy(views.image(index))
        loss = _loss(image, target, config)
        adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
        fall.step()
        progress("learn", step + 1, config.steps)
