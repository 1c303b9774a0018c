"""What a preparation holds in memory beside what finding visible sets needs: libraries, levels, colors."""

from __future__ import annotations

from dataclasses import replace

from gsvis.jobs.cost import COARSER, memory_error
from gsvis.jobs.workers import Workers
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.learned_colors import steps_of_learning
from gsvis.prepare.rounded_colors import LESSON, STEPS
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.memory import expected_memory
from gsvis.scene.levels import Levels
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.level_views import views_to_train

__all__ = ["kept_memory", "left_for_sets", "lesson_memory", "level_images"]

# Measured on flowers LOD 2, nika LOD 1, showroom LOD 3 and biker and rounded up (docs/design/070).
_BASE = 256 << 20
_GAUSSIAN = 200
_HARMONIC = 14
_TORCH = 250 << 20  # bytes of torch with what it has compiled
_LEARNED = 300  # bytes of a Gaussian while colors are learned, beside those of the fit
_PIXEL = 12  # bytes of a pixel of an image to train on


def kept_memory(gaussians: int, sh_degree: int) -> int:
    """Return the bytes of a process that prepares a package beside those that its visible sets need.

    Args:
        gaussians: Gaussians of all levels together.
        sh_degree: Of the scene.
    """
    return _BASE + gaussians * (_GAUSSIAN + _HARMONIC * 3 * ((sh_degree + 1) ** 2 - 1))


def level_images(config: PrepareConfig) -> int:
    """Return the bytes of the renders that levels are trained and measured on, if there are no photos."""
    held_out = replace(config.level_views, count=config.level_held_out)
    return _image_bytes(views_to_train(config.level_views)) + _image_bytes(held_out)


def lesson_memory(config: PrepareConfig, gaussians: int, sh_degree: int, images: int) -> int:
    """Return the bytes that learning colors needs beside what their fit needs; 0 if none are learned.

    Args:
        config: The options.
        gaussians: Gaussians of all levels together.
        sh_degree: Of the scene.
        images: Bytes of photos to learn from; 0 if there are none.
    """
    steps = steps_of_learning(config.color_steps, photos=images > 0, renders=sh_degree > 0)
    kept = images if steps else 0
    if config.colors.record_psnr is not None and config.color_steps != 0:
        steps += STEPS
        kept = max(kept, _image_bytes(LESSON))
    return _TORCH + _LEARNED * gaussians + kept if steps else 0


def _image_bytes(sampling: ViewSampling) -> int:
    """Return the bytes of the images of views."""
    return _PIXEL * sampling.count * sampling.width * sampling.height


def left_for_sets(workers: Workers | None, levels: Levels, gaussians: int, config: PvsConfig) -> Workers | None:
    """Return workers whose limit leaves room for what a preparation holds while they find visible sets.

    Args:
        workers: The workers; None means this process.
        levels: What they look at.
        gaussians: Gaussians of all levels of the scene together.
        config: How sets are found.

    Raises:
        ArgumentError: If one process does not fit the limit.
    """
    if workers is None or workers.max_memory is None:
        return workers
    kept = kept_memory(gaussians, levels.union.sh_degree)
    need = kept + (0 if workers.executor is not None else expected_memory(levels, config, 1))
    if workers.max_memory < need:
        raise memory_error(need, workers.max_memory, f"{gaussians:,} Gaussians", COARSER)
    return replace(workers, max_memory=max(1, workers.max_memory - kept))
