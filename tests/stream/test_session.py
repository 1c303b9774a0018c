"""The session of a viewer: what may be in flight, and what the link is measured to carry."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.pvs.codec import ids_of
from gsvis.stream import Session, StreamedScene
from gsvis.stream.session import PIECE
from gsvis.stream.source import class_weights
from tests.stream.worlds import package_of

VIEW = FieldOfView.from_degrees(80, 60, margin=8)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> StreamedScene:
    with package_of(tmp_path_factory.mktemp("session") / "s.gsvis", 1200) as package:
        yield StreamedScene.open(package)


@pytest.mark.parametrize(("piece", "seconds"), [(0.01, 0.3), (0.05, 0.3), (0.1, 0.3), (0.2, 0.4), (0.5, 1.0)])
def test_longer_messages_have_room_for_two(scene: StreamedScene, piece: float, seconds: float) -> None:
    session = Session(scene, VIEW, AbrConfig(start_rate=1e6, window=0.3, piece=0.05))
    session.piece = piece
    assert session.allowance() == pytest.approx(1e6 * seconds)


def test_what_is_in_flight_is_bounded_by_the_window(scene: StreamedScene) -> None:
    session = Session(scene, VIEW, AbrConfig(start_rate=1e4, window=0.9))
    session.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
    assert session.allowance() == 9e3
    assert session.record_rate == 1e4
    message = session.next_message(0.0, 5000.0)
    assert message is not None
    assert session.outstanding == session.wire_bytes == len(message.data)
    assert session.record_bytes == message.batch.bytes
    assert session.allowance() == 9e3 - len(message.data)
    assert session.record_rate == pytest.approx(1e4 * message.batch.bytes / len(message.data))
    first = len(message.data)
    session.on_ack(0.0, message.sequence)  # at once: its bytes count with the next transfer
    assert (session.outstanding, session.rate) == (0, 1e4)
    message = session.next_message(1.0, 8000.0)
    assert message is not None
    session.on_ack(1.5, message.sequence)
    assert session.outstanding == 0
    assert session.rate == pytest.approx((first + len(message.data)) / 0.5)
    session.on_ack(1.6, message.sequence)  # repeated
    assert session.rate == pytest.approx((first + len(message.data)) / 0.5)
    with pytest.raises(ValueError, match=r"^sequence: expected at most 2, got 3"):
        session.on_ack(1.7, 3)


@pytest.mark.parametrize("planning", [0.0, 0.04, 3.0])
def test_planning_is_no_time_of_the_link(scene: StreamedScene, planning: float) -> None:
    session = Session(scene, VIEW, AbrConfig(start_rate=1e6))
    session.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
    message = session.next_message(0.0, 9000.0, sent_at=lambda: planning)
    assert message is not None
    session.on_ack(planning + 0.5, message.sequence)
    assert session.rate == pytest.approx(len(message.data) / 0.5)


@pytest.mark.parametrize("begin", [0.0, 12e3])
def test_the_first_messages_are_small(scene: StreamedScene, begin: float) -> None:
    session = Session(scene, VIEW, AbrConfig(start_rate=1e6, window=1.0, begin=begin))
    session.welcome(0.0)
    session.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
    small = 0
    while session.wire_bytes < begin:
        assert session.room() == max(PIECE, 0.25 * session.wire_bytes)
        message = session.next_message(0.0)
        assert message is not None
        small += 1
    assert small == (0 if begin == 0 else 1 + (begin - len(session.scene.header) - 1) // PIECE)
    assert session.room() == 1e6 * session.piece


def test_candidates_are_what_the_cell_and_its_neighbors_see(scene: StreamedScene) -> None:
    sets = scene.source.package.visibility
    for cell in range(len(sets)):
        found = scene.candidates.in_cell(cell)
        around = [cell, *sets.grid.neighbors(cell).tolist()]
        assert np.array_equal(ids_of(found.union), np.array(sets.union(around).to_array()))
        assert np.array_equal(ids_of(found.active), np.arange(scene.about.terms))  # which are, is tested for the eye


def test_one_cache_holds_all_that_is_decoded(scene: StreamedScene) -> None:
    scene.candidates.in_cell(0)
    scene.candidates.seen.of_cell(0)
    cache = scene.candidates.cache
    assert scene.index.sets.whole_store.cache is cache
    kinds = {key[0] for key in cache._values}
    assert kinds >= {"candidates", "words", "set", "classes"}
    assert kinds <= {"candidates", "words", "set", "classes", "order"}  # the last for viewers outside of cells
    assert cache.nbytes <= cache.max_bytes


def test_viewers_of_one_cell_share_its_candidates_in_a_cache_without_room(scene: StreamedScene) -> None:
    small = StreamedScene.open(scene.source, max_cache_bytes=0)
    assert small.candidates.in_cell(0) is small.candidates.in_cell(0)
    assert len(small.candidates.cache) == 1


def test_classes_stand_for_the_mean_of_their_ends(scene: StreamedScene) -> None:
    sets = scene.source.package.visibility
    ends = [*sets.info.class_edges.tolist(), 1.0]
    expected = [np.sqrt(low * high) for low, high in pairwise(ends)]
    assert class_weights(sets) == pytest.approx(expected, rel=1e-5)
    assert scene.index.class_weights == pytest.approx(expected, rel=1e-5)
