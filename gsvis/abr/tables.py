"""The tables of a scene from which candidates of all cells are made: computed once, in memory or in a mapped file.

`gsvis.abr.piecewise` computes them. Scene frame and units; bytes as sent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr._kernels import plan
from gsvis.abr._kernels.units import Runs, Traits, Units
from gsvis.abr.candidate_sets import Candidates

__all__ = ["CandidateTables", "TableNumbers"]

F32 = NDArray[np.float32]
Words = NDArray[np.uint64]

_WHOLE = ("words", "places", "owing", "union", "active", "level_bytes")  # arrays of `CandidateTables.everything`
_Tuple = TypeVar("_Tuple")


@dataclass(frozen=True)
class TableNumbers:
    """Numbers of a scene.

    Attributes:
        pixel_area: Steradians that the rasterizer adds to the solid angle of each Gaussian.
        term_size: Mean bytes of a term; 0 without terms.
        term_bytes: Mean bytes of the terms of a Gaussian that has any.
        least_sizes: Bytes of the smallest record of a Gaussian, and of a term.
        stored: Bytes that a Gaussian and a term take in the memory of a client.
        sent_per_stored: Least bytes of a record for each byte that it takes in the memory of a client.
    """

    pixel_area: float
    term_size: float
    term_bytes: float
    least_sizes: tuple[float, float]
    stored: tuple[float, float]
    sent_per_stored: float

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> TableNumbers:
        """Return the numbers whose `dataclasses.asdict` went through JSON."""
        found: dict[str, Any] = dict(numbers)
        pairs = {name: tuple(found[name]) for name in ("least_sizes", "stored")}
        return cls(**found | pairs)


@dataclass(frozen=True, eq=False)
class CandidateTables:
    """Tables of N Gaussians in W words of 64, and of T terms.

    Attributes:
        numbers: Numbers of the scene.
        spheres: (W, 4) float32 center and radius of a sphere around the Gaussians of each word.
        spreads: (W,) float32 mean square of the distance of these Gaussians from the center.
        bodies: (4, 64 W) float32 center and radius of each Gaussian, coordinate by coordinate; the radius is -inf if
            there is no such Gaussian.
        highest: (W,) uint64, the Gaussians of the highest level.
        word_bytes: (W,) float32 mean bytes of the records of the Gaussians of each word.
        word_terms: (W,) float32 mean number of their terms.
        owners: (T,) int32, the Gaussian of each term.
        traits: Strengths and levels of all Gaussians.
        records: Bytes of all records.
        links: Which Gaussians replace which.
        every: The units of all Gaussians, in ring 0.
        active: All terms that may be sent, as a packed set.
        owing: (W,) uint64, the Gaussians that own some of them.
        everything: All Gaussians and terms as candidates without a cell, in ring 1; in a small scene, those of a shell.
    """

    numbers: TableNumbers
    spheres: F32
    spreads: F32
    bodies: F32
    highest: Words
    word_bytes: F32
    word_terms: F32
    owners: NDArray[np.int32]
    traits: Traits
    records: plan.Records
    links: plan.Links
    every: Units
    active: Words
    owing: Words
    everything: Candidates

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], numbers: TableNumbers) -> CandidateTables:
        """Return the tables from arrays by name, such as views of a mapped file, which are not read."""
        names = ("spheres", "spreads", "bodies", "highest", "word_bytes", "word_terms", "owners", "active", "owing")
        everything = Candidates(
            cell=-1,
            step=0,
            units=_typed("unit_", Units, arrays),
            runs=_typed("run_", Runs, arrays),
            term_bytes=numbers.term_bytes,
            **{name: arrays[f"all_{name}"] for name in _WHOLE},
        )
        return cls(
            numbers=numbers,
            **{name: arrays[name] for name in names},
            traits=Traits(*_check.read_only(*_typed("", Traits, arrays))),
            records=_typed("record_", plan.Records, arrays),
            links=_typed("link_", plan.Links, arrays),
            every=_typed("every_", Units, arrays),
            everything=everything,
        )


def _typed(prefix: str, kind: Callable[..., _Tuple], arrays: Mapping[str, NDArray[Any]]) -> _Tuple:
    """Return the named tuple `kind`, each field from the array with the name prefix + field."""
    return kind(**{name: arrays[f"{prefix}{name}"] for name in kind._fields})  # type: ignore[attr-defined]
