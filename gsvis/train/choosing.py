"""Choose nested subsets of a scene by many cameras, with a probability to stay for each Gaussian.

Of Gaussians that hide each other, any but not all may go. A wall of many faint Gaussians would be lost if each counted
little. So each Gaussian has a probability to stay, from its worth so far, which scales its alpha while the worth of the
others is measured. If too many are about to go, the rest gains worth. docs/design/019-levels.md
compares this with `prune`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.jobs.in_order import in_order
from gsvis.jobs.resume import KeptWork
from gsvis.progress import Progress, silent
from gsvis.render.removal import Removals
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.in_sight import InSight
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.importance import ROUNDS, most_important, read_rounds
from gsvis.train.stand_ins import StandIns

__all__ = ["LOOKS", "choose_subsets", "count_looks", "stay_chances"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

LOOKS = 120
"""How many cameras see an average Gaussian before the first cut."""

_BATCH = 10  # looks between two updates of the chances
_ROUND = 100  # looks after which the state is kept
_OLD = 0.95  # weight of older looks after each batch
_BEFORE = 0.2  # weight of looks before a cut, after it
_SHARPNESS = 4.0  # of the chance as a function of the logarithm of the worth
_LEAST_CHANCE = 0.02
_LATER = 0.6  # looks for a later cut to a half or less, over those for the first; fewer if it takes less
_FEWEST = 40  # looks for a cut
_POLLED = 200  # cameras that say how often a Gaussian is in sight
_SELDOM = 0.02  # share of cameras below which it makes no difference
_FAIRNESS = 0.5  # in rooms; 0: worth is the mean loss over all cameras; 1: over the cameras with the Gaussian in sight
_TRIED = 16  # cameras from which the number of looks is found
# of worth, logarithm to base 2
_BINS = 2048
_PER_OCTAVE = 16
_LOWEST = -110
_BLOCK = 1 << 16  # Gaussians


@dataclass(frozen=True)
class _Round:
    """The looks between two files: the cameras, the size of the cut they prepare, and whether it follows them."""

    cameras: NDArray[np.int64]
    count: int
    cuts: bool


def choose_subsets(
    gaussians: Gaussians,
    cameras: Cameras,
    counts: Sequence[int],
    *,
    looks: float = LOOKS,
    space: NavigableSpace | None = None,
    work: KeptWork | None = None,
    progress: Progress = silent,
) -> list[Mask]:
    """Find nested subsets that keep the images of many cameras.

    The worth of a Gaussian is the squared change of the images by its removal, as in `prune`. In rooms it is divided by
    the root of the share of cameras that have it in sight, so that small rooms count beside halls. Cameras take turns.
    Until the first cut, merged Gaussians stand in for those that may go; see `StandIns`.

    Args:
        gaussians: N Gaussians.
        cameras: C cameras in random order; the number needed is taken from the front, from the start again after C.
        counts: Requested sizes, descending, each 1 to N.
        looks: Number of cameras that see an average Gaussian before the first cut; a later cut to a half takes 0.6
            times as many.
        space: Voxels that stop light, which limit a look to Gaussians possibly in sight; None looks at all.
        work: Storage of finished rounds, to resume from; its plan must name the scene, the cameras, the space and the
            rules.
        progress: Called with stage "prune"; counts looks.

    Returns:
        A mask (N,) for each count, each a subset of the previous one; independent of the order of the Gaussians.

    Raises:
        ValueError: If the counts do not fall, there are no cameras or looks, or `work` belongs to a different run.
        FormatError: If the kept rounds are damaged.
    """
    n = len(gaussians)
    now = n
    for count in counts:
        if _check.positive_int("counts", count) > now:
            raise ValueError(f"counts: expected falling sizes of at most {n}, got {list(counts)}")
        now = count
    if not looks > 0:
        raise ValueError(f"looks: expected a number above 0, got {looks!r}")
    if len(cameras) == 0:
        raise ValueError("cameras: expected at least one to choose by, got none")
    sight = None if space is None else InSight.from_scene(gaussians, space)
    share = _share_in_sight(cameras, sight)
    rounds = _plan(n, len(cameras), counts, _looks_for(share, looks, len(cameras)))
    sizes = []
    left = n
    for each in rounds:
        left = each.count if each.cuts else left
        sizes.append(left)
    done, last, sums = read_rounds(work, sizes, n)
    ranks = np.where(last >= 0, last, len(rounds))
    kept = np.flatnonzero(last < 0)
    looks_left = any(each.count < n for each in rounds) and not any(each.cuts for each in rounds[:done])
    stand_ins = StandIns(gaussians, space) if looks_left else None
    state = _State(gaussians, cameras, sight, kept, sums, stand_ins)
    total = sum(len(each.cameras) for each in rounds)
    before = sum(len(each.cameras) for each in rounds[:done])
    progress("prune", before, total)
    for number, each in enumerate(rounds[done:], done):
        if each.count < len(state.kept):
            for batch in _batches(each.cameras):
                state.look(batch, each.count)
                before += len(batch)
                progress("prune", before, total)
        else:
            before += len(each.cameras)
        if each.cuts:
            ranks[state.cut(each.count)] = number
        if work is not None:
            gone = np.where(ranks < len(rounds), ranks, -1)
            work.keep_own(ROUNDS, {"rounds": np.array([number + 1]), "left": gone, "values": state.sums})
    progress("prune", total, total)
    cuts = [number for number, each in enumerate(rounds) if each.cuts]
    return [ranks > number for number in cuts]


def count_looks(
    gaussians: Gaussians,
    cameras: Cameras,
    counts: Sequence[int],
    *,
    of: int,
    looks: float = LOOKS,
    space: NavigableSpace | None = None,
) -> tuple[int, float]:
    """Return the number of looks of `choose_subsets`, and the share of the Gaussians in sight of a look.

    Args:
        gaussians: N Gaussians.
        cameras: Some of the cameras; 16 are enough.
        counts: Requested sizes, descending.
        of: Number of all cameras.
        looks: As in `choose_subsets`.
        space: Voxels that stop light; None looks at all Gaussians.
    """
    share = _share_in_sight(cameras, None if space is None else InSight.from_scene(gaussians, space))
    rounds = _plan(len(gaussians), of, counts, _looks_for(share, looks, of))
    return sum(len(each.cameras) for each in rounds), share


class _State:
    """The remaining Gaussians, and the measured changes of each.

    Args:
        g: The scene.
        cameras: All cameras.
        sight: Gaussians that each camera may see; None for all.
        kept: (K,) remaining Gaussians.
        sums: (K,) sums of squared changes, older ones with less weight.
        stand_ins: Merged Gaussians that stand in for those that may go, until the first cut; None after it.

    Attributes:
        seen: (N,) share of the cameras with each Gaussian in sight, in rooms; 1 elsewhere.
    """

    def __init__(
        self,
        g: Gaussians,
        cameras: Cameras,
        sight: InSight | None,
        kept: NDArray[np.int64],
        sums: F64,
        stand_ins: StandIns | None,
    ) -> None:
        self.scene = g
        self.cameras = cameras
        self.sight = sight
        self.sums = sums
        self.stand_ins = stand_ins
        self.seen = _seen(len(g), cameras, sight)
        self._keep(kept)
        self._left = g if len(kept) == len(g) else g[kept]
        self._removals = Removals(self._left, None if stand_ins is None else stand_ins.gaussians)

    def look(self, batch: NDArray[np.int64], count: int) -> None:
        """Measure by some cameras, with each Gaussian present by its probability to be among `count`."""
        chances = stay_chances(self._worth(), count / len(self.kept))
        there = None if self.stand_ins is None else self.stand_ins.presence(self.kept, chances)
        self.sums *= _OLD
        presence = chances if there is None else np.concatenate([chances, there])

        def look(index: int) -> tuple[NDArray[np.int32], F64]:
            """Return the Gaussians that one camera shows, and their effects."""
            camera = self.cameras[[index]]
            return self._removals.seen_by(camera, presence, self._shown_by(camera))

        for ids, effects in in_order(look, batch.tolist()):
            self.sums[ids] += effects

    def _shown_by(self, camera: Cameras) -> Mask | None:
        """Return the Gaussians to draw that one camera may see, stand-ins last; None for all."""
        return None if self._drawn_in_sight is None else self._drawn_in_sight.of(camera)

    def _worth(self) -> F64:
        """Return the worth (K,) of each: between its mean loss over all cameras and over those that see it."""
        return np.asarray(self._rarity * self.sums)

    def _keep(self, kept: NDArray[np.int64]) -> None:
        """Note the (K,) remaining Gaussians."""
        self.kept = kept
        self._drawn_in_sight = None if self.sight is None else self.sight.only(kept)
        if self._drawn_in_sight is not None and self.stand_ins is not None and self.stand_ins.sight is not None:
            self._drawn_in_sight = self._drawn_in_sight.join(self.stand_ins.sight)
        self._rarity = self.seen[kept] ** -_FAIRNESS

    def cut(self, count: int) -> NDArray[np.int64]:
        """Keep the `count` Gaussians of most worth; return the others."""
        stays = most_important(self._left, self._worth(), count)
        gone = self.kept[~stays]
        self.stand_ins = None
        self._keep(self.kept[stays])
        self.sums = _BEFORE * self.sums[stays]
        self._left = self.scene[self.kept]
        self._removals = Removals(self._left)
        return gone


def stay_chances(worth: F64, share: float) -> NDArray[np.float32]:
    """Return the probability of each Gaussian to stay if a share stays, from their worth.

    The probability is a logistic function of the logarithm of the worth, and at least 0.02; its mean is the share.
    Sums run over a histogram, so that the order of the Gaussians does not matter.

    Args:
        worth: (K,) at least 0, in any unit.
        share: Share that stays, in (0, 1].
    """
    top = float(worth.max(initial=0.0))
    octaves = np.empty(len(worth))
    held = np.zeros(_BINS, np.int64)

    def measure(some: slice) -> NDArray[np.int64]:
        """Find the octaves of some Gaussians; return how many each bin holds."""
        octaves[some] = _octaves_below(top, worth[some])
        return np.bincount(((octaves[some] - _LOWEST) * _PER_OCTAVE).astype(np.int64), minlength=_BINS)

    for counts in in_order(measure, _blocks(len(worth))):
        held += counts
    middles = _LOWEST + (np.arange(len(held)) + 0.5) / _PER_OCTAVE
    middles[0] = _LOWEST
    low = 2.0 * _LOWEST
    high = -1.0 * _LOWEST
    for _ in range(40):
        middle = 0.5 * (low + high)
        if (held * _logistic(middles - middle)).sum() > share * len(worth):
            low = middle
        else:
            high = middle
    middle = 0.5 * (low + high)
    chances = np.empty(len(worth), np.float32)

    def decide(some: slice) -> None:
        """Find the chances of some Gaussians."""
        chances[some] = _logistic(octaves[some] - middle)

    for _ in in_order(decide, _blocks(len(worth))):
        pass
    return chances


def _octaves_below(top: float, worth: F64) -> F64:
    """Return the logarithms to base 2 of worth relative to the largest; -110 for what no camera has seen."""
    if top <= 0.0:
        return np.full(len(worth), float(_LOWEST))
    with np.errstate(divide="ignore"):
        return np.maximum(np.log2(worth / top), _LOWEST)


def _logistic(octaves: F64) -> F64:
    """Return the probability from octaves of worth above the middle."""
    chances = 1.0 / (1.0 + np.exp2(np.clip(-_SHARPNESS * octaves, -100.0, 100.0)))
    return np.asarray(np.maximum(chances, _LEAST_CHANCE))


def _blocks(count: int) -> list[slice]:
    """Return slices of a number of rows that fit a cache."""
    return [slice(k, min(k + _BLOCK, count)) for k in range(0, count, _BLOCK)]


def _seen(n: int, cameras: Cameras, sight: InSight | None) -> F64:
    """Return the share (N,) of the cameras with each Gaussian in sight, in rooms; 1 elsewhere."""
    if sight is None or sight.space.kind.kind != "rooms":
        return np.ones(n)
    tried = range(min(_POLLED, len(cameras)))
    seen = np.zeros(n)
    for index in tried:
        seen += sight.of(cameras[[index]])
    return np.asarray(seen / max(len(tried), 1) + _SELDOM)


def _share_in_sight(cameras: Cameras, sight: InSight | None) -> float:
    """Return the mean share of the Gaussians that the first cameras may see."""
    if sight is None:
        return 1.0
    return float(np.mean([sight.of(cameras[[index]]).mean() for index in range(min(_TRIED, len(cameras)))]))


def _looks_for(share: float, looks: float, cameras: int) -> float:
    """Return the number of cameras after which an average Gaussian was seen `looks` times; at most all of them."""
    return min(looks / max(share, 1e-3), max(cameras, looks))


def _plan(n: int, cameras: int, counts: Sequence[int], looks: float) -> list[_Round]:
    """Return the rounds: all cameras in turn, with a cut after the last round of each count."""
    rounds: list[_Round] = []
    begin = 0
    now = n
    for cut, count in enumerate(counts):
        part = _LATER * min(np.log2(now / count), 1.0) if cut else 1.0
        left = max(round(looks * part), _FEWEST)
        now = int(count)
        while left > 0:
            some = min(left, _ROUND)
            rounds.append(_Round(np.arange(begin, begin + some) % cameras, int(count), some == left))
            begin = begin + some
            left = left - some
    return rounds


def _batches(cameras: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return cameras in batches."""
    return [cameras[k : k + _BATCH] for k in range(0, len(cameras), _BATCH)]
