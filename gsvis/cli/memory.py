"""What a command needs of memory, from the number of Gaussians alone, and one line before work that would not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from gsvis.cli.source import is_builtin, is_levels
from gsvis.cli.terminal import size_of
from gsvis.io.batches import list_batches, read_batch

__all__ = ["NEEDS", "Need", "check_memory", "count_gaussians", "expected_memory"]

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
    "convert": Need(150 << 20, 200, 12),
    "levels": Need(480 << 20, 1400, 48),
    "color": Need(500 << 20, 1000, 48),
}
"""The need of each command, measured and rounded up (docs/results/world.md)."""


def expected_memory(command: str, gaussians: int, sh_degree: int) -> int:
    """Return the bytes that a command needs at its peak."""
    if command == "clean":
        from gsvis.edit.memory import cleaning_memory

        return cleaning_memory(gaussians, sh_degree)
    need = NEEDS[command]
    return need.base + gaussians * (need.gaussian + need.harmonic * 3 * ((sh_degree + 1) ** 2 - 1))


def check_memory(
    command: str,
    scenes: Sequence[tuple[str, int | None]],
    max_memory: int | None,
    remedy: str = "raise it, or take a coarser level of the scene",
    *,
    together: bool = True,
    more: int = 0,
) -> None:
    """Raise unless a command fits the memory, before it reads a scene.

    Args:
        command: Its name.
        scenes: Path and level of detail of each scene.
        max_memory: Bytes; None sets no limit.
        remedy: What else to do.
        together: Whether all scenes are in memory at once.
        more: Bytes beside the scenes, such as images.

    Raises:
        ValueError: If it does not fit.
    """
    if max_memory is None:
        return
    sizes = [count_gaussians(scene, lod) for scene, lod in scenes]
    if together and sizes:
        sizes = [(sum(count for count, _ in sizes), max(degree for _, degree in sizes))]
    for count, degree in sizes:
        need = expected_memory(command, count, degree) + more
        if need > max_memory:
            raise ValueError(
                f"--max-memory: expected at least {size_of(need)} for {count:,} Gaussians of SH degree {degree}, got"
                f" {size_of(max_memory)}; {remedy}"
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
