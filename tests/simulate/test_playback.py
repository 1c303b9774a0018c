"""Deliveries over links: what arrives is what was sent, once, and when the link says."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from gsvis.abr import POLICIES, AbrConfig, BandwidthTrace
from gsvis.simulate import Adaptive, Link, MortonProgressive, Playback, WholeFile, morton_order, play
from gsvis.stream import Receiver, StreamedScene
from tests.simulate.streets import QUICK, street, walk

SLOW = Link(BandwidthTrace.constant(0.05), 0.04)  # 6,250 bytes a second
FAST = Link(BandwidthTrace.constant(50.0), 0.04)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StreamedScene]:
    made = street(tmp_path_factory.mktemp("street"))[0]
    with made.source:
        yield made


def adaptive(scene: StreamedScene, policy: str = "utility") -> Adaptive:
    return Adaptive(scene, QUICK.view, AbrConfig(policy=policy, start_rate=5e3))


def size_of(scene: StreamedScene) -> tuple[int, int]:
    return len(scene.contents), len(scene.contents.term_records)


@pytest.mark.parametrize("policy", POLICIES)
def test_nothing_is_sent_twice_and_the_link_is_never_overrun(scene: StreamedScene, policy: str) -> None:
    p = play(adaptive(scene, policy), SLOW, walk(), size_of(scene), seconds=4.0)
    assert p.twice == 0
    assert np.isfinite(p.gaussian_at).any()
    for t in (0.5, 1.0, 3.0):
        assert p.bytes_at(t) <= 6250.0 * t
    assert np.all(np.diff(p.times) >= 0)


def test_terms_of_the_paper_are_those_that_are_active_in_cells(scene: StreamedScene) -> None:
    by_cell = scene.sending("cell")
    assert by_cell.index.cones is None
    assert scene.sending("pose") is scene
    assert by_cell.sending("cell") is by_cell
    abr = AbrConfig(policy="fov-first", fill=False)
    p = play(Adaptive(by_cell, QUICK.view, abr), FAST, walk(), size_of(scene), seconds=4.0)
    active = scene.index.active
    assert active is not None
    ever = np.unique(np.concatenate([active.active_ids(cell) for cell in range(len(scene.index.grid))]))
    arrived = np.flatnonzero(np.isfinite(p.term_at))
    assert len(arrived)
    assert np.isin(arrived, ever).all()
    by_pose = play(Adaptive(scene, QUICK.view, abr), FAST, walk(), size_of(scene), seconds=4.0)
    assert not np.array_equal(np.flatnonzero(np.isfinite(by_pose.term_at)), arrived)
    with pytest.raises(ValueError, match="terms: expected one of"):
        scene.sending("all")


def test_a_receiver_of_the_same_bytes_shows_what_the_playback_says(scene: StreamedScene) -> None:
    receiver = Receiver(scene.header)
    delivery = Adaptive(scene, QUICK.view, AbrConfig(start_rate=5e3))
    sent = delivery.session.next_message
    received: list[bytes] = []

    def kept(t: float, budget: float | None = None):  # type: ignore[no-untyped-def]
        message = sent(t, budget)
        if message is not None:
            received.append(message.data)
        return message

    delivery.session.next_message = kept  # type: ignore[method-assign]
    p = play(delivery, FAST, walk(), size_of(scene), seconds=3.0)
    count = len(p.sizes) - 1  # without WELCOME
    for data in received[:count]:
        receiver.receive(data)
    assert p.sizes[0] == len(scene.header)
    assert p.sizes[1:].tolist() == [len(data) for data in received[:count]]
    shown = np.flatnonzero((p.gaussian_at <= 3.0) & ~(p.gone_at <= 3.0))
    assert np.array_equal(np.sort(receiver.shown()), shown)
    assert np.array_equal(receiver.holdings.received_terms, np.flatnonzero(p.term_at <= 3.0))


def test_a_whole_file_shows_nothing_until_all_of_it_is_there(scene: StreamedScene) -> None:
    p = play(WholeFile(scene.contents, 100_000), Link(BandwidthTrace.constant(0.8), 0.1), walk(), size_of(scene))
    assert p.first == pytest.approx(0.1 + 1.0, abs=1e-6)  # the request travels, too
    highest = scene.contents.last == len(scene.contents.names) - 1
    assert np.array_equal(np.isfinite(p.gaussian_at), highest)
    assert set(p.gaussian_at[highest]) == {np.float32(p.first)}
    assert p.bytes_at(0.6) < 60_000
    assert p.bytes_at(p.first) == 100_000
    assert p.exact


def test_morton_order_sends_the_highest_level_with_its_terms(scene: StreamedScene) -> None:
    contents = scene.contents
    p = play(MortonProgressive(contents), SLOW, walk(), size_of(scene), seconds=60.0)
    highest = contents.last == len(contents.names) - 1
    terms = np.repeat(highest, contents.term_counts)
    assert np.array_equal(np.isfinite(p.gaussian_at), highest)
    assert np.array_equal(np.isfinite(p.term_at), terms)
    owners = np.repeat(np.arange(len(contents)), contents.term_counts)
    assert np.array_equal(p.term_at[terms], p.gaussian_at[owners][terms])
    expected = 16 * highest.sum() + contents.term_records.shape[1] * terms.sum()
    assert p.sizes.sum() == expected
    assert p.twice == 0


def test_a_curve_visits_neighbors_together() -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    order = morton_order(grid)
    assert np.array_equal(np.sort(order), np.arange(512))
    steps = np.linalg.norm(np.diff(grid[order], axis=0), axis=1)
    shuffled = np.random.default_rng(0).permutation(grid)
    assert steps.mean() < 0.5 * np.linalg.norm(np.diff(shuffled, axis=0), axis=1).mean()


def test_the_same_session_gives_the_same_arrivals(scene: StreamedScene) -> None:
    def again() -> Playback:
        return play(adaptive(scene), SLOW, walk(), size_of(scene), seconds=2.0)

    first, second = again(), again()
    assert np.array_equal(first.gaussian_at, second.gaussian_at)
    assert np.array_equal(first.times, second.times)


def test_a_link_that_stalls_is_used_again(scene: StreamedScene) -> None:
    stalled = Link(BandwidthTrace([0.5, 5.5, 10.0], [0.03, 0.0, 0.03]), 0.04)
    p = play(adaptive(scene), stalled, walk(), size_of(scene), seconds=8.0)
    assert p.bytes_at(8.0) - p.bytes_at(5.5) > 0.5 * 2.5 * 3750.0
    assert p.twice == 0


def test_a_faster_link_has_everything_sooner(scene: StreamedScene) -> None:
    slow, fast = (play(MortonProgressive(scene.contents), link, walk(), size_of(scene)) for link in (SLOW, FAST))
    assert np.all(fast.gaussian_at <= slow.gaussian_at)


@pytest.mark.parametrize(("seconds", "tick"), [(0.0, 0.1), (1.0, 0.0), (np.nan, 0.1)])
def test_times_out_of_range_are_refused(scene: StreamedScene, seconds: float, tick: float) -> None:
    with pytest.raises(ValueError, match="expected seconds > 0"):
        play(adaptive(scene), FAST, walk(), size_of(scene), seconds=seconds, tick=tick)
