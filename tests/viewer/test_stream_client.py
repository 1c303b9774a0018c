"""The client of the viewer, run by node, against a real server: it holds and draws what the Python client does."""

from __future__ import annotations

import copy
import json
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyroaring import BitMap
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import ServerConnection, serve

from gsvis.abr.config import AbrConfig
from gsvis.color.evaluate import evaluate
from gsvis.package import Package
from gsvis.package.layout import TermLayout
from gsvis.stream import Hello, Receiver, StreamedScene, parse_client
from tests import warm_start
from tests.serve.servers import PATIENCE, VIEW, patient, serving, slow_link, until
from tests.stream.worlds import package_of
from tests.viewer.bundles import NEEDS_NODE, bundle

EYE = (0.25, -1.5, 0.5)
pytestmark = NEEDS_NODE


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bundle("client", tmp_path_factory.mktemp("client"))


@pytest.fixture(scope="module", params=["rgb", "hsl"])
def package(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer") / "scene.gsvis"
    package_of(folder, 4000, request.param, stores=False).close()
    return folder


class Client:
    """The client in node, and what it has said."""

    def __init__(self, program: Path, url: str, out: Path, *more: str) -> None:
        command = ["node", "--experimental-websocket", "--no-warnings", str(program), "stream", url, str(out), *more]
        self._out, self.events = out, list[dict[str, Any]]()
        self._running = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def _listen(self) -> None:
        assert self._running.stdout is not None
        for line in self._running.stdout:
            self.events.append(json.loads(line))

    def of(self, event: str) -> list[dict[str, Any]]:
        return [said for said in list(self.events) if said["event"] == event]

    @property
    def state(self) -> dict[str, Any]:
        return (self.of("state") or [{"kind": "none"}])[-1]

    @property
    def held(self) -> int:
        return int((self.of("batch") or [{"held": 0}])[-1]["held"])

    def wait(self, fact: Callable[[], bool]) -> None:
        """Wait for a fact; a client that has given up or ended says why at once."""

        def comes() -> bool:
            assert self.state["kind"] != "failed", self.events[-5:]
            assert self._running.poll() is None, self.events[-5:]
            return fact()

        try:
            until(comes)
        except AssertionError as error:
            raise AssertionError(f"{error}; it said at last {self.events[-20:]}") from error

    def say(self, line: str) -> None:
        assert self._running.stdin is not None
        self._running.stdin.write(f"{line}\n")
        self._running.stdin.flush()

    def end(self) -> dict[str, np.ndarray]:
        """End it and return what it drew."""
        self.say("end")
        assert self._running.wait(PATIENCE) == 0
        self._listener.join(PATIENCE)
        return {name: np.array(values) for name, values in json.loads(self._out.read_text()).items()}

    def close(self) -> None:
        self._running.kill()
        self._running.wait()
        for pipe in (self._running.stdin, self._running.stdout):
            if pipe is not None:
                pipe.close()


@contextmanager
def client_of(program: Path, url: str, folder: Path, *more: str) -> Iterator[Client]:
    client = Client(program, url, folder / "drawn.json", *more)
    try:
        yield client
    finally:
        client.close()


def assert_same(drawn: dict[str, np.ndarray], receiver: Receiver | None) -> None:
    """The client in node draws what a Python client does."""
    assert receiver is not None
    gaussians, colors = receiver.scene()
    order = np.argsort(receiver.shown())
    assert drawn["ids"].tolist() == receiver.shown()[order].tolist()
    assert drawn["terms"].tolist() == colors.counts[order].tolist()
    expected = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities")}
    for name, values in (expected | {"rgb": evaluate(colors, gaussians.means, EYE)}).items():
        np.testing.assert_allclose(drawn[name], values[order], rtol=2e-6, atol=2e-6, err_msg=name)


def test_it_draws_what_the_python_client_draws(package: Path, program: Path, tmp_path: Path) -> None:
    with serving(package) as server:
        other, _ = patient(server.url, package)
        with client_of(program, server.url, tmp_path) as client:
            client.wait(lambda: client.state["kind"] == "complete")
            assert_same(client.end(), other.receiver)
            until(lambda: server.metrics.closed.value("left") == 2)
        assert [said["fresh"] for said in client.of("header")] == [True]


def test_with_little_memory_it_forgets_what_is_evicted_and_takes_it_again(
    package: Path, program: Path, tmp_path: Path
) -> None:
    with Package.open(package) as opened:
        contents = opened.contents
    width = TermLayout.from_grids(contents.grids).widths.sum() / 8
    memory = int(0.3 * (16 * len(contents) + width * len(contents.term_records)))
    with serving(package) as server, client_of(program, server.url, tmp_path, "", str(memory)) as client:
        client.say("pose -2.5 0 1.5")
        until(lambda: client.state["kind"] == "complete")
        client.say("pose 2.5 0 1.5")
        until(lambda: 16 * client.held > memory)  # more came than there is room for
        drawn = client.end()
        until(lambda: server.metrics.closed.value("left") == 1)
    ids, counts = drawn["ids"], drawn["terms"]
    assert len(set(ids.tolist())) == len(ids)
    assert 16 * len(ids) + width * counts.sum() <= memory
    assert drawn["came"] > len(ids)  # some came, and went
    assert (counts <= contents.term_counts[ids]).all()
    np.testing.assert_allclose(drawn["means"], contents.gaussians(ids).means, rtol=2e-6, atol=2e-6)


@pytest.mark.slow
def test_after_a_kill_it_comes_back_with_what_it_holds(program: Path, tmp_path: Path) -> None:
    port, log, package = _free_port(), tmp_path / "log", tmp_path / "scene.gsvis"
    with package_of(package, 16_000, stores=False) as opened:  # more than sockets hold of it when the link stalls
        first = len(StreamedScene.open(opened).header)
    part = first + 90_000  # a batch or more, also of a late server, whose batches are four times as long: about 50 kB
    with (
        slow_link(f"ws://127.0.0.1:{port}/stream", 100_000.0, part) as link,
        client_of(program, link.url, tmp_path) as client,
    ):
        until(lambda: client.state["kind"] == "waiting")  # nobody is there yet
        assert "does not answer" in client.state["message"]
        with _served(package, port, tmp_path / "first"):
            until(lambda: client.held > 500 and link.is_stalled)  # it holds a part of the scene
        link.go_on()
        client.wait(lambda: client.state["kind"] in ("waiting", "connecting"))
        held = client.held
        link.carry_freely()
        with _served(package, port, log), serving(package) as beside:
            other, _ = patient(beside.url, package)
            client.wait(lambda: client.state["kind"] == "complete")
            drawn = client.end()
    assert 500 < held < drawn["came"]
    assert_same(drawn, other.receiver)
    assert [said["fresh"] for said in client.of("header")] == [True, False]
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [said["held"] for said in lines if said["event"] == "opened"] == [held]


def test_a_token_goes_as_the_first_message_and_refusals_have_their_words(
    package: Path, program: Path, tmp_path: Path
) -> None:
    with serving(package, token="correct") as server:
        with client_of(program, server.url, tmp_path, "correct") as client:
            until(lambda: client.held > 0)
        for path, more, words in (
            ("", ("wrong",), "a token is needed"),
            ("", (), "a token is needed"),
            ("/elsewhere", ("correct",), "no such scene"),
        ):
            with client_of(program, server.url + path, tmp_path, *more) as client:
                until(lambda: client.state["kind"] == "failed")
                assert (client.state["code"], words in client.state["message"]) == (4, True)
                assert [said["kind"] for said in client.of("state")] == ["connecting", "failed"]


class Talk:
    """What client and server said on one connection."""

    def __init__(self) -> None:
        self.hello: Hello | None = None
        self.said: list[bytes] = []


class Tee:
    """Between a client and a server: keeps what they said on each connection, and cuts the first ones."""

    def __init__(self, url: str, cuts: list[int]) -> None:
        self._url, self.cuts = url, cuts
        self.talks: list[Talk] = []
        self._listener = serve(self._carry, "127.0.0.1", 0, compression=None, ping_interval=None)
        self.url = f"ws://127.0.0.1:{self._listener.socket.getsockname()[1]}"
        threading.Thread(target=self._listener.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._listener.shutdown()

    def _carry(self, near: ServerConnection) -> None:
        talk = Talk()
        left = 1 << 60
        with connect(self._url, compression=None, proxy=None, ping_interval=None, open_timeout=PATIENCE) as far:

            def up() -> None:
                with suppress(ConnectionClosed):
                    for data in near:
                        assert isinstance(data, bytes)
                        if data[0] == 1:
                            found = parse_client(data)
                            assert isinstance(found, Hello)
                            talk.hello = found
                        far.send(data)
                with suppress(ConnectionClosed):
                    far.close()

            self.talks.append(talk)
            threading.Thread(target=up, daemon=True).start()
            with suppress(ConnectionClosed):
                for data in far:
                    assert isinstance(data, bytes)
                    if not talk.said and self.cuts:  # a connection that breaks before WELCOME uses no cut
                        left = self.cuts.pop(0)
                    left -= len(data)
                    if left < 0:
                        near.socket.shutdown(socket.SHUT_RDWR)
                        break
                    talk.said.append(data)
                    near.send(data)


def test_it_holds_what_the_python_receiver_holds_after_the_same_messages(program: Path, tmp_path: Path) -> None:
    """Over a walk through cells, with four breaks of the connection."""
    folder = tmp_path / "celled.gsvis"
    with package_of(folder, 4000, "hsl") as package:
        first = len(StreamedScene.open(package).header)
    with (
        serving(folder, abr=AbrConfig(policy="low-first", start_rate=1000.0, horizon=0.1)) as server,
        slow_link(server.url, 30_000.0) as link,
    ):
        tee = Tee(link.url, [first + more for more in (6000, 9000, 6000, 9000)])
        with client_of(program, tee.url, tmp_path) as client:
            for k in range(12):
                heard = server.metrics.received.value("PoseAt")
                client.say(f"pose {k / 4 - 1.5} {k % 3 / 2 - 0.5} 0.2")
                client.wait(partial(_is_above, heard, lambda: server.metrics.received.value("PoseAt")))
            client.wait(lambda: not tee.cuts and client.state["kind"] == "complete")
            drawn = client.end()
        tee.close()
    states: dict[bytes, Receiver | None] = {b"": None}
    receiver: Receiver | None = None
    talks = [talk for talk in tee.talks if talk.said]  # a connection may break before WELCOME
    assert len(talks) >= 4
    came = [said["event"] for said in client.events if said["event"] in ("header", "batch")]
    del talks[-1].said[came[::-1].index("header") + 1 :]  # on a busy machine it ends while more is on its way
    for talk in talks:
        hello, (welcome, *batches) = talk.hello, talk.said
        assert hello is not None
        receiver = states[hello.holdings] or Receiver(welcome)  # the last messages before a break may not have arrived
        assert receiver.resume(welcome)
        states = {receiver.hello(VIEW).holdings: copy.deepcopy(receiver)}
        for batch in batches:
            receiver.receive(batch)
            states[receiver.hello(VIEW).holdings] = copy.deepcopy(receiver)
    assert_same(drawn, receiver)
    assert drawn["came"] > len(drawn["ids"])  # some were replaced


def test_bitmaps_are_those_of_the_reference_library(program: Path) -> None:
    rng = np.random.default_rng(3)
    sets: list[np.ndarray] = [np.zeros(0, np.int64), np.array([0]), np.arange(70_000), np.array([2**28 - 1])]
    for k in range(60):
        size, runs = int(rng.integers(1, 300_000)), int(rng.integers(1, 60))
        edges = np.sort(rng.integers(0, size + 1, 2 * runs)).reshape(-1, 2)
        spread = rng.choice(size, int(size * rng.random() ** (1 + k % 8)), replace=False)
        parts = [np.arange(low, high) for low, high in edges.tolist()] if k % 3 else []
        sets.append(np.unique(np.concatenate([spread if k % 2 else spread[:50], *parts])))
    for entries in (2, 3, 4, 5, 4094, 4095, 4096, 4097, 8194):  # where containers change their kind
        sets += [np.arange(0, 2 * entries, 2), np.arange(entries), np.concatenate([[0], np.arange(2, entries + 1)])]
        sets += [np.unique(np.arange(entries) * 3 // 2), np.unique(np.arange(entries) * 5 // 4)]
    for runs in (2046, 2047, 2048, 2049):  # where runs are as long as a bitmap
        sets += [np.concatenate([np.arange(30 * k, 30 * k + 29) for k in range(runs)])]
    lines = "".join(json.dumps(ids.tolist()) + "\n" for ids in sets)
    ran = subprocess.run(
        ["node", str(program), "bitmaps"], input=lines, capture_output=True, text=True, check=True, timeout=PATIENCE
    )
    for ids, found in zip(sets, ran.stdout.split("\n"), strict=False):
        bitmap = BitMap(ids.tolist())
        bitmap.run_optimize()
        assert BitMap.deserialize(bytes.fromhex(found)) == bitmap, f"{len(ids)} ids"
        # Versions of the library differ where an array is as long as runs: then a header has 8 bytes more.
        assert len(found) // 2 <= len(bitmap.serialize()) + 8, f"{len(ids)} ids"


def _is_above(before: float, value: Callable[[], float]) -> bool:
    return value() > before


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])


@contextmanager
def _served(package: Path, port: int, log: Path) -> Iterator[None]:
    """`gsvis serve`, killed at the end."""
    command = [sys.executable, "-m", "gsvis", "serve", str(package), "--port", str(port), "--log-format", "json"]
    with log.open("w") as lines:
        running = warm_start.Popen(command, stderr=lines, stdout=subprocess.DEVNULL)
        try:
            _until_listening(port, lambda: running.poll() is None)
            yield
        finally:
            running.kill()
            running.wait()


def _until_listening(port: int, is_alive: Callable[[], bool]) -> None:
    def is_listening() -> bool:
        assert is_alive()
        with suppress(OSError):
            socket.create_connection(("127.0.0.1", port), timeout=PATIENCE).close()
            return True
        return False

    until(is_listening)
