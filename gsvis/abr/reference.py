"""The order of records, written simply: one Gaussian or term after the other, sorted by the key of the policy.

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
from gsvis.abr.outside import near_cells, widened_weights
from gsvis.abr.policies import AHEAD, UtilityConfig, edge_offset, first_offset, least_keys, lowest_last, offsets
from gsvis.abr.rings import RINGS
from gsvis.abr.words import strengths
from gsvis.pvs.codec import ids_of

__all__ = ["View", "is_dropped", "is_left", "order_records"]

F32 = NDArray[np.float32]


Unit = tuple[tuple[int, int, int, int, int], list[int]]
"""(ring, word, weight class, first level, last level), and the ids of the members."""


Entry = tuple[int, int, int, list[int], float]
"""Sort key, place among equal keys, kind of records, ids of the Gaussians, and the logarithm of their weight."""


@dataclass(frozen=True, eq=False)
class View:
    """The arguments of `Planner.aim`, under the same names; see there."""

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
    units = _group_units(shared, view)
    strength = strengths(index.importance, index.gaussian_bytes, index.areas, shared.tables.numbers.pixel_area)
    in_view = _in_view(index, view.planes)
    in_middle = in_view if view.middle is None else _in_view(index, view.middle)
    weights = widened_weights(index.class_weights, view.step) if view.step else index.class_weights
    config = config or AbrConfig()
    picture = index.highest_within(config.picture)
    table = offsets(policy, view.regime, index.num_levels, utility, picture)
    top = max(lowest_last(view.regime, index.num_levels), picture + 1)
    active = set(range(index.num_terms)) if index.cones is not None else _active_terms(index, _view_cells(shared, view))
    ahead = set[int]()
    if view.cell_ahead is not None and view.cell_ahead != view.cell:
        ahead = set(index.sets.classes(view.cell_ahead)[0].tolist())
        active |= _active_terms(index, [view.cell_ahead])
    strong = config.strong if index.cones is not None and policy == "utility" else ()
    entries: list[list[Entry]] = [[], [], []]  # first pass over the view, second pass, terms out of view
    for number, ((ring, word, kind, enters, ends), members) in enumerate(units):
        is_picture = ring == 0 and ends < top and enters <= picture
        if ends < top and not is_picture:
            continue
        weight = np.float32(np.mean(index.class_weights)) if ring else weights[kind]
        counted = _with_levels(index, word, enters, ends) if ring else members
        gain = _mean_gain(shared, word, [strength[g] for g in counted], view.eye, weight)
        bucket = int(kernels.bucket_of(gain))
        log = float(np.log(weight))
        near = [g for g in members if (in_view[g] if ring == 0 else g in ahead)]
        core = [g for g in near if ring or in_middle[g]]
        parts = core, [g for g in members if g not in near], [g for g in near if g not in core]
        first, edge = (first_offset(policy, utility), 0) if is_picture else (0, edge_offset(policy, utility))
        keys = _Keys(table, least_keys(strong, utility), first, edge, is_picture)
        place = 3 * (2 + len(strong)) * number
        for passes, entry in _unit_entries(keys, place, ring, enters, bucket, log, parts):
            for k in passes:
                entries[k].append(entry)
    candidates = {g for _, members in units for g in members}
    shares = np.full(index.num_levels, config.replaced)
    shares[: picture + 1] = config.covered
    sender = _Sender(shared, holdings, view, shares)
    sender.send(entries[0], active, candidates, (config.first_epsilon, *strong))
    sender.send(entries[1], active, candidates, (config.epsilon,))
    if fill:
        sender.send(entries[2], active, candidates, (config.epsilon,))
        last = offsets(policy, "high", index.num_levels, utility)
        for some, every_term, visible in _shell_entries(shared, view, strength, last):
            if sender.is_left(some, every_term):
                candidates = candidates | visible
                sender.send(some, every_term, candidates)
    return sender.out


def is_left(wanted: set[int], held: set[int], gone: set[int], owed: set[int]) -> bool:
    """Return whether a wanted Gaussian that is not gone is not held, or is in `owed`: held without all its terms."""
    return any(g not in held or g in owed for g in wanted - gone)


def is_dropped(x: int, index: SceneIndex, candidates: set[int], arrived: set[int], share: float) -> bool:
    """Return whether a Gaussian is dropped: enough of the area of its replacements has arrived.

    Args:
        x: The Gaussian.
        index: The scene.
        candidates: The Gaussians that can be seen; other replacements do not count.
        arrived: The Gaussians that are held or were replaced.
        share: Share of the area that has to arrive, in (0, 1].
    """
    low, high = index.replacement_offsets[x : x + 2]
    wanted = [h for h in index.replacement_ids[low:high].tolist() if h in candidates]
    areas = {h: max(float(index.areas[h]), 1e-30) for h in wanted}
    return sum(areas[h] for h in wanted if h not in arrived) <= (1.0 - share) * sum(areas.values())


@dataclass(frozen=True, eq=False)
class _Keys:
    """The parts of a sort key.

    Attributes:
        table: See `offsets`.
        least_keys: See `least_keys`, one for each kind of strong terms.
        first: Extra offset of a first picture.
        edge: Extra offset at the edge of the view.
        is_picture: Whether the unit belongs to the first picture alone.
    """

    table: NDArray[np.int64]
    least_keys: list[int]
    first: int
    edge: int
    is_picture: bool


def _unit_entries(
    keys: _Keys, place: int, ring: int, enters: int, bucket: int, log: float, parts: tuple[list[int], ...]
) -> Iterator[tuple[tuple[int, ...], Entry]]:
    """Yield the entries of a unit, each with the passes that it belongs to.

    Args:
        keys: Parts of the sort key.
        place: Number of the unit's first entry among all entries.
        ring: Ring of the unit.
        enters: First level of its Gaussians.
        bucket: Bucket of their gain.
        log: Logarithm of their weight.
        parts: Its Gaussians in the middle of the view, out of view, and at the edge of the view.
    """
    table = keys.table
    kinds = 2 + len(keys.least_keys)
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
            least = keys.least_keys[kind - 2] + later - bucket + ahead
            yield (0,), (max(geometry, least), place + 3 * kind + part, kind, members, log)


def _shell_entries(
    shared: CandidateIndex, view: View, strength: F32, table: NDArray[np.int64]
) -> Iterator[tuple[list[Entry], set[int], set[int]]]:
    """Yield the entries of each shell that fills an idle link, the ids of all terms, and the ids that it sees."""
    index = shared.index
    weight = np.float32(np.mean(shared.index.class_weights))
    terms = set(range(index.num_terms)) if index.cones is not None or index.active is not None else set()
    shells = shared.shells.count(view.cell)
    for shell in range(shared.count_shells(view.cell)):
        cells = shared.shells.cells(view.cell, shell) if shell < shells else []
        visible = {g for cell in cells for g in index.sets.classes(cell)[0].tolist()}
        if shell >= shells or (shell == 0 and view.step):  # the last shell; shell 0 of an eye outside
            visible = set(range(len(index)))
        found: dict[tuple[int, int, int], list[int]] = {}
        for g in sorted(visible):
            if index.last[g] == index.num_levels - 1:
                found.setdefault((g >> 6, int(index.first[g]), int(index.last[g])), []).append(g)
        entries = []
        for number, key in enumerate(_in_order_of_scene(index, list(found))):
            word, enters, _ = key
            gain = _mean_gain(shared, word, [strength[g] for g in _with_levels(index, *key)], view.eye, weight)
            for kind in (0, 1):
                place = int(table[-1, enters, kind]) + int(kernels.bucket_of(gain))
                entries.append((place, 2 * number + kind, kind, found[key], 0.0))
        yield entries, terms, visible


def _active_terms(index: SceneIndex, cells: list[int]) -> set[int]:
    """Return the active terms of cells."""
    if index.active is None:
        return set()
    return {t for cell in cells for t in np.asarray(index.active.active_ids(cell)).tolist()}


def _with_levels(index: SceneIndex, word: int, enters: int, ends: int) -> list[int]:
    """Return the Gaussians of a word that have this first and last level. In rings 1 to 3 a gain is the mean of all."""
    some = range(64 * word, min(64 * word + 64, len(index)))
    return [g for g in some if (index.first[g], index.last[g]) == (enters, ends)]


def _in_order_of_scene(index: SceneIndex, keys: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Return keys (word, first level, last level) in the order of the units of the whole scene."""
    return sorted(keys, key=lambda key: (key[0], _with_levels(index, *key)[0]))


