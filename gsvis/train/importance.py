"""Measure how much Gaussians matter to images, and find nested subsets of the important ones.

Values are per pixel, averaged over channels and views; RGB where 1 is white. docs/design/019-levels.md compares the
methods.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._extras import require
from gsvis.errors import FormatError
from gsvis.jobs.resume import KeptWork
from gsvis.progress import Progress, silent
from gsvis.render.rasterizer import rasterize
from gsvis.render.removal import removal_effects
from gsvis.render.weights import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.images import PosedImages

__all__ = ["IMPORTANCE_METHODS", "ROUNDS", "importance", "most_important", "prune", "rank_by_error", "read_rounds"]

ROUNDS = "rounds.npz"
"""File name of the finished rounds in a folder of unfinished work."""

IMPORTANCE_METHODS = ("removal", "absolute", "error", "gradient", "weight")

_BLACK = (0.0, 0.0, 0.0)


def importance(
    gaussians: Gaussians,
    views: PosedImages | Cameras,
    *,
    method: str = "removal",
    background: ArrayLike = _BLACK,
    progress: Progress = silent,
) -> NDArray[np.float64]:
    """Measure how much each Gaussian matters to the images of some views.

    Args:
        gaussians: N Gaussians.
        views: Photos with their cameras, or cameras alone, which compare with the scene's own images.
        method: "removal": the mean squared change of the images by the Gaussian's removal. "absolute": the mean
            absolute change. "error": the increase of the mean squared error against the photos by its removal, negative
            if
                they match better without it; subsets of the highest are bad. "gradient": eq. 6, the sum over views of
                |dE_i
            / dg| over the sum of pixels, with E_i the absolute error of view i and dE_i / dg taken over the logarithms
            of the three scales (their norm), which ranked best. "weight": the mean blending weight.
        background: (3,) RGB behind everything.
        progress: Called with stage "importance"; counts views.

    Returns:
        (N,) per pixel, larger is more important; 0 for Gaussians that no view shows.

    Raises:
        ValueError: If the method is unknown, or is "gradient" or "error" without photos: the error against the
            scene's own images is zero, and so is its gradient.

    References:
        SRBF-Gaussian, section 6.1, equation 6.
    """
    _check.one_of("method", method, IMPORTANCE_METHODS)
    cameras = views.cameras if isinstance(views, PosedImages) else views
    if method in ("gradient", "error") and not isinstance(views, PosedImages):
        raise ValueError(
            f"method: expected photographs for {method!r}, got cameras only; the error against the scene's own images "
            "is zero and so is its gradient: use 'removal'"
        )
    pixels = max(len(cameras), 1) * cameras.width * cameras.height

    def report(stage: str, done: int, total: int) -> None:
        """Report the progress of a round as part of all rounds."""
        progress("importance", done, total)

    if method == "weight":
        summed = np.zeros(len(gaussians))
        progress("importance", 0, len(cameras))
        for c in range(len(cameras)):  # all views at once would be a (C, N) array
            summed += view_weights(gaussians, cameras[c]).summed[0]
            progress("importance", c + 1, len(cameras))
        return summed / pixels
    if method == "gradient":
        assert isinstance(views, PosedImages)
        return _gradients(gaussians, views, background, report) / pixels
    images = views.images if method == "error" and isinstance(views, PosedImages) else None
    effects = removal_effects(gaussians, cameras, images=images, background=background, progress=report)
    return {"removal": effects.squared, "absolute": effects.absolute, "error": effects.error_change}[method] / pixels


def _gradients(g: Gaussians, views: PosedImages, background: ArrayLike, progress: Progress) -> NDArray[np.float64]:
    """Return (N,) sum over views of |dE_i / d log scales|, E_i the absolute error summed over pixels, channel mean."""
    require("method 'gradient'", "torch")
    import torch

    from gsvis.render.tensors import GaussianTensors

    tensors = GaussianTensors.from_gaussians(g)
    tensors.scales.requires_grad_(True)
    total = torch.zeros(len(g), dtype=torch.float64)
    progress("gradient", 0, len(views))
    for c in range(len(views)):
        drawn = rasterize(tensors, views.cameras[c], background=background).images[0]
        error = (drawn - torch.from_numpy(views.image(c))).abs().sum() / 3.0
        (by_scales,) = torch.autograd.grad(error, [tensors.scales])
        total += (tensors.scales.detach() * by_scales).double().norm(dim=1)
        progress("gradient", c + 1, len(views))
    return total.numpy()


def most_important(gaussians: Gaussians, importance: ArrayLike, count: int) -> NDArray[np.bool_]:
    """Return the most important Gaussians; ties are broken by content, so that the order of the scene does not matter.

    Args:
        gaussians: N Gaussians.
        importance: (N,) larger is more important.
        count: How many to select, 0 to N.

    Returns:
        (N,) mask of `count` Gaussians.

    Raises:
        ValueError: If `count` or the number of values does not fit.
    """
    values = _check.floats("importance", importance, (len(gaussians),), np.float64)
    if _check.positive_int("count", count, at_least=0) > len(values):
        raise ValueError(f"count: expected at most {len(values)}, the number of Gaussians, got {count}")
    if count == 0:
        return np.zeros(len(values), bool)
    least = -np.partition(-values, count - 1)[count - 1]
    chosen = values > least
    equal = np.flatnonzero(values == least)
    some = gaussians[equal]
    columns = some.means, some.scales, some.quats, some.opacities[:, None], some.sh0[:, 0]
    keys = [key for column in columns for key in column.T]
    chosen[equal[np.lexsort(keys[::-1])[: count - int(chosen.sum())]]] = True
    return np.asarray(chosen)


def rank_by_error(
    gaussians: Gaussians,
    views: PosedImages,
    counts: Sequence[int],
    *,
    photographs: bool,
    progress: Progress = silent,
) -> list[NDArray[np.bool_]]:
    """Find nested subsets by equation 6 of the paper: measured once, and the most important ones stay.

    Renders of the scene itself have no error, and so no gradient. Then the finite difference takes its place: how much
    error, absolute and per pixel, the removal of a Gaussian makes.

    Args:
        gaussians: N Gaussians.
        views: All training views.
        counts: Requested sizes, each 1 to N.
        photographs: Whether the images are photographs, not renders of these Gaussians.
        progress: Called with stage "prune"; counts views.

    Returns:
        A mask (N,) for each count; those of smaller counts are subsets of the others.

    References:
        SRBF-Gaussian, section 6.1, equation 6.
    """

    def report(stage: str, done: int, total: int) -> None:
        """Report progress as that of a choice."""
        progress("prune", done, total)

    method = "gradient" if photographs else "absolute"
    values = importance(gaussians, views, method=method, progress=report)
    return [most_important(gaussians, values, count) for count in counts]


def prune(
    gaussians: Gaussians,
    views: PosedImages | Cameras,
    counts: Sequence[int],
    *,
    share: float = 0.2,
    looks: int | None = None,
    background: ArrayLike = _BLACK,
    work: KeptWork | None = None,
    progress: Progress = silent,
) -> list[NDArray[np.bool_]]:
    """Find nested subsets: remove the least important share, measure again, repeat.

    Effects of single removals do not add up: of two Gaussians that hide each other, either may go, but not both. Each
    round therefore measures again the effect of removing each remaining Gaussian, while all others have the share of
    their alpha that the round will leave on average. This reveals pairs that hide each other. Only the size of the
    change counts, not its sign: if Gaussians whose removal corrects an error were removed first, together they would
    overcorrect it. docs/design/019-levels.md compares the methods.

    Args:
        gaussians: N Gaussians.
        views: Cameras, or photos, of which only the cameras are used.
        counts: Requested sizes, descending, each 1 to N.
        share: Largest share of the remaining Gaussians that one round removes, in (0, 1); each round costs a pass
            over its views.
        looks: Number of views of a round, to limit its cost; None for all views in every round. Rounds take turns
            through the views. The first round, whose removals are never measured again, uses three times as many. The
            results of a round count in later ones too, half as much in each.
        background: (3,) RGB behind everything.
        work: Storage of finished rounds, to resume from; its plan must name the scene, the cameras and the rules.
        progress: Called with stage "prune"; counts views of all rounds.

    Returns:
        A mask (N,) for each count, each a subset of the previous one; independent of the order of the Gaussians.

    Raises:
        ValueError: If the counts do not fall, `share` or `looks` is out of range, or `work` belongs to a different run.
        FormatError: If the kept rounds are damaged.
    """
    if not 0.0 < share < 1.0:
        raise ValueError(f"share: expected a value in (0, 1), got {share!r}")
    schedule = _schedule(len(gaussians), counts, share)
    cameras = views.cameras if isinstance(views, PosedImages) else views
    turns = _turns(len(cameras), len(schedule), looks)
    total = sum(map(len, turns))
    ranks = np.full(len(gaussians), len(schedule), np.int64)
    done, last, values = read_rounds(work, schedule, len(gaussians))
    ranks[last >= 0] = last[last >= 0]
    kept = np.flatnonzero(last < 0)
    progress("prune", before := sum(map(len, turns[:done])), total)
    for number, (turn, size) in enumerate(list(zip(turns, schedule, strict=True))[done:], done):

        def report(stage: str, done: int, of: int, before: int = before) -> None:
            """Report the progress of a round as part of all rounds."""
            if done:
                progress("prune", before + done, total)

        before += len(turn)
        if size < len(kept):
            left = gaussians[kept]
            presence = np.full(len(left), size / len(left), np.float32)
            effects = removal_effects(left, cameras[turn], background=background, presence=presence, progress=report)
            found = effects.squared / max(effects.pixels, 1)
            values = found if looks is None else found + 0.5 * values
            stays = most_important(left, values, size)
            ranks[kept[~stays]] = number
            kept = kept[stays]
            values = values[stays]
        if work is not None:
            gone = np.where(ranks < len(schedule), ranks, -1)
            work.keep_own(ROUNDS, {"rounds": np.array([number + 1]), "left": gone, "values": values})
    progress("prune", total, total)
    rounds = [len(schedule) - 1 - schedule[::-1].index(count) for count in counts]
    return [ranks > number for number in rounds]


def read_rounds(
    work: KeptWork | None, schedule: list[int], n: int
) -> tuple[int, NDArray[np.int64], NDArray[np.float64]]:
    """Return the number of kept rounds, (N,) the round in which each Gaussian left or -1, and values of the rest.

    Args:
        work: The folder; None for nothing kept.
        schedule: Number of Gaussians after each round.
        n: Number of Gaussians of the scene.

    Raises:
        FormatError: If the kept rounds do not fit.
    """
    found = None if work is None else work.read_own(ROUNDS)
    if work is None or found is None:
        return 0, np.full(n, -1), np.zeros(n)
    try:
        rounds = found["rounds"]
        left = found["left"]
        values = found["values"]
        if rounds.shape != (1,) or (rounds.dtype.kind, left.dtype.kind, values.dtype.kind) != ("i", "i", "f"):
            raise ValueError(f"arrays of {rounds.dtype} {rounds.shape}, {left.dtype} and {values.dtype}")
        done = int(rounds[0])
        if not 0 < done <= len(schedule) or left.shape != (n,) or not -1 <= left.min() <= left.max() < done:
            raise ValueError(f"round {done} of {len(schedule)}, and {left.shape} of {n:,} Gaussians")
        if values.shape != ((left < 0).sum(),) or len(values) != min(schedule[done - 1], n) or np.isnan(values).any():
            raise ValueError(f"{values.shape} values, or NaN among them")
    except (LookupError, ValueError) as error:
        got = f"{type(error).__name__}: {error}"
        raise FormatError(work.folder / ROUNDS, "", "the finished rounds", got, "delete it to start again") from error
    return done, np.asarray(left, np.int64), np.asarray(values, np.float64)


def _turns(cameras: int, rounds: int, looks: int | None) -> list[NDArray[np.int64]]:
    """Return the cameras of each round."""
    if looks is None:
        return [np.arange(cameras)] * rounds
    _check.positive_int("looks", looks)
    order = np.random.default_rng(0).permutation(cameras)
    turns = []
    begin = 0
    for number in range(rounds):
        count = min(looks if number else 3 * looks, cameras)
        turns.append(np.sort(np.take(order, np.arange(begin, begin + count), mode="wrap")))
        begin += count
    return turns


def _schedule(n: int, counts: Sequence[int], share: float) -> list[int]:
    """Return the sizes after each round, including each of `counts`."""
    sizes: list[int] = []
    now = n
    for count in counts:
        if _check.positive_int("counts", count) > now:
            raise ValueError(f"counts: expected falling sizes of at most {n}, got {list(counts)}")
        rounds = max(int(np.ceil(np.log(count / now) / np.log1p(-share) - 1e-9)), 1)
        sizes += [round(now * (count / now) ** ((k + 1) / rounds)) for k in range(rounds - 1)] + [int(count)]
        now = int(count)
    return sizes
