"""The order of records, written simply: one Gaussian and one term after the other, sorted by the key of the policy.

The slow twin of `candidates.py` and `planner.py`. Tests check that both give the same records in the same order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels import units as kernels
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.abr.index import SceneIndex
from gsvis.abr.outside import near_cells, weights_of
from gsvis.abr.policies import AHEAD, UtilityConfig, bounds, edge_offset, first_offset, lowest_last, offsets
from gsvis.abr.rings import RINGS
from gsvis.abr.words import strengths
from gsvis.pvs.codec import ids_of

__all__ = ["View", "is_dropped", "is_left", "order_records"]

F32 = NDArray[np.float32]


Unit = tuple[tuple[int, int, int, int, int], list[int]]
"""Ring, word, weight class, first and last level, and the members."""


Entry = tuple[int, int, int, list[int], float]
"""Key, place among equal keys, kind of records, the Gaussians, and the logarithm of their weight."""


@dataclass(frozen=True, eq=False)
class View:
    """Arguments of `Planner.aim`: cell, eye (3,), frusta (F, 5, 4), regime, eyes, cell ahead, middle, step outside."""

    cell: int
    eye: F32
    planes: F32
    regime: str = "high"
    eyes: F32 | None = None
    cell_ahead: int | None = None
    middle: F32 | None = None
    step: int = 0


def order_records(
    shared: CandidateIndex,
    view: View,
    policy: str,
    holdings: Holdings,
    *,
    utility: UtilityConfig | None = None,
    config: AbrConfig | None = None,
    fill: bool = False,
) -> list[tuple[str, int]]:
    """Return all records that a view needs, first to last.

    Args:
        shared: Candidates of the scene, of which only the index and the spheres of words are used.
        view: What the client looks at.
        policy: One of `POLICIES`.
        holdings: What the client holds; not changed.
        utility: Factors of the policy "utility".
        config: Thresholds on terms; None means `AbrConfig()`.
        fill: Whether the rest of the scene follows, for an idle link.

    Returns:
        ("gaussian", id), ("term", id), and ("drop", id) right after the Gaussian that completes its replacement.
    """
    index = shared.index
    units = _units(shared, view)
    strength = strengths(index.importance, index.gaussian_bytes, index.areas, shared.tables.numbers.pixel_area)
    in_view = _in_view(index, view.planes)
    in_middle = in_view if view.middle is None else _in_view(index, view.middle)
    weights = weights_of(index.class_weights, view.step) if view.step else index.class_weights
    config = config or AbrConfig()
    picture = index.highest_within(config.picture)
    table = offsets(policy, view.regime, index.num_levels, utility, picture)
    top = max(lowest_last(view.regime, index.num_levels), picture + 1)
    active = set(range(index.num_terms)) if index.cones is not None else _active(index, _cells(shared, view))
    ahead = set[int]()
    if view.cell_ahead is not None and view.cell_ahead != view.cell:
        ahead = set(index.sets.classes(view.cell_ahead)[0].tolist())
        active |= _active(index, [view.cell_ahead])
    strong = config.strong if index.cones is not None and policy == "utility" else ()
    entries: list[list[Entry]] = [[], [], []]  # of the first pass, of the second, of what is around
    for number, ((ring, word, kind, enters, ends), members) in enumerate(units):
        is_picture = ring == 0 and ends < top and enters <= picture
        if ends < top and not is_picture:
            continue
        weight = np.float32(np.mean(index.class_weights)) if ring else weights[kind]
        alike = _alike(index, word, enters, ends) if ring else members
        gain = _gain(shared, word, [strength[g] for g in alike], view.eye, weight)
        bucket = int(kernels.bucket_of(gain))
        log = float(np.log(weight))
        near = [g for g in members if (in_view[g] if ring == 0 else g in ahead)]
        core = [g for g in near if ring or in_middle[g]]
        parts = core, [g for g in members if g not in near], [g for g in near if g not in core]
        first, edge = (first_offset(policy, utility), 0) if is_picture else (0, edge_offset(policy, utility))
        keys = _Keys(table, bounds(strong, utility), first, edge, is_picture)
        place = 3 * (2 + len(strong)) * number
        for passes, entry in _entries_of(keys, place, ring, enters, bucket, log, parts):
            for k in passes:
                entries[k].append(entry)
    candidates = {g for _, members in units for g in members}
    shares = np.full(index.num_levels, config.replaced)
    shares[: picture + 1] = config.covered
    walk = _Walk(shared, holdings, view, shares)
    walk.send(entries[0], active, candidates, (config.first_epsilon, *strong))
    walk.send(entries[1], active, candidates, (config.epsilon,))
    if fill:
        walk.send(entries[2], active, candidates, (config.epsilon,))
        last = offsets(policy, "high", index.num_levels, utility)
        for some, every_term, visible in _shells(shared, view, strength, last):
            if walk.is_left(some, every_term):
                candidates = candidates | visible
                walk.send(some, every_term, candidates)
    return walk.out


def is_left(wanted: set[int], held: set[int], gone: set[int], owed: set[int]) -> bool:
    """Return whether anything of some Gaussians is left to send: one of those, or terms that one owes."""
    return any(g not in held or g in owed for g in wanted - gone)


def is_dropped(x: int, index: SceneIndex, candidates: set[int], arrived: set[int], share: float) -> bool:
    """Return whether enough of what replaces a Gaussian has arrived: a share of the area of the candidates.

    Args:
        x: The Gaussian.
        index: The scene.
        candidates: What can be seen.
        arrived: What is held, or replaced itself.
        share: In (0, 1].
    """
    low, high = index.replacement_offsets[x : x + 2]
    wanted = [h for h in index.replacement_ids[low:high].tolist() if h in candidates]
    areas = {h: max(float(index.areas[h]), 1e-30) for h in wanted}
    return sum(areas[h] for h in wanted if h not in arrived) <= (1.0 - share) * sum(areas.values())


@dataclass(frozen=True, eq=False)
class _Keys:
    """What keys are made of: offsets, bounds, what is added for a first picture and at the edge; if it is a picture."""

    table: NDArray[np.int64]
    bounds: list[int]
    first: int
    edge: int
    is_picture: bool


def _entries_of(
    keys: _Keys, place: int, ring: int, enters: int, bucket: int, log: float, parts: tuple[list[int], ...]
) -> Iterator[tuple[tuple[int, ...], Entry]]:
    """Yield the entries of a unit, each with the passes that it belongs to."""
    table = keys.table
    kinds = 2 + len(keys.bounds)
    for part, members in enumerate(parts):
        if part == (kernels.EDGE if ring else kernels.OUTSIDE if keys.is_picture else -1):
            continue
        in_view = part != kernels.OUTSIDE
        group = (0 if in_view else 1) if ring == 0 else AHEAD + part * ring
        later = keys.first + (keys.edge if part == kernels.EDGE else 0) + bucket
        geometry = int(table[group, enters, 0]) + later
        yield (0,), (geometry, place + part, 0, members, log)
        if keys.is_picture or (ring and not in_view):
            continue
        yield ((0, 1), (2,), (0, 2))[part], (int(table[group, enters, 1]) + later, place + 3 + part, 1, members, log)
        ahead = int(table[AHEAD, 0, 0]) if ring else 0
        for kind in range(2, kinds if in_view else 2):
            least = keys.bounds[kind - 2] + later - bucket + ahead
            yield (0,), (max(geometry, least), place + 3 * kind + part, kind, members, log)


def _shells(
    shared: CandidateIndex, view: View, strength: F32, table: NDArray[np.int64]
) -> Iterator[tuple[list[Entry], set[int], set[int]]]:
    """Yield what fills an idle link: the entries of each shell, all terms, and what it sees."""
    index = shared.index
    weight = np.float32(np.mean(shared.index.class_weights))
    terms = set(range(index.num_terms)) if index.cones is not None or index.active is not None else set()
    shells = shared.shells.count(view.cell)
    for shell in range(shared.count_shells(view.cell)):
        cells = shared.shells.cells(view.cell, shell) if shell < shells else []
        visible = {g for cell in cells for g in index.sets.classes(cell)[0].tolist()}
        if shell >= shells or (shell == 0 and view.step):  # what no cell sees; what the widened cell has
            visible = set(range(len(index)))
        found: dict[tuple[int, int, int], list[int]] = {}
        for g in sorted(visible):
            if index.last[g] == index.num_levels - 1:
                found.setdefault((g >> 6, int(index.first[g]), int(index.last[g])), []).append(g)
        entries = []
        for number, key in enumerate(_in_order_of_scene(index, list(found))):
            word, enters, _ = key
            gain = _gain(shared, word, [strength[g] for g in _alike(index, *key)], view.eye, weight)
            for kind in (0, 1):
                place = int(table[-1, enters, kind]) + int(kernels.bucket_of(gain))
                entries.append((place, 2 * number + kind, kind, found[key], 0.0))
        yield entries, terms, visible


def _active(index: SceneIndex, cells: list[int]) -> set[int]:
    """Return the active terms of cells."""
    if index.active is None:
        return set()
    return {t for cell in cells for t in np.asarray(index.active.active_ids(cell)).tolist()}


def _alike(index: SceneIndex, word: int, enters: int, ends: int) -> list[int]:
    """Return the Gaussians of a word with a pair of levels: the gain of neighbors is the mean of them all."""
    some = range(64 * word, min(64 * word + 64, len(index)))
    return [g for g in some if (index.first[g], index.last[g]) == (enters, ends)]


def _in_order_of_scene(index: SceneIndex, keys: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Return words with pairs of levels in the order of the units of the whole scene."""
    return sorted(keys, key=lambda key: (key[0], _alike(index, *key)[0]))


