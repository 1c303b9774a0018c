"""Importance: what it is on scenes with a known answer, and laws of subsets."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.jobs.resume import KeptWork
from gsvis.render import rasterize
from gsvis.render.removal import RemovalEffects
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.images import PosedImages
from gsvis.train.importance import IMPORTANCE_METHODS, ROUNDS, importance, most_important, prune, rank_by_error
from tests.raycast.scenes import scene


def views(count: int = 3) -> Cameras:
    return Cameras.orbit([0, 0, 0], 3.0, count, width=40, height=30)


def photographs(g: Gaussians, cameras: Cameras) -> PosedImages:
    return PosedImages(cameras, rasterize(g, cameras).images)


def error(g: Gaussians, aims: PosedImages) -> float:
    """Mean squared error."""
    return float(np.square(rasterize(g, aims.cameras).images.astype(np.float64) - aims.images).mean())


@pytest.mark.parametrize("method", IMPORTANCE_METHODS)
def test_laws_of_every_method(method: str) -> None:
    g, cameras = scene("mixed", n=150), views()
    aims = photographs(scene("blobs", seed=2, n=100), cameras)
    calls: list[tuple[str, int, int]] = []
    values = importance(g, aims, method=method, progress=lambda *call: calls.append(call))
    assert values.dtype == np.float64
    assert values.shape == (150,)
    assert calls == [("importance", i, 3) for i in range(4)]
    turn = np.random.default_rng(0).permutation(len(g))
    np.testing.assert_array_equal(importance(g[turn], aims, method=method), values[turn])
    hidden = Gaussians(g.means, g.quats, g.scales, np.zeros(len(g)), g.sh0, g.shN)
    assert not importance(hidden, aims, method=method).any()
    assert importance(Gaussians.empty(1), aims, method=method).shape == (0,)


def test_error_and_removal_are_what_removing_does() -> None:
    g, cameras = scene("blobs", n=20), views()
    g = Gaussians(g.means, g.quats, g.scales, 0.6 * g.opacities, g.sh0, g.shN)
    own, aims = photographs(g, cameras), photographs(scene("blobs", seed=2, n=20), cameras)
    removal, by_error = importance(g, cameras), importance(g, aims, method="error")
    for index in range(len(g)):
        rest = g[np.arange(len(g)) != index]
        np.testing.assert_allclose(removal[index], error(rest, own), atol=1e-6)
        np.testing.assert_allclose(by_error[index], error(rest, aims) - error(g, aims), atol=1e-6)
    np.testing.assert_array_equal(importance(g, aims), removal)


def test_equation_6_chooses_at_once_by_photographs_and_by_renders() -> None:
    g, cameras = scene("mixed", n=60), views()
    aims = photographs(scene("blobs", seed=2, n=60), cameras)
    calls: list[tuple[str, int, int]] = []
    half, fifth = rank_by_error(g, aims, [30, 12], photographs=True, progress=lambda *call: calls.append(call))
    assert calls == [("prune", i, 3) for i in range(4)]
    assert (half.sum(), fifth.sum()) == (30, 12)
    assert not (fifth & ~half).any()
    by_slope = importance(g, aims, method="gradient")
    assert by_slope[half].min() >= by_slope[~half].max()
    (of_renders,) = rank_by_error(g, photographs(g, cameras), [30], photographs=False)
    by_change = importance(g, cameras, method="absolute")
    assert by_change[of_renders].min() >= by_change[~of_renders].max()


def test_gradient_is_the_slope_of_the_error_by_size() -> None:
    g, camera = scene("blobs", n=20), views(1)
    aims = photographs(scene("blobs", seed=2, n=20), camera)
    values = importance(g, aims, method="gradient")

    def absolute(scales: np.ndarray) -> float:
        drawn = rasterize(Gaussians(g.means, g.quats, scales, g.opacities, g.sh0, g.shN), camera).images
        return float(np.abs(drawn.astype(np.float64) - aims.images).mean())

    for index in np.argsort(values)[-3:]:
        slopes = []
        for axis in range(3):
            steps = np.zeros((2, *g.scales.shape))
            steps[:, index, axis] = 2e-3, -2e-3
            slopes.append((absolute(g.scales * np.exp(steps[0])) - absolute(g.scales * np.exp(steps[1]))) / 4e-3)
        np.testing.assert_allclose(values[index], np.linalg.norm(slopes), rtol=0.05)


def test_gradient_asks_for_photographs() -> None:
    with pytest.raises(
        ValueError, match=r"^method: expected photographs for 'gradient', got cameras only; .* 'removal'"
    ):
        importance(scene("one"), views(), method="gradient")
    with pytest.raises(ValueError, match=r"^method: expected one of 'removal', "):
        importance(scene("one"), views(), method="guess")


def test_most_important_whatever_the_order() -> None:
    g = scene("coincident", n=60)
    values = np.random.default_rng(3).integers(0, 4, 60).astype(float)  # many ties
    turn = np.random.default_rng(4).permutation(60)
    for count in (0, 1, 17, 30, 59, 60):
        chosen = most_important(g, values, count)
        assert chosen.sum() == count
        assert values[chosen].min(initial=9) >= values[~chosen].max(initial=-9)
        np.testing.assert_array_equal(most_important(g[turn], values[turn], count), chosen[turn])
    with pytest.raises(ValueError, match=r"^count: expected at most 60"):
        most_important(g, values, 61)
    with pytest.raises(ValueError, match=r"^importance: expected shape \(60,\)"):
        most_important(g, values[:5], 3)


def test_pruning_nests_and_takes_one_of_two_twins() -> None:
    """Every Gaussian stands twice: either may go, both may not; one look does not show which. One goes each round."""
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 6), np.linspace(-0.6, 0.6, 5))
    shades = np.random.default_rng(0).uniform(0.1, 1.0, (30, 1, 3))
    means = np.stack([x.ravel(), y.ravel(), np.zeros(30)], axis=1)
    apart = Gaussians(means, [[1, 0, 0, 0]] * 30, [[0.05] * 3] * 30, [0.95] * 30, shades)
    g = apart[np.repeat(np.arange(30), 2)]
    camera = Cameras.look_at([[0, 0, -3.0]], [[0, 0, 0]], up=[0, -1, 0], width=64, height=48)
    calls: list[tuple[str, int, int]] = []
    masks = prune(g, camera, (40, 30, 10), share=0.016, progress=lambda *call: calls.append(call))
    assert [int(mask.sum()) for mask in masks] == [40, 30, 10]
    assert not (masks[1] & ~masks[0]).any()
    assert not (masks[2] & ~masks[1]).any()
    np.testing.assert_array_equal(masks[1].reshape(30, 2).sum(axis=1), 1)
    assert most_important(g, importance(g, camera), 30).reshape(30, 2).all(axis=1).any()
    assert calls[0][1] == 0
    assert calls[-1][1] == calls[-1][2]
    assert sorted(calls) == calls
    for mask, again in zip(masks, prune(g, photographs(g, camera), (40, 30, 10), share=0.016), strict=True):
        np.testing.assert_array_equal(mask, again)


def test_equals_are_taken_in_the_order_of_their_means() -> None:
    """Means decide first, x before y: what a content order is must not move between versions."""
    means = np.array([[1.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 4.0, 9.0], [2.0, -9.0, -9.0]])
    g = Gaussians(means, [[1, 0, 0, 0]] * 4, [[0.1] * 3] * 4, [0.5] * 4, np.zeros((4, 1, 3)))
    assert np.flatnonzero(most_important(g, np.ones(4), 1)).tolist() == [2]
    assert np.flatnonzero(most_important(g, np.ones(4), 3)).tolist() == [0, 1, 2]


def test_a_round_of_more_views_weighs_as_much_as_one_of_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first round has three times the views: what it found counts a pixel, and half as much in the next."""
    effects = iter([(3 * 1200, [1.0, 0.0, 0.9]), (1200, [0.0, 0.6])])

    def removal(left: Gaussians, *_: object, **__: object) -> RemovalEffects:
        pixels, values = next(effects)
        squared = pixels * np.array(values)
        return RemovalEffects(squared, squared, squared, pixels)

    monkeypatch.setattr(sys.modules[prune.__module__], "removal_effects", removal)
    g = scene("blobs", n=3)
    kept = prune(g, views(4), (1,), share=0.45, looks=1)[0]
    # Round one gives 1, 0, 0.9: the second goes. Round two gives 0 + 0.5 and 0.6 + 0.45.
    assert np.flatnonzero(kept).tolist() == [2]
    effects = iter([(3 * 1200, [1.0, 0.0, 0.3]), (1200, [0.0, 0.6])])  # 0 + 0.5 against 0.6 + 0.15
    assert np.flatnonzero(prune(g, views(4), (1,), share=0.45, looks=1)[0]).tolist() == [2]