def _in_view(index: SceneIndex, planes: F32) -> NDArray[np.bool_]:
    """Return a mask (N,): whether each Gaussian is in one of the frusta (F, 5, 4)."""
    found = np.zeros(len(index), np.bool_)
    kernels.in_view(np.asarray(planes, np.float32), index.means, index.radii, found)
    return found


def _view_cells(shared: CandidateIndex, view: View) -> list[int]:
    """Return the cell of a view; for an eye outside of it, with the cells nearby."""
    return near_cells(shared.index, shared.shells, view.cell, view.step) if view.step else [view.cell]


def _group_units(shared: CandidateIndex, view: View) -> list[Unit]:
    """Return the units of a view in the order of their numbers; members share ring, word, weight class and levels."""
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
            near = {g for other in _view_cells(shared, view) for g in index.sets.classes(other)[0].tolist()}
            kinds = len(index.class_weights)
            here = {g: here.get(g, kinds + (g not in near)) for g in range(len(index))}
        placed |= set(here)
        for g in sorted(here):
            last = top if ring == 0 and g in standing else int(index.last[g])
            key = ring, g >> 6, here[g], int(index.first[g]), last
            found.setdefault(key, []).append(g)

    def place(item: Unit) -> tuple[int, int, int, int]:
        """Return the sort key of a unit."""
        (ring, word, kind, enters, ends), members = item
        return ring, word, kind, members[0] if ring == 0 else _with_levels(index, word, enters, ends)[0]

    return sorted(found.items(), key=place)


