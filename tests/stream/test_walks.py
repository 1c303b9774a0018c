"""Walks over bad links: whatever is lost, however often a client comes back, nothing comes twice, nothing is missed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.policies import POLICIES
from gsvis.abr.predict import exponential
from gsvis.stream import Hello, Receiver, Session, StreamedScene
from gsvis.stream.batch import Sections
from gsvis.stream.session import PIECE
from tests.stream.worlds import greet, package_of

VIEW = FieldOfView.from_degrees(80, 60, margin=8)
FEW = settings(max_examples=12)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, StreamedScene]:
    folder = tmp_path_factory.mktemp("stream")
    made = {}
    for name, variant, stores in (("rgb", "rgb", True), ("hsl", "hsl", True), ("bare", "hsl", False)):
        package = package_of(folder / f"{name}.gsvis", 1200, variant, stores=stores)
        made[name] = StreamedScene.open(package)
    yield made
    for scene in made.values():
        scene.source.close()


@FEW
@given(st.integers(0, 10_000), st.sampled_from(["rgb", "hsl", "bare"]), st.sampled_from(POLICIES))
def test_nothing_is_sent_twice_and_nothing_is_lost(
    scenes: dict[str, StreamedScene], seed: int, variant: str, policy: str
) -> None:
    scene, rng = scenes[variant], np.random.default_rng(seed)
    config, receiver = AbrConfig(policy=policy, start_rate=2e4), Receiver(scene.header)
    place, spin = rng.uniform(-2, 2, 3), rng.normal(0, 0.5, 3)
    gaussians: list[int] = []
    terms: list[int] = []
    session, way, k = greet(scene, receiver, VIEW, config), [], 0
    for k in range(60):
        t = k / 10
        session.on_pose(t, place + rng.normal(0, 0.3, 3), exponential(spin * t))
        message = session.next_message(t, None if rng.random() < 0.5 else float(rng.integers(1000, 6000)))
        if message is not None:
            way.append(message)
        while way and rng.random() < 0.6:
            received = receiver.receive(way.pop(0).data)  # refuses what is there
            gaussians += received.gaussians.tolist()
            terms += received.terms.tolist()
            session.on_ack(t, received.sequence)
        if rng.random() < 0.1:  # the link breaks, and what was on its way is gone
            way = []
            session = greet(scene, receiver, VIEW, config)
    for message in way:
        received = receiver.receive(message.data)
        gaussians += received.gaussians.tolist()
        terms += received.terms.tolist()
        session.on_ack(99.0, received.sequence)
    for n in range(400):  # standing still until all has come
        t = 100.0 + n / 10
        session.on_pose(t, place, exponential(spin))
        message = session.next_message(t, 20_000.0)
        if message is None and session.done:
            break
        assert message is not None
        received = receiver.receive(message.data)
        gaussians += received.gaussians.tolist()
        terms += received.terms.tolist()
        session.on_ack(t, received.sequence)
    assert len(set(gaussians)) == len(gaussians)
    assert len(set(terms)) == len(terms)
    assert sorted(gaussians) == receiver.holdings.received.tolist()
    assert sorted(terms) == receiver.holdings.received_terms.tolist()
    assert receiver.holdings.to_bytes() == session.holdings.to_bytes()
    assert sorted(receiver.shown().tolist()) == receiver.holdings.shown.tolist()
    shown, (drawn, colors) = receiver.shown(), receiver.scene()
    whole = scene.contents.gaussians(shown)
    np.testing.assert_allclose(drawn.means, whole.means, atol=0)
    np.testing.assert_allclose(drawn.sh0, whole.sh0, atol=2e-6)
    held = np.zeros(scene.about.terms, bool)
    held[receiver.holdings.received_terms] = True
    counts = np.add.reduceat(np.append(held, False), scene.contents.term_offsets[:-1])
    counts[scene.contents.term_counts == 0] = 0
    np.testing.assert_array_equal(colors.counts, counts[shown])


@FEW
@given(st.integers(0, 10_000))
def test_a_batch_is_read_on_its_own(scenes: dict[str, StreamedScene], seed: int) -> None:
    scene, rng = scenes["hsl"], np.random.default_rng(seed)
    contents, rows = scene.contents, set()
    session, messages = Session(scene, VIEW), []
    for k in range(10):
        session.on_pose(k / 10, rng.uniform(-2, 2, 3), rng.normal(size=4))
        messages.append(session.next_message(k / 10, float(rng.integers(1024, 9000))))
    for message in [messages[k] for k in rng.permutation(10)]:
        if message is None:
            continue
        found = Sections.parse(message.data, scene.about)
        of = contents.chunks[found.gaussians]
        records = scene.coding.decode_records(found.records, found.gaussians, of, scene.records.chunk_numbers)
        np.testing.assert_array_equal(records, contents.records[found.gaussians])
        terms = scene.coding.decode_terms(found.term_records, found.owners)
        np.testing.assert_array_equal(terms, contents.term_records[found.terms])
        np.testing.assert_array_equal(found.owners, scene.records.owners[found.terms])
        np.testing.assert_array_equal(np.sort(message.batch.gaussians), found.gaussians)
        np.testing.assert_array_equal(np.sort(message.batch.terms), found.terms)
        assert not rows & set(found.chunks.tolist())
        rows |= set(found.chunks.tolist())
    sent = [found for found in messages if found is not None]
    known: set[int] = set()
    for message in sent:  # in order, the row of every chunk is there in time
        found = Sections.parse(message.data, scene.about)
        known |= set(found.chunks.tolist())
        needed = contents.table.starts[np.unique(contents.chunks[found.gaussians])]
        assert set(needed.tolist()) <= known


@FEW
@given(st.integers(0, 10_000), st.floats(1024, 50_000))
def test_messages_are_about_as_large_as_they_should_be(
    scenes: dict[str, StreamedScene], seed: int, budget: float
) -> None:
    scene, rng = scenes["rgb"], np.random.default_rng(seed)
    session = Session(scene, VIEW)
    assert session.next_message(0.0, budget) is None  # no pose yet
    sizes = []
    for k in range(20):
        session.on_pose(k / 10, rng.uniform(-2, 2, 3), rng.normal(size=4))
        assert session.next_message(k / 10, 1000.0) is None
        message = session.next_message(k / 10, budget)
        if message is not None:
            sizes.append(len(message.data))
            assert session.outstanding == sum(sizes) == session.wire_bytes
    assert max(sizes) < 1.6 * budget
    assert np.median(sizes) < 1.1 * budget


def test_a_link_is_filled_in_pieces_and_asked_again_when_it_seems_dead(scenes: dict[str, StreamedScene]) -> None:
    session = Session(scenes["rgb"], VIEW, AbrConfig(start_rate=100e3, window=0.06, begin=0.0))
    session.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
    assert session.room() == 100e3 * session.config.piece
    for piece, room in ((0.055, 100e3 * 0.055), (1e-9, PIECE), (session.config.piece, 100e3 * session.config.piece)):
        session.piece = piece  # a server that is behind sends larger ones
        assert session.room() == pytest.approx(room)
    message = session.next_message(0.0)
    assert message is not None
    assert not session.done
    assert session.room() == 0.0  # what is left of the window is too little: it waits for an acknowledgement
    assert session.next_message(0.0) is None
    session.on_ack(0.06, message.sequence)
    assert session.next_message(0.06) is not None
    dead = Session(scenes["rgb"], VIEW, AbrConfig(start_rate=1.0))
    assert dead.allowance() < 1.0
    assert dead.room() == PIECE


def test_holdings_of_another_scene_are_nothing(scenes: dict[str, StreamedScene]) -> None:
    receiver, session = Receiver(scenes["rgb"].header), Session(scenes["rgb"], VIEW)
    session.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
    message = session.next_message(0.0, 5000.0)
    assert message is not None
    receiver.receive(message.data)
    other = Session.from_hello(scenes["hsl"], receiver.hello(VIEW))
    assert len(other.holdings.received) == 0
    assert not receiver.resume(other.welcome(0.0).data)
    assert receiver.resume(scenes["rgb"].header)
    wrong = Hello(VIEW, bytes.fromhex(scenes["rgb"].about.identity), b"GVH1 of something else")
    with pytest.raises(ValueError, match=r"^data: expected"):
        Session.from_hello(scenes["rgb"], wrong)