def test_pruning_takes_turns_through_its_views() -> None:
    g, cameras = scene("blobs", n=60), views(20)
    calls: list[tuple[str, int, int]] = []
    masks = prune(g, cameras, (40, 20), share=0.3, looks=4, progress=lambda *call: calls.append(call))
    assert [int(mask.sum()) for mask in masks] == [40, 20]
    assert not (masks[1] & ~masks[0]).any()
    assert calls[-1][1:] == (24, 24)  # three rounds more than the first, which has twelve
    turn = np.random.default_rng(1).permutation(60)
    for mask, turned in zip(masks, prune(g[turn], cameras, (40, 20), share=0.3, looks=4), strict=True):
        np.testing.assert_array_equal(mask[turn], turned)
    once = prune(g, cameras, (40,), share=0.5)[0]
    np.testing.assert_array_equal(prune(g, cameras, (40,), share=0.5, looks=20)[0], once)  # one round of all


def test_what_an_early_round_saw_outlasts_a_later_that_looks_away() -> None:
    """Two heaps, each seen from its own side alone: rounds that look from one side do not give up the other."""
    heaps = scene("blobs", n=30)
    shift = np.array([40.0, 0.0, 0.0])
    means = np.concatenate([heaps.means - shift, heaps.means + shift])
    twice = [np.concatenate([getattr(heaps, name)] * 2) for name in ("quats", "scales", "opacities", "sh0", "shN")]
    g = Gaussians(means, *twice)
    sides = [Cameras.orbit(side, 3.0, 2, width=40, height=30) for side in (-shift, shift)]
    cameras = Cameras(*(np.concatenate([getattr(c, name) for c in sides]) for name in ("viewmats", "Ks")), 40, 30)
    kept = prune(g, cameras, (20,), share=0.45, looks=1)[0]
    assert min(kept[:30].sum(), kept[30:].sum()) >= 5


