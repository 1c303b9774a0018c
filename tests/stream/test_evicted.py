"""A client with little memory over a link that breaks: server and client agree on what is held, and what is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.policies import POLICIES
from gsvis.errors import ProtocolError
from gsvis.package.layout import RECORD_BYTES
from gsvis.stream import Receiver, Session, StreamedScene
from gsvis.stream.batch import Sections
from tests.stream.worlds import greet, package_of

VIEW = FieldOfView.from_degrees(70, 50, margin=5)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, StreamedScene]:
    folder = tmp_path_factory.mktemp("evicted")
    made = {v: StreamedScene.open(package_of(folder / f"{v}.gsvis", 1200, v)) for v in ("rgb", "hsl")}
    yield made
    for scene in made.values():
        scene.source.close()


def held_bytes(scene: StreamedScene, receiver: Receiver) -> float:
    _, colors = receiver.scene()
    return RECORD_BYTES * len(receiver.shown()) + scene.about.term_bits / 8 * int(colors.counts.sum())


def is_as_packaged(scene: StreamedScene, receiver: Receiver) -> None:
    shown, (drawn, colors) = receiver.shown(), receiver.scene()
    assert sorted(shown.tolist()) == receiver.holdings.shown.tolist()
    np.testing.assert_array_equal(drawn.means, scene.contents.gaussians(shown).means)
    held = np.zeros(scene.about.terms, bool)
    held[receiver.holdings.received_terms] = True
    counts = np.add.reduceat(np.append(held, False), scene.contents.term_offsets[:-1])
    counts[scene.contents.term_counts == 0] = 0
    np.testing.assert_array_equal(colors.counts, counts[shown])


@settings(max_examples=12)
@given(st.integers(0, 10_000), st.sampled_from(["rgb", "hsl"]), st.sampled_from(POLICIES), st.floats(0.02, 0.6))
def test_a_client_with_little_memory_agrees_with_its_server(
    scenes: dict[str, StreamedScene], seed: int, variant: str, policy: str, share: float
) -> None:
    scene, rng = scenes[variant], np.random.default_rng(seed)
    memory = int(share * (RECORD_BYTES * scene.about.gaussians + scene.about.term_bits / 8 * scene.about.terms))
    config, receiver = AbrConfig(policy=policy, start_rate=1e5), Receiver(scene.header, memory=memory)
    centers = scene.index.grid.centers
    session, evicted, sent = greet(scene, receiver, VIEW, config), 0, 0
    for k in range(80):
        t = k / 10
        if k % 8 == 0:
            place, spin = centers[rng.integers(len(centers))], rng.normal(size=4)
        session.on_pose(t, place + rng.normal(0, 0.05, 3), spin)
        message = session.next_message(t, float(rng.integers(1500, 12_000)))
        if message is None:
            continue
        if rng.random() < 0.1:  # the link breaks, and the message is lost
            session = greet(scene, receiver, VIEW, config)
            continue
        received = receiver.receive(message.data)
        session.on_ack(t, received.sequence)
        evicted, sent = evicted + len(message.batch.evicted), sent + len(message.batch)
        assert held_bytes(scene, receiver) <= memory * (1 + 1e-6)
        assert np.isin(message.batch.evicted, receiver.shown(), invert=True).all()
    assert sent > 0
    assert receiver.holdings.to_bytes() == session.holdings.to_bytes()
    is_as_packaged(scene, receiver)


def test_memory_is_what_makes_a_server_evict(scenes: dict[str, StreamedScene]) -> None:
    scene = scenes["rgb"]
    for memory, expected in ((0, False), (6000, True)):
        receiver = Receiver(scene.header, memory=memory)
        session, evicted = greet(scene, receiver, VIEW), 0
        for k in range(60):
            session.on_pose(k / 10, scene.index.grid.centers[k // 10 % len(scene.index.grid)], [1.0, 0.0, k % 7, 0.0])
            message = session.next_message(k / 10, 3000.0)
            if message is not None:
                session.on_ack(k / 10, receiver.receive(message.data).sequence)
                evicted += len(message.batch.evicted)
        assert bool(evicted) is expected


def test_a_batch_that_evicts_what_the_client_does_not_have_changes_nothing(scenes: dict[str, StreamedScene]) -> None:
    scene = scenes["rgb"]
    receiver, session = Receiver(scene.header, memory=1 << 20), Session(scene, VIEW)
    session.welcome(0.0)
    session.on_pose(0.0, scene.index.grid.centers[0], [1, 0, 0, 0])
    message = session.next_message(0.0, 3000.0)
    assert message is not None
    never = np.setdiff1d(np.arange(scene.about.gaussians), message.batch.gaussians)[:3]
    changed = replace(Sections.parse(message.data, scene.about), evicted=never).to_message(scene.about)
    before = receiver.holdings.to_bytes()
    with pytest.raises(ProtocolError, match="expected ids that are held, got"):
        receiver.receive(changed)
    assert receiver.holdings.to_bytes() == before
    receiver.receive(message.data)
