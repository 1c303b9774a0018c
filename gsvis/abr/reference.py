"""The order of records, written simply: one Gaussian and one term after the other, sorted by the key of the policy.

The slow twin of `candidates.py` and `planner.py`. Tests check that both give the same records in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels import units as kernels
from gsvis.abr.candidates import RINGS, CandidateIndex, ring_cells, strengths
from gsvis.abr.classes import FOV, classify
from gsvis.abr.holdings import Holdings
from gsvis.abr.index import SceneIndex
from gsvis.abr.policies import UtilityConfig, lowest_last, offsets
from gsvis.pvs.codec import ids_of

__all__ = ["View", "order_records"]

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class View:
    """Arguments of `Planner.aim`: the cell, the eye (3,), frusta (F, 5, 4), the regime."""

    cell: int
    eye: F32
    planes: F32
    regime: str = "high"


def order_records(
    shared: CandidateIndex,
    view: View,
    policy: str,
    holdings: Holdings,
    *,
    pixel: float = 2e-3,
    utility: UtilityConfig | None = None,
) -> list[tuple[str, int]]:
    """Return all records that a view needs, first to last.

    Args:
        shared: Candidates of the scene, of which only the index and the spheres of words are used.
        view: Cell, eye, frusta and regime.
        policy: One of `POLICIES`.
        holdings: What the client holds; not changed.
        pixel: Angle of a pixel of the clients, radians.
        utility: Factors of the policy "utility".

    Returns:
        ("gaussian", id), ("term", id), and ("drop", id) right after the Gaussian that completes its replacement.
    """
    index = shared.index
    units, strength = _units(index, view.cell), strengths(index, pixel)
    classes = classify(index, view.cell, view.planes).classes
    table = offsets(policy, view.regime, index.num_levels, utility)
    top = lowest_last(view.regime, index.num_levels)
    active = set(np.asarray(index.active.active_ids(view.cell)).tolist()) if index.active is not None else set()
    candidates = {g for _, members in units for g in members}
    entries = []
    for number, ((ring, word, kind, enters, ends), members) in enumerate(units):
        if ends < top:
            continue
        alike = range(64 * word, min(64 * word + 64, len(index)))  # for neighbors, all alike in the word count
        alike_too = [g for g in alike if (index.first[g], index.last[g]) == (enters, ends)]
        weight = np.float32(np.mean(index.class_weights)) if ring else index.class_weights[kind]
        gain = _gain(shared, word, [strength[g] for g in (alike_too if ring else members)], view.eye, weight)
        bucket = int(kernels.bucket_of(gain))
        for part in (0, 1):
            group = part if ring == 0 else 1 + ring
            inside = [g for g in members if ring > 0 or (classes[g] == FOV) == (part == 0)]
            if ring > 0 and part == 0:
                continue
            for terms in (0, 1) if ring == 0 else (0,):
                entries.append(
                    (int(table[group, enters, terms]) + bucket, 4 * number + 2 * terms + part, terms, inside)
                )
    return _walk(index, sorted(entries, key=lambda entry: entry[:2]), active, candidates, holdings)


def _units(index: SceneIndex, cell: int) -> list[tuple[tuple[int, int, int, int, int], list[int]]]:
    """Return the members of one word, ring, weight class and pair of levels, in the order of unit numbers."""
    found: dict[tuple[int, int, int, int, int], list[int]] = {}
    placed: set[int] = set()
    for ring, cells in zip(range(RINGS), ring_cells(index.grid, cell), strict=True):
        here: dict[int, int] = {}
        for other in cells:
            ids, classes = index.sets.classes(other)
            for g, kind in zip(ids.tolist(), classes.tolist(), strict=True):
                if g not in placed:
                    here[g] = kind if ring == 0 else 0
        placed |= set(here)
        for g in sorted(here):
            key = ring, g >> 6, here[g], int(index.first[g]), int(index.last[g])
            found.setdefault(key, []).append(g)
    whole: dict[tuple[int, int, int], int] = {}  # units of neighbors are in the order of the whole scene
    for g in range(len(index)):
        whole.setdefault((g >> 6, int(index.first[g]), int(index.last[g])), g)

    def place(item: tuple[tuple[int, int, int, int, int], list[int]]) -> tuple[int, int, int, int]:
        (ring, word, kind, enters, ends), members = item
        return ring, word, kind, members[0] if ring == 0 else whole[word, enters, ends]

    return sorted(found.items(), key=place)


def _gain(shared: CandidateIndex, word: int, strength: list[F32], eye: F32, weight: np.float32) -> NDArray[np.float32]:
    """Return the mean weighted solid angle per byte of Gaussians of a word with given strengths."""
    x, y, z = shared.spheres[word, :3] - eye
    square = x * x + y * y + z * z + shared.spreads[word] + np.float32(1e-12)
    area, pixel = (np.float32(float(weight) * sum(float(pair[k]) for pair in strength) / len(strength)) for k in (0, 1))
    return np.asarray(area / square + pixel, np.float32)


def _walk(
    index: SceneIndex,
    entries: list[tuple[int, int, int, list[int]]],
    active: set[int],
    candidates: set[int],
    holdings: Holdings,
) -> list[tuple[str, int]]:
    """Return the records of sorted entries, as they are sent one by one."""
    held, held_terms = set(holdings.received.tolist()), set(holdings.received_terms.tolist())
    gone = set(ids_of(holdings.gone).tolist())
    starts, ids = index.replaced
    out: list[tuple[str, int]] = []
    for _, _, terms, members in entries:
        for g in members:
            if g in gone:
                continue
            if terms and g in held:
                for t in range(int(index.term_offsets[g]), int(index.term_offsets[g + 1])):
                    if t in active and t not in held_terms:
                        held_terms.add(t)
                        out.append(("term", t))
            elif not terms and g not in held:
                held.add(g)
                out.append(("gaussian", g))
                queue = [g]
                while queue:
                    y = queue.pop(0)
                    for x in ids[starts[y] : starts[y + 1]].tolist():
                        low, high = index.replacement_offsets[x : x + 2]
                        wanted = [h for h in index.replacement_ids[low:high].tolist() if h in candidates]
                        if x not in gone and all(h in held or h in gone for h in wanted):
                            gone.add(x)
                            queue.append(x)
                            out += [("drop", x)] if x in held else []
    return out
