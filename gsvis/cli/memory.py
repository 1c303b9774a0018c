"""What a command needs of memory, from the number of Gaussians alone, and one line before work that would not fit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from gsvis.cli.terminal import least_size_of, size_of
from gsvis.io.batches import list_batches, read_batch
from gsvis.io.sources import is_builtin, is_levels

if TYPE_CHECKING:
    from gsvis.prepare import PrepareConfig
    from gsvis.pvs.config import PvsConfig

__all__ = [
    "IN_TILES",
    "NEEDS",
    "Need",
    "check_memory",
    "check_preparation",
    "check_sets",
    "check_simulation",
    "count_gaussians",
    "expected_memory",
    "machine_memory",
    "training_grows",
]

IN_TILES = "raise it, take a coarser --lod, or use gsvis world, which works in tiles"
"""What to do about a scene that does not fit."""

_PACKED = 16  # bytes of a Gaussian in a file that only reading counts: few formats have less


class Need(NamedTuple):
    """Bytes of a command at its peak.

    Attributes:
        base: Whatever the scene.
        gaussian: For each Gaussian.
        harmonic: For each Gaussian and each of its SH coefficients above degree 0.
    """

    base: int
    gaussian: int
    harmonic: int


NEEDS = {
    "convert": Need(184 << 20, 320, 24),
    "page": Need(256 << 20, 900, 12),  # convert to .html
    "levels": Need(440 << 20, 700, 30),
    "color": Need(300 << 20, 600, 32),
    "simulate": Need(400 << 20, 700, 12),
}
"""The need of each command, measured and rounded up (docs/results/world.md)."""


def expected_memory(command: str, gaussians: int, sh_degree: int, grows: float = 1.0) -> int:
    """Return the bytes that a command needs at its peak.

    Args:
        command: Its name.
        gaussians: Gaussians of the scene.
        sh_degree: Of the scene.
        grows: Times as many bytes for each Gaussian as with default options.
    """
    if command == "clean":
        from gsvis.edit.memory import cleaning_memory

        return cleaning_memory(gaussians, sh_degree)
    need = NEEDS[command]
    each = need.gaussian + need.harmonic * 3 * ((sh_degree + 1) ** 2 - 1)
    return need.base + int(grows * gaussians * each)


def check_memory(
    command: str,
    scenes: Sequence[tuple[str, int | None]],
    max_memory: int | None,
    remedy: str = "raise it, or take a coarser level of the scene",
    *,
    together: bool = True,
    more: int = 0,
    grows: float = 1.0,
) -> None:
    """Raise unless a command fits the memory, before it reads a scene.

    Args:
        command: Its name.
        scenes: Path and level of detail of each scene.
        max_memory: Bytes; None sets no limit.
        remedy: What else to do.
        together: Whether all scenes are in memory at once.
        more: Bytes beside the scenes, such as images.
        grows: Times as many bytes for each Gaussian as with default options.

    Raises:
        ValueError: If it does not fit.
    """
    if max_memory is None:
        return
    sizes = [count_gaussians(scene, lod) for scene, lod in scenes]
    if together and sizes:
        sizes = [(sum(count for count, _ in sizes), max(degree for _, degree in sizes))]
    for count, degree in sizes:
        _check_fits(expected_memory(command, count, degree, grows) + more, max_memory, (count, degree), remedy)


def check_sets(scene: str, lod: int | None, config: PvsConfig, max_memory: int | None) -> None:
    """Raise unless visible sets of a scene can be found in the memory, before it is read.

    A folder of levels is not checked: its levels are known when it was read.

    Raises:
        ValueError: If it does not fit.
    """
    from gsvis.pvs.memory import sets_memory

    if max_memory is not None and not is_levels(scene):
        count, degree = count_gaussians(scene, lod)
        if count:
            _check_fits(sets_memory((count,), count, degree, config), max_memory, (count, degree), IN_TILES)


def check_preparation(
    scene: str, lod: int | None, config: PrepareConfig, max_memory: int | None, images: int = 0
) -> None:
    """Raise unless every stage of a preparation fits the memory, before a scene is read; a folder is not checked.

    Args:
        scene: Path of the scene.
        lod: Its level of detail.
        config: The settings.
        max_memory: Bytes; None sets no limit.
        images: Bytes of all images to train on.

    Raises:
        ValueError: If a stage does not fit.
    """
    from gsvis.prepare.memory import kept_memory, lesson_memory, level_images
    from gsvis.pvs.memory import sets_memory

    if max_memory is None or is_levels(scene):
        return
    count, degree = count_gaussians(scene, lod)
    if not count:
        return
    lower = [] if config.levels is None else config.levels.sizes(count)
    counts = (*(total for total, *_ in lower), count)
    union = count + sum(total - own for total, own, _ in lower)
    need = sets_memory(counts, union, degree, config.sets) + kept_memory(union, degree)
    if config.levels is not None:
        training = expected_memory("levels", count, degree, training_grows(config.levels.shares))
        need = max(need, training + (images or level_images(config)))
    colors = expected_memory("color", union, degree) + lesson_memory(config, union, degree, images)
    _check_fits(max(need, colors), max_memory, (count, degree), IN_TILES)


def check_simulation(
    sizes: Sequence[int], scenes: Sequence[tuple[str, int | None]], max_memory: int | None, any_world: bool
) -> None:
    """Raise unless packages and worlds fit the memory with the scenes that they are compared with, before all are read.

    Args:
        sizes: Gaussians of each package or world, all levels together.
        scenes: Path and level of detail of each scene.
        max_memory: Bytes; None sets no limit for packages, and that of the machine for worlds.
        any_world: Whether one of them is a world.

    Raises:
        ValueError: If they do not fit.
    """
    limit = machine_memory() if max_memory is None and any_world else max_memory
    if limit is None:
        return
    need = expected_memory("simulate", sum(sizes), 0)
    for scene, lod in scenes:
        need += expected_memory("simulate", *count_gaussians(scene, lod)) - NEEDS["simulate"].base
    if need > limit:
        what = "--max-memory: expected" if max_memory is not None else "PACKAGE: expected a machine with"
        raise ValueError(
            f"{what} at least {least_size_of(need)} to draw {sum(sizes):,} Gaussians, got {size_of(limit)};"
            " simulate one of the tiles, which are in packages" + ("" if max_memory is None else ", or raise it")
        )


def machine_memory() -> int | None:
    """Return the bytes of memory of this machine; None if they are not known."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not on this system
        return None