def test_pruning_refuses() -> None:
    g, cameras = scene("blobs", n=20), views(1)
    assert [m.sum() for m in prune(g, cameras, (20, 20))] == [20, 20]
    for counts in ((5, 10), (21,)):
        with pytest.raises(ValueError, match=r"^counts: expected falling sizes of at most 20, got"):
            prune(g, cameras, counts)
    with pytest.raises(ValueError, match=r"^counts: expected an integer of at least 1"):
        prune(g, cameras, (0,))
    for share in (1.0, 0.0, -0.5, np.nan):
        with pytest.raises(ValueError, match=rf"^share: expected a value in \(0, 1\), got {share}"):
            prune(g, cameras, (5,), share=share)
    with pytest.raises(ValueError, match=r"^looks: expected an integer of at least 1"):
        prune(g, cameras, (5,), looks=0)


COUNTS = (90, 40)  # of 150, by rounds of 0.3: two and three


def pruned(
    work: KeptWork | None, stop_at: int | None = None, looks: int | None = 2
) -> tuple[list[np.ndarray], list[int]]:
    """Return the masks and the views reported; raise KeyboardInterrupt when `stop_at` views are done."""
    calls: list[int] = []

    def report(stage: str, done: int, total: int) -> None:
        calls.append(done)
        if done == stop_at:
            raise KeyboardInterrupt

    g, cameras = scene("mixed", n=150), views(6)
    return prune(g, cameras, COUNTS, share=0.3, looks=looks, work=work, progress=report), calls


@pytest.mark.parametrize("looks", [2, None])
def test_rounds_that_were_finished_are_not_looked_at_again(looks: int | None, tmp_path: Path) -> None:
    """A round ends with its file: a run that dies in the next round loses that round alone, and no bit changes."""
    whole, calls = pruned(None, looks=looks)
    ends = [6, 8, 10, 12, 14] if looks else [6, 12, 18, 24, 30]
    assert max(calls) == ends[-1]
    kept = KeptWork(tmp_path, {"looks": looks})
    for at, resumed_at in ((ends[0] - 1, 0), (ends[1] - 1, ends[0]), (ends[4] - 1, ends[3])):
        with pytest.raises(KeyboardInterrupt):
            pruned(kept, at, looks)
        assert (tmp_path / ROUNDS).exists() == (resumed_at > 0)
    for resumed_at in (ends[3], ends[4]):  # the second time all is kept
        again, calls = pruned(kept, looks=looks)
        assert min(calls) == resumed_at
        for mask, other in zip(whole, again, strict=True):
            np.testing.assert_array_equal(mask, other)


@pytest.mark.parametrize(
    "change",
    [
        {"rounds": np.array([9])},
        {"rounds": np.array([0])},
        {"rounds": np.array([2, 2])},
        {"rounds": np.array([2.0])},
        {"left": np.zeros(3, np.int64)},
        {"left": np.full(150, 7)},
        {"values": np.zeros(3)},
    ],
)
def test_damaged_rounds_are_refused(change: dict[str, np.ndarray], tmp_path: Path) -> None:
    kept = KeptWork(tmp_path, {})
    with pytest.raises(KeyboardInterrupt):
        pruned(kept, 9)
    found = kept.read_own(ROUNDS)
    assert found is not None
    kept.keep_own(ROUNDS, {**found, **change})
    with pytest.raises(FormatError, match=r"rounds\.npz.*delete it to start again"):
        pruned(kept)
    with pytest.raises(ValueError, match="work of a run with different ones"):
        pruned(KeptWork(tmp_path, {"other": 1}))