def _in_view(index: SceneIndex, planes: F32) -> NDArray[np.bool_]:
    """Return (N,) whether each Gaussian is in one of the frusta (F, 5, 4)."""
    found = np.zeros(len(index), np.bool_)
    kernels.in_view(np.asarray(planes, np.float32), index.means, index.radii, found)
    return found


def _cells(shared: CandidateIndex, view: View) -> list[int]:
    """Return the cell of a view, and outside of it those that are about as near."""
    return near_cells(shared.index, shared.shells, view.cell, view.step) if view.step else [view.cell]


def _units(shared: CandidateIndex, view: View) -> list[Unit]:
    """Return the members of one word, ring, weight class and pair of levels, in the order of unit numbers."""
    index = shared.index
    cell = view.cell
    found: dict[tuple[int, int, int, int, int], list[int]] = {}
    placed: set[int] = set()
    standing = set(index.sets.standing(cell).tolist())
    top = index.num_levels - 1
    for ring, cells in zip(range(RINGS), index.grid.rings(cell), strict=True):
        here: dict[int, int] = {}
        for other in cells:
            ids, classes = index.sets.classes(other)
            for g, kind in zip(ids.tolist(), classes.tolist(), strict=True):
                if g not in placed:
                    here[g] = kind if ring == 0 else 0
        if ring == 0 and view.step:
            near = {g for other in _cells(shared, view) for g in index.sets.classes(other)[0].tolist()}
            kinds = len(index.class_weights)
            here = {g: here.get(g, kinds + (g not in near)) for g in range(len(index))}
        placed |= set(here)
        for g in sorted(here):
            last = top if ring == 0 and g in standing else int(index.last[g])
            key = ring, g >> 6, here[g], int(index.first[g]), last
            found.setdefault(key, []).append(g)

    def place(item: Unit) -> tuple[int, int, int, int]:
        (ring, word, kind, enters, ends), members = item
        return ring, word, kind, members[0] if ring == 0 else _alike(index, word, enters, ends)[0]

    return sorted(found.items(), key=place)


