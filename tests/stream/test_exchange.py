"""A session and a receiver: what comes is what the package holds, nothing comes twice, nothing is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.abr.classes import FieldOfView
from gsvis.abr.predict import exponential
from gsvis.color.evaluate import evaluate
from gsvis.stream import Receiver, Session, StreamedScene, parse_client
from gsvis.stream.wire import Hello
from tests.stream.worlds import package_of

VIEW = FieldOfView.from_degrees(80, 60, margin=8)


def walked(session: Session, receiver: Receiver, seed: int, ticks: int, budget: float | None = 3000.0) -> int:
    rng = np.random.default_rng(seed)
    place, spin = rng.uniform(-2, 2, 3), rng.normal(0, 0.5, 3)
    total = 0
    for k in range(ticks):
        t = k / 10
        session.on_pose(t, place + 0.1 * k, exponential(spin * k / 10))
        message = session.next_message(t, budget)
        if message is None:
            continue
        received = receiver.receive(message.data)  # refuses what is there
        assert received.sequence == message.sequence
        assert np.array_equal(np.sort(message.batch.gaussians), received.gaussians)
        assert np.array_equal(np.sort(message.batch.terms), received.terms)
        assert np.array_equal(np.sort(message.batch.dropped), received.dropped)
        session.on_ack(t + 0.05, received.sequence)
        total += received.nbytes
    return total


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@pytest.mark.parametrize("stores", [True, False])
def test_what_comes_is_what_the_package_holds(tmp_path: Path, variant: str, stores: bool) -> None:
    with package_of(tmp_path / "s.gsvis", variant=variant, stores=stores) as package:
        scene = StreamedScene.open(package)
        session, receiver = Session(scene, VIEW), Receiver(scene.header)
        assert receiver.about == scene.about
        walked(session, receiver, 1, 30)
        half = Receiver(scene.header)
        assert receiver.holdings.to_bytes() == session.holdings.to_bytes() != half.holdings.to_bytes()
        shown = receiver.shown()
        assert np.array_equal(np.sort(shown), receiver.holdings.shown)
        g, colors = receiver.scene()
        whole = package.contents.gaussians(shown)
        for name in ("means", "quats", "scales", "opacities"):
            np.testing.assert_array_equal(getattr(g, name), getattr(whole, name))
        active = np.zeros(scene.about.terms, bool)
        active[receiver.holdings.received_terms] = True
        every, eye = package.contents.colors().dequantize(), np.array([0.3, -0.2, 0.1])
        wanted = evaluate(every, package.contents.gaussians().means, eye, active=active)[shown]
        np.testing.assert_allclose(evaluate(colors, g.means, eye), wanted, atol=2e-6)


@pytest.mark.parametrize("seed", range(3))
def test_a_client_that_comes_back_loses_and_repeats_nothing(tmp_path: Path, seed: int) -> None:
    with package_of(tmp_path / "s.gsvis", 1500, variant="hsl", seed=seed) as package:
        scene = StreamedScene.open(package)
        receiver = Receiver(scene.header)
        walked(Session(scene, VIEW), receiver, seed, 4)
        lost = Session.from_hello(scene, parse_client(receiver.hello(VIEW).to_bytes()))
        lost.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
        assert lost.next_message(0.0, 2000.0) is not None  # never arrives
        hello = parse_client(receiver.hello(VIEW).to_bytes(), most_hello=scene.most_hello)
        assert isinstance(hello, Hello)
        session = Session.from_hello(scene, hello)
        assert receiver.resume(session.welcome(0.0).data)
        walked(session, receiver, seed + 1, 40)
        assert receiver.holdings.to_bytes() == session.holdings.to_bytes()