def _mean_gain(
    shared: CandidateIndex, word: int, strength: list[F32], eye: F32, weight: np.float32
) -> NDArray[np.float32]:
    """Return the mean weighted solid angle per byte of Gaussians of a word; `strength` has a pair for each."""
    x, y, z = shared.tables.spheres[word, :3] - eye
    square = x * x + y * y + z * z + shared.tables.spreads[word] + np.float32(1e-12)
    area, pixel = (np.float32(float(weight) * sum(float(pair[k]) for pair in strength) / len(strength)) for k in (0, 1))
    return np.asarray(area / square + pixel, np.float32)


class _Sender:
    """Sends records one by one, and lists them in `out`."""

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
        """Send entries in the order of their keys.

        Args:
            entries: The entries.
            active: Ids of the terms that may be sent.
            candidates: The Gaussians that can be seen.
            epsilons: For each kind of terms, the least change of the image, of the package's epsilon, with which a term
                is sent. Empty sends every term.
        """
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
        """Send the terms of a Gaussian that change the image enough for one of the eyes; all if `gain` is None."""
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
        """Drop the Gaussians that `g` replaces if enough has arrived, and then what those were to replace."""
        index = self._index
        starts, ids = index.replaced
        queue = [g]
        while queue:
            y = queue.pop(0)
            for x in ids[starts[y] : starts[y + 1]].tolist():
                share = float(self._shares[index.last[x]])
                if x not in self._gone and is_dropped(x, index, candidates, self._held | self._gone, share):
                    self._gone.add(x)
                    queue.append(x)
                    self.out += [("drop", x)] if x in self._held else []
