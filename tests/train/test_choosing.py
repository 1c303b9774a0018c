"""Choosing by chances: laws of the chances, walls that stay, subsets nest, a killed run ends at the same bits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.jobs.resume import KeptWork
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.choosing import choose_subsets, stay_chances
from gsvis.train.importance import ROUNDS, prune
from tests.raycast.scenes import scene


def views(count: int = 4) -> Cameras:
    return Cameras.orbit([0, 0, 0], 3.0, count, width=40, height=30)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 1.0])
def test_chances_add_up_and_rise_with_worth(share: float) -> None:
    worth = np.random.default_rng(0).lognormal(0.0, 3.0, 5000)
    chances = stay_chances(worth, share)
    assert chances.mean() == pytest.approx(share, abs=0.01)
    assert chances.min() >= np.float32(0.02)
    assert chances.max() <= 1.0
    assert (np.diff(chances[np.argsort(worth)]) >= 0).all()
    np.testing.assert_array_equal(stay_chances(2.0**-20 * worth, share), chances)
    turn = np.random.default_rng(1).permutation(5000)
    np.testing.assert_array_equal(stay_chances(worth[turn], share), chances[turn])


def test_before_any_look_all_chances_are_the_share() -> None:
    np.testing.assert_allclose(stay_chances(np.zeros(7), 0.3), 0.3, atol=1e-3)
    assert stay_chances(np.zeros(0), 0.3).shape == (0,)
    some = stay_chances(np.array([0.0] * 5 + [1.0] * 5), 0.5)
    assert some[:5].max() < 0.1  # what nobody saw
    assert some[5:].min() > 0.9


def test_a_wall_of_many_faint_layers_does_not_go_at_once() -> None:
    """Behind a wall of 60 layers it is dark; each layer is missed less than any of 60 lone Gaussians beside it."""
    x, y = np.meshgrid(np.linspace(1.0, 2.2, 10), np.linspace(-0.8, 0.8, 6))
    means = np.concatenate([np.stack([x.ravel(), y.ravel(), np.zeros(60)], axis=1), np.zeros((60, 3))])
    means[60:, 2] = np.linspace(0.0, 0.3, 60)
    means[60:, 0] = -1.0
    scales = np.repeat([[0.03] * 3, [0.7, 0.7, 0.002]], 60, axis=0)
    shades = np.repeat([[[-0.6] * 3], [[1.2] * 3]], 60, axis=0)
    g = Gaussians(means, [[1, 0, 0, 0]] * 120, scales, np.repeat([0.95, 0.3], 60), shades)
    camera = Cameras.look_at([[0, 0, -4.0]], [[0, 0, 0]], up=[0, -1, 0], width=64, height=48)
    once = prune(g, camera, (60,), share=0.55)[0]
    chosen = choose_subsets(g, camera, (60,), looks=120.0)[0]
    assert once[60:].sum() < 5
    assert chosen[60:].sum() >= 10
    assert chosen.sum() == 60


def test_subsets_nest_whatever_the_order_of_the_scene() -> None:
    g, cameras = scene("mixed", n=120), views(20)
    calls: list[tuple[str, int, int]] = []
    masks = choose_subsets(g, cameras, (60, 20), looks=30.0, progress=lambda *call: calls.append(call))
    assert [int(mask.sum()) for mask in masks] == [60, 20]
    assert not (masks[1] & ~masks[0]).any()
    assert calls == sorted(calls)
    assert calls[0][1] == 0
    assert calls[-1][1] == calls[-1][2] == 80  # at least 40 for each cut
    turn = np.random.default_rng(1).permutation(120)
    for mask, turned in zip(masks, choose_subsets(g[turn], cameras, (60, 20), looks=30.0), strict=True):
        np.testing.assert_array_equal(mask[turn], turned)


def test_a_space_limits_looks_and_asks_for_more_of_them() -> None:
    """Two halves with a wall between them, seen by cameras on their own side: both keep their share."""
    half = scene("blobs", n=40)
    shift = np.array([6.0, 0.0, 0.0])
    means = np.concatenate([half.means - shift, half.means + shift])
    g = Gaussians(
        means, *(np.concatenate([getattr(half, name)] * 2) for name in vars(half) if name not in ("means", "facts"))
    )
    sides = [Cameras.orbit(side, 3.0, 60, width=40, height=30) for side in (-shift, shift)]
    both = (np.stack([getattr(c, name) for c in sides], axis=1) for name in ("viewmats", "Ks"))  # in turns
    cameras = Cameras(*(each.reshape(-1, *each.shape[2:]) for each in both), 40, 30)
    occupied = np.zeros((48, 20, 20), bool)
    occupied[22:26] = True
    space = NavigableSpace(np.array([-12.0, -5.0, -5.0]), 0.5, ~occupied, np.array([0.0, 0.0, 1.0]), occupied)
    totals = []
    for within in (None, space):
        kept = choose_subsets(
            g, cameras, (20,), looks=60.0, space=within, progress=lambda _, __, total: totals.append(total)
        )[0]
        assert min(kept[:40].sum(), kept[40:].sum()) >= 7
    assert min(totals) == 60
    assert 80 < max(totals) <= 120  # a camera sees about half, or less


def test_in_rooms_what_few_cameras_see_counts_more() -> None:
    """Two equal rooms, one with an eighth of the cameras of the other: it keeps more if they are taken for rooms."""
    half = scene("blobs", n=40)
    shift = np.array([6.0, 0.0, 0.0])
    means = np.concatenate([half.means - shift, half.means + shift])
    g = Gaussians(
        means, *(np.concatenate([getattr(half, name)] * 2) for name in vars(half) if name not in ("means", "facts"))
    )
    sides = [Cameras.orbit(side, 3.0, count, width=40, height=30) for side, count in ((-shift, 64), (shift, 8))]
    order = np.random.default_rng(0).permutation(72)
    both = (np.concatenate([getattr(c, name) for c in sides])[order] for name in ("viewmats", "Ks"))
    cameras = Cameras(*both, 40, 30)
    occupied = np.zeros((48, 20, 20), bool)
    occupied[22:26] = True
    kept = []
    for kind in ("rooms", "open place"):
        where = SpaceKind(kind, "a test")
        space = NavigableSpace(
            np.array([-12.0, -5.0, -5.0]), 0.5, ~occupied, np.array([0.0, 0.0, 1.0]), occupied, kind=where
        )
        kept.append(choose_subsets(g, cameras, (16,), looks=60.0, space=space)[0][40:].sum())
    assert kept[0] > kept[1]


def test_choosing_refuses() -> None:
    g, cameras = scene("blobs", n=20), views(1)
    assert [m.sum() for m in choose_subsets(g, cameras, (20, 20))] == [20, 20]
    assert choose_subsets(g[:0], cameras, ()) == []
    assert [m.tolist() for m in choose_subsets(g[:1], cameras, (1,))] == [[True]]
    for counts in ((5, 10), (21,)):
        with pytest.raises(ValueError, match=r"^counts: expected falling sizes of at most 20, got"):
            choose_subsets(g, cameras, counts)
    with pytest.raises(ValueError, match=r"^counts: expected an integer of at least 1"):
        choose_subsets(g, cameras, (0,))
    with pytest.raises(ValueError, match=r"^cameras: expected at least one to choose by, got none"):
        choose_subsets(g, cameras[:0], (5,))
    with pytest.raises(ValueError, match=r"^looks: expected"):
        choose_subsets(g, cameras, (5,), looks=0.0)


def chosen(work: KeptWork | None, stop_at: int | None = None) -> tuple[list[np.ndarray], list[int]]:
    """Return the masks and the looks reported; raise KeyboardInterrupt when `stop_at` looks are done."""
    calls: list[int] = []

    def report(stage: str, done: int, total: int) -> None:
        calls.append(done)
        if done == stop_at:
            raise KeyboardInterrupt

    g, cameras = scene("mixed", n=150), views(6)
    return choose_subsets(g, cameras, (90, 40), looks=130.0, work=work, progress=report), calls


def test_rounds_that_were_finished_are_not_looked_at_again(tmp_path: Path) -> None:
    """Rounds of at most 100 looks: 100 and 30 before the first cut, then 78; a stopped run loses one round."""
    whole, calls = chosen(None)
    assert max(calls) == 208
    kept = KeptWork(tmp_path, {})
    for at, resumed_at in ((90, 0), (120, 100), (140, 130)):
        with pytest.raises(KeyboardInterrupt):
            chosen(kept, at)
        assert (tmp_path / ROUNDS).exists() == (resumed_at > 0)
    for resumed_at in (130, 208):  # the second time all is kept
        again, calls = chosen(kept)
        assert min(calls) == resumed_at
        for mask, other in zip(whole, again, strict=True):
            np.testing.assert_array_equal(mask, other)
    found = kept.read_own(ROUNDS)
    assert found is not None
    kept.keep_own(ROUNDS, {**found, "values": np.zeros(3)})
    with pytest.raises(FormatError, match=r"rounds\.npz.*delete it to start again"):
        chosen(kept)
