"""Policies by name: the order in which records are sent, depending on the bandwidth (paper, section 6.3).

A policy is a table of offsets. The sort key of a record is the bucket of its gain plus the offsets of its group (in
view, out of view, the cell ahead, rings 1 to 3 of neighboring cells), of the level at which it enters, and of its kind
(geometry, or active terms, which follow it). Smaller keys go first. The two orders of the paper add whole ranks, so
gain decides only within a rank; `utility` adds the logarithm of a factor, so all records compare by weight gained for
each byte.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr._kernels import units as kernels
from gsvis.abr._kernels.plan import NEVER
from gsvis.abr.rings import RINGS

__all__ = [
    "AHEAD",
    "GROUPS",
    "POLICIES",
    "REGIMES",
    "UtilityConfig",
    "fill_table",
    "first_offset",
    "lowest_last",
    "offset_table",
    "offsets",
    "rank_pairs",
    "regime_of",
]

I64 = NDArray[np.int64]

POLICIES = ("fov-first", "low-first", "utility")
REGIMES = ("high", "medium", "low")
AHEAD = 2
"""Group of the Gaussians that a neighbor sees which the viewer is about to enter."""

GROUPS = AHEAD + RINGS
"""Number of groups: in view, out of view, ahead, and three rings of neighbors."""
_STEPS = 32  # buckets for each halving of a gain
_STICKY = 1.2  # factor beyond a border that the rate must pass before the regime changes


@dataclass(frozen=True)
class UtilityConfig:
    """Factors of the policy "utility": the value of a record, relative to a record in view with the same gain.

    Attributes:
        peripheral: Factor in (0, 1] for Gaussians that the cell sees, but that are out of view.
        ahead: Factor in (0, 1] for Gaussians that only neighbors see, among them the one that the viewer is about to
            enter.
        adjacent: Factor in (0, 1] for Gaussians that only a neighbor by face sees. With r = adjacent / peripheral, it
            is peripheral * r^2 for a neighbor by edge and peripheral * r^3 for one by corner. At most `ahead`.
        terms: Factor in (0, 1] for active terms, relative to the geometry of their Gaussian.
        finer: Factor in (0, 1] for Gaussians in view that enter above the lowest level that is no first picture: those
            that they replace are there already, so they gain less than their weight.
        first: Factor in (0, 1] for Gaussians of a first picture alone, which are soon replaced.
        beyond: Factor in (0, 1] for levels above the highest level of the regime.
        edge: Factor in (0, 1] for Gaussians that are in view only by the margin of the view, but not for those of a
            first picture alone.
        change: Gain, as weighted steradians a byte, of terms that change the image by the package's epsilon. Those that
            change it by a multiple gain the square of it: see `AbrConfig.strong`.
        medium: Exponent on `peripheral` and `adjacent` at medium bandwidth.
        low: Exponent on `peripheral` and `adjacent` at low bandwidth, which then favors what is in view.
    """

    peripheral: float = 0.01
    ahead: float = 0.01
    adjacent: float = 0.003
    terms: float = 0.03
    finer: float = 0.1
    first: float = 0.3
    beyond: float = 0.05
    edge: float = 0.1
    change: float = 4e-8
    medium: float = 1.5
    low: float = 2.0

    def __post_init__(self) -> None:
        for name in ("peripheral", "ahead", "adjacent", "terms", "finer", "first", "beyond", "edge"):
            if not 1e-6 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: expected a factor in [1e-6, 1], got {getattr(self, name)!r}")
        if not 0.0 < self.change <= 1.0:
            raise ValueError(f"change: expected a gain in (0, 1], got {self.change!r}")
        for name in ("medium", "low"):
            if not 1.0 <= getattr(self, name) <= 4.0:
                raise ValueError(f"{name}: expected a power in [1, 4], got {getattr(self, name)!r}")


def regime_of(rate: float, level_bytes: NDArray[np.float64], horizon: float, before: str | None = None) -> str:
    """Return the bandwidth regime of a cell.

    Args:
        rate: Estimated throughput, bytes a second.
        level_bytes: (L,) bytes of what the cell sees of each level, lowest first.
        horizon: Seconds.
        before: The regime so far, which changes only if the rate is a fifth beyond the border; None at the start.

    Returns:
        "high" if the highest level arrives within the horizon, "medium" if the level below does, else "low".
    """
    sizes = np.maximum.accumulate(level_bytes)
    least_high = float(sizes[-1])
    least_medium = float(sizes[max(len(sizes) - 2, 0)])

    def rank_of(budget: float) -> int:
        """Return the index in `REGIMES` of a budget in bytes: 0 for high."""
        return 0 if budget >= least_high else 1 if budget >= least_medium else 2

    now = rank_of(rate * horizon)
    if before is None:
        return REGIMES[now]
    was = REGIMES.index(before)
    if now < was:  # up, if the rate is well above the border
        return REGIMES[min(rank_of(rate * horizon / _STICKY), was)]
    return REGIMES[max(rank_of(rate * horizon * _STICKY), was)]


def lowest_last(regime: str, levels: int) -> int:
    """Return the lowest last level that a Gaussian needs to be sent: the highest at high bandwidth, else level 0."""
    return levels - 1 if _check.one_of("regime", regime, REGIMES) == "high" else 0


def level_caps(regime: str, levels: int, picture: int = -1) -> tuple[int, int]:
    """Return the highest level to send first in a regime, in view and out of view; higher levels go last."""
    middle = max(levels - 2, 0)
    low = min(picture + 1, levels - 1)
    return {"high": (levels - 1, levels - 1), "medium": (middle, middle), "low": (max(middle, low), low)}[regime]


def rank_pairs(policy: str, regime: str, levels: int, picture: int = -1) -> list[tuple[int, int]]:
    """Return pairs of group and level in one of the paper's two orders, first to last.

    Args:
        policy: "fov-first": in view from low to high, the low level out of view, the rest by distance; "low-first": low
            in view, low out of view, medium in view, the rest by distance. The cell ahead counts as the nearest.
        regime: One of `REGIMES`. Levels above those of `level_caps` go last, in the same order.
        levels: L, number of levels.
        picture: Highest level of the first picture; the level above it is "low". -1 if there is none.
    """
    _check.one_of("policy", policy, POLICIES[:2])
    _check.one_of("regime", regime, REGIMES)
    everything = range(levels)
    split = levels if policy == "fov-first" else min(picture + 2, levels)
    order = []
    for some in (everything[:split], everything[split:]):
        order += [(group, level) for group in (0, 1) for level in some]
    order += [(group, level) for group in range(AHEAD, GROUPS) for level in everything]
    in_view, elsewhere = level_caps(regime, levels, picture)
    beyond = [(group, level) for group, level in order if level > (in_view if group == 0 else elsewhere)]
    return [pair for pair in order if pair not in beyond] + beyond


@lru_cache(maxsize=256)
def offsets(policy: str, regime: str, levels: int, config: UtilityConfig | None = None, picture: int = -1) -> I64:
    """Return (6, L, 2) offsets to add to the bucket of a record: by its group, its first level, and geometry or terms.

    Args:
        policy: One of `POLICIES`.
        regime: One of `REGIMES`.
        levels: L, number of levels.
        config: Factors of `utility`; None means `UtilityConfig()`.
        picture: Highest level of the first picture; -1 if there is none.
    """
    _check.one_of("policy", policy, POLICIES)
    out = np.zeros((GROUPS, _check.positive_int("levels", levels), 2), np.int64)
    if policy != "utility":
        for rank, (group, level) in enumerate(rank_pairs(policy, regime, levels, picture)):
            out[group, level] = (np.array([0, 1]) + 2 * rank) * kernels.BUCKETS
        return out
    config = config or UtilityConfig()
    power = {"high": 1.0, "medium": config.medium, "low": config.low}[_check.one_of("regime", regime, REGIMES)]
    ratio = min(config.adjacent / config.peripheral, 1.0)
    rings = [min(config.peripheral * ratio**ring, config.ahead) for ring in range(1, RINGS)]
    shares = [config.peripheral, config.ahead, *rings]
    worth = [1.0, *(share**power for share in shares)]
    in_view, elsewhere = level_caps(regime, levels, picture)
    for group in range(GROUPS):
        for level in range(levels):
            later = config.beyond if level > (in_view if group == 0 else elsewhere) else 1.0
            later *= config.finer if group == 0 and level > picture + 1 else 1.0
            for kind, factor in ((kernels.GEOMETRY, 1.0), (kernels.TERMS, config.terms)):
                out[group, level, kind] = round(-_STEPS * np.log2(worth[group] * later * factor))
    return out


@lru_cache(maxsize=256)
def offset_table(
    policy: str,
    regime: str,
    levels: int,
    config: UtilityConfig | None = None,
    *,
    terms_in: tuple[int, ...] = (kernels.INSIDE, kernels.EDGE),
    picture: int = -1,
    strong: tuple[float, ...] = (),
    kinds: int = 1,
) -> tuple[NDArray[np.int32], int]:
    """Return the table of offsets that the kernels read, and the number of keys.

    The axes of the table are the code of a unit; the kind of records: geometry, all terms, or terms that change the
    image by at least one of `strong`, which have a least key (`least_keys`) instead of an offset; and the part: in the
    middle of the view, out of view, or at its edge. For rings 1 to 3 "in the middle" means in the cell ahead.

    Records with the offset `NEVER` are not sent: Gaussians that end below `lowest_last` or at level `picture` or below,
    terms in parts of ring 0 that are not in `terms_in`, and terms that only neighbors see that are not ahead. The first
    picture is an exception: Gaussians in view that enter at level `picture` or below are sent, without terms.

    Args:
        policy: One of `POLICIES`.
        regime: One of `REGIMES`.
        levels: L, number of levels.
        config: Factors of `utility`; None means `UtilityConfig()`.
        terms_in: Parts of ring 0 in which terms are sent.
        picture: Highest level of the first picture; -1 if there is none.
        strong: See `AbrConfig.strong`.
        kinds: K, number of kinds of terms, at least 1 + the length of `strong`.

    Returns:
        table: (4 L L, 1 + K, 3) int32, read-only.
        keys: Number of keys; all keys that are sent are below it.
    """
    found = offsets(policy, regime, levels, config, picture)
    least = max(lowest_last(regime, levels), picture + 1)
    later = first_offset(policy, config)
    edge = edge_offset(policy, config)
    out = np.full((RINGS, levels, levels, 1 + kinds, 3), NEVER, np.int32)
    both = slice(0, kernels.STRONG)
    for last in range(least, levels):
        out[0, :, last, both, : kernels.EDGE] = found[:AHEAD].transpose(1, 2, 0)
        out[1:, :, last, both, kernels.INSIDE] = found[AHEAD]
        out[1:, :, last, kernels.GEOMETRY, kernels.OUTSIDE] = found[AHEAD + 1 :, :, kernels.GEOMETRY]
        for kind, bound in enumerate(least_keys(strong, config), kernels.STRONG):
            out[0, :, last, kind, kernels.INSIDE] = bound
            out[1:, :, last, kind, kernels.INSIDE] = bound + found[AHEAD, 0, kernels.GEOMETRY]
    inside = out[0, ..., kernels.INSIDE]
    out[0, ..., kernels.EDGE] = np.where(inside < NEVER, inside + edge, NEVER)
    for last in range(least):
        first = slice(0, min(picture, last) + 1)
        for part in (kernels.INSIDE, kernels.EDGE):
            out[0, first, last, kernels.GEOMETRY, part] = found[0, first, kernels.GEOMETRY] + later
    for part in {kernels.OUTSIDE, kernels.EDGE}.difference(terms_in):
        out[0, ..., kernels.TERMS :, part] = NEVER
    out = out.reshape(-1, 1 + kinds, 3)
    out.flags.writeable = False
    return out, int(max(found.max() + later + edge, out[out < NEVER].max(initial=0))) + kernels.BUCKETS


def least_keys(strong: tuple[float, ...], config: UtilityConfig | None = None) -> list[int]:
    """Return the least key of terms in view for each of `AbrConfig.strong`."""
    gains = np.array([(config or UtilityConfig()).change * change * change for change in strong], np.float32)
    places = (gains.view(np.int32) >> 18) - kernels.LEAST  # as `bucket_of` in the kernels
    return [kernels.BUCKETS - 1 - min(max(int(place), 0), kernels.BUCKETS - 1) for place in places]


def edge_offset(policy: str, config: UtilityConfig | None = None) -> int:
    """Return the extra offset of Gaussians at the edge of the view."""
    return round(-_STEPS * np.log2((config or UtilityConfig()).edge)) if policy == "utility" else 0


def first_offset(policy: str, config: UtilityConfig | None = None) -> int:
    """Return the extra offset of Gaussians that belong to the first picture alone."""
    return round(-_STEPS * np.log2((config or UtilityConfig()).first)) if policy == "utility" else 0


@lru_cache(maxsize=256)
def fill_table(
    policy: str, levels: int, config: UtilityConfig | None = None, *, kinds: int = 1
) -> tuple[NDArray[np.int32], int]:
    """Return the `offset_table` and number of keys for filling an idle link: a shell in order of gain, terms included.

    A shell has one ring. Only Gaussians of the highest level are sent: at the end a client shows nothing else.
    """
    found = offsets(policy, "high", levels, config)[-1]
    found = found - found.min()
    out = np.full((RINGS, levels, levels, 1 + kinds, 3), NEVER, np.int32)
    out[1:, :, levels - 1, : kernels.STRONG] = found[:, :, None]
    out = out.reshape(-1, 1 + kinds, 3)
    out.flags.writeable = False
    return out, int(found.max()) + kernels.BUCKETS