def training_grows(shares: Sequence[float]) -> float:
    """Return how much more memory training needs than with the default shares, of which the largest is a half."""
    return max(1.0, 0.5 + max(shares))


def _check_fits(need: int, max_memory: int, scene: tuple[int, int], remedy: str) -> None:
    """Raise if a command needs more bytes than `--max-memory` allows."""
    if need > max_memory:
        raise ValueError(
            f"--max-memory: expected at least {least_size_of(need)} for {scene[0]:,} Gaussians of SH degree {scene[1]},"
            f" got {size_of(max_memory)}; {remedy}"
        )


def count_gaussians(scene: str, lod: int | None) -> tuple[int, int]:
    """Return the Gaussians and the SH degree of a scene, by headers and first rows; a guess for packed formats."""
    if is_builtin(scene):
        return 0, 0
    if is_levels(scene):
        from gsvis.io.levels import levels_info

        info = levels_info(scene)
        return info.gaussians, count_gaussians(str(Path(scene, info.files[0])), None)[1]
    batches = list_batches(scene, lod)
    if batches[0].kind == "whole":
        return batches[0].nbytes // _PACKED, 0
    first = replace(batches[0], count=1) if batches[0].kind == "rows" else batches[0]
    return sum(batch.count for batch in batches), read_batch(first).sh_degree