def _gain(shared: CandidateIndex, word: int, strength: list[F32], eye: F32, weight: np.float32) -> NDArray[np.float32]:
    """Return the mean weighted solid angle per byte of Gaussians of a word with given strengths."""
    x, y, z = shared.tables.spheres[word, :3] - eye
    square = x * x + y * y + z * z + shared.tables.spreads[word] + np.float32(1e-12)
    area, pixel = (np.float32(float(weight) * sum(float(pair[k]) for pair in strength) / len(strength)) for k in (0, 1))
    return np.asarray(area / square + pixel, np.float32)


class _Walk:
    """Records in the order in which they are sent one by one."""

    def __init__(self, shared: CandidateIndex, holdings: Holdings, view: View, shares: NDArray[np.float64]) -> None:
        self.out: list[tuple[str, int]] = []
        self._shares = shares
        self._index = shared.index
        self._pixel = shared.tables.numbers.pixel_area
        self._held = set(holdings.received.tolist())
        self._held_terms = set(holdings.received_terms.tolist())
        self._gone = set(ids_of(holdings.gone).tolist())
        others = np.zeros((0, 3), np.float32) if view.eyes is None else view.eyes
        self._eyes = np.concatenate([np.asarray(view.eye)[None], others]).astype(np.float32)

    def send(
        self,
        entries: list[Entry],
        active: set[int],
        candidates: set[int],
        epsilons: tuple[float, ...] = (),
    ) -> None:
        """Send entries by their keys, and terms that change the image enough for one of the eyes, or every term."""
        for _, _, kind, members, log in sorted(entries, key=lambda entry: entry[:2]):
            gain = log - np.log(epsilons[kind - 1]) - 0.5 * np.log(3.6e-5) if kind and epsilons else None
            for g in members:
                if g in self._gone:
                    continue
                if kind and g in self._held:
                    self._send_terms(g, active, gain)
                elif not kind and g not in self._held:
                    self._held.add(g)
                    self.out.append(("gaussian", g))
                    self._drop_replaced(g, candidates)

    def is_left(self, entries: list[Entry], active: set[int]) -> bool:
        """Return whether some of these Gaussians, or one of their active terms, is left to send."""
        members = {g for entry in entries for g in entry[3]} - self._gone
        offsets = self._index.term_offsets
        terms = {t for g in members for t in range(int(offsets[g]), int(offsets[g + 1]))} & active
        return bool(members - self._held or terms - self._held_terms)

    def _send_terms(self, g: int, active: set[int], gain: float | None) -> None:
        index = self._index
        for t in range(int(index.term_offsets[g]), int(index.term_offsets[g + 1])):
            if t not in active or t in self._held_terms:
                continue
            cones = index.cones
            eyes = self._eyes
            apart = np.maximum(((eyes - index.means[g]) ** 2).sum(axis=1), 1e-30)
            sizes = 0.5 * np.log(np.minimum(index.areas[g] / apart + self._pixel, 4.0 * np.pi))
            pairs = zip(eyes, sizes, strict=True)
            if (
                gain is None
                or cones is None
                or any(cones.active([t], index.means[g], [eye], gain + size)[0] for eye, size in pairs)
            ):
                self._held_terms.add(t)
                self.out.append(("term", t))

    def _drop_replaced(self, g: int, candidates: set[int]) -> None:
        index, (starts, ids) = self._index, self._index.replaced
        queue = [g]
        while queue:
            y = queue.pop(0)
            for x in ids[starts[y] : starts[y + 1]].tolist():
                share = float(self._shares[index.last[x]])
                if x not in self._gone and is_dropped(x, index, candidates, self._held | self._gone, share):
                    self._gone.add(x)
                    queue.append(x)
                    self.out += [("drop", x)] if x in self._held else []
