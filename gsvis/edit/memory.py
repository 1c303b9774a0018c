"""How much memory a cleaning needs, from the number of Gaussians alone: of a scene, or of a tile and what is around."""

from __future__ import annotations

__all__ = ["BASE", "cleaning_memory", "most_gaussians"]

BASE = 600 << 20
"""Bytes of a process that cleans, grids and libraries included, whatever the scene."""

# bytes for each, and for each of its SH coefficients above degree 0, rounded up
_GAUSSIAN = 500
_HARMONIC = 12


def cleaning_memory(gaussians: int, sh_degree: int) -> int:
    """Return the bytes that a process needs at its peak to clean so many Gaussians at once."""
    return BASE + gaussians * _bytes_of(sh_degree)


def most_gaussians(memory: int, sh_degree: int) -> int:
    """Return how many Gaussians can be cleaned at once in so many bytes."""
    return max(0, memory - BASE) // _bytes_of(sh_degree)


def _bytes_of(sh_degree: int) -> int:
    return _GAUSSIAN + _HARMONIC * 3 * ((sh_degree + 1) ** 2 - 1)
