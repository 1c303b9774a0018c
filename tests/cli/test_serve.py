"""`gsvis serve` as a process: it says where it is, ends well, and what kills it costs a client nothing but time."""

from __future__ import annotations

import asyncio
import gc
import json
import logging
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from gsvis.cli import main
from gsvis.serve import ClientConfig, ManualClock, Server, StreamClient
from gsvis.stream import Hello
from tests import warm_start
from tests.serve.certificates import certificate
from tests.serve.servers import PATIENCE, VIEW, give_up, has_all, patient, slow_link, still
from tests.stream.worlds import package_of

PLAIN = {**os.environ, "PYTHONWARNINGS": "error", "GSVIS_DEBUG": ""}
PLAIN.pop("GSVIS_TOKEN", None)
PATIENT = ("--handshake", "86400", "--idle", "86400", "--stall", "86400")  # no time decides


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("served") / "room.gsvis"
    package_of(folder, 6000, stores=False).close()
    return folder


@contextmanager
def process(
    *arguments: object, start: type[subprocess.Popen[str]] = warm_start.Popen, **environment: str
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A server and its address."""
    command = [sys.executable, "-m", "gsvis", "serve", *map(str, arguments), *PATIENT, "--json"]
    running = start(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=PLAIN | environment)
    try:
        assert running.stdout is not None
        text = ""
        while not text.endswith("}\n"):
            line = running.stdout.readline()
            assert line, running.stderr.read() if running.stderr else ""
            text += line
        yield running, json.loads(text)["url"]
    finally:
        running.kill()
        running.communicate()


@pytest.fixture
def failed(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs the command here, where it has to fail; what it says."""

    def run(*arguments: object) -> str:
        assert main(["serve", *map(str, arguments)]) == 2
        return capsys.readouterr().err

    return run


def test_it_says_where_it_is_and_ends_well(package: Path) -> None:
    with process(package, "--port", 0, start=subprocess.Popen, GSVIS_TOKEN="word-of-mouth") as (running, url):
        assert url.startswith("ws://127.0.0.1:")
        client, _ = patient(url, package, config=ClientConfig(token="word-of-mouth"))
        assert has_all(client.receiver, package)
        running.send_signal(signal.SIGTERM)
        _, said = running.communicate(timeout=PATIENCE)
    assert running.returncode == 0
    assert "word-of-mouth" not in said
    assert f"page=http://{url.removeprefix('ws://').partition('/')[0]}/view/room" in said
    for event in ("ready scene=room", "listening url=ws://127.0.0.1", "opened client=1", "closed client=1", "stopped"):
        assert event in said
    assert all(line[:4].isdecimal() and " INFO " in line for line in said.splitlines()), said


def test_a_log_of_objects(package: Path) -> None:
    with process(package, "--port", 0, "--log-format", "json") as (running, url):
        patient(url, package)
        running.send_signal(signal.SIGTERM)
        _, said = running.communicate(timeout=PATIENCE)
    lines = [json.loads(line) for line in said.splitlines()]
    assert {"ready", "listening", "accepted", "opened", "closed", "stopped"} <= {line["event"] for line in lines}
    (closed,) = (line for line in lines if line["event"] == "closed")
    assert (closed["level"], closed["client"], closed["reason"]) == ("INFO", 1, "left")
    assert closed["sent_bytes"] > 10_000


REFUSED = (
    b"X-A: a\x01b\r\n",  # a control character
    b"X-A: " + b"a" * 20_000 + b"\r\n",
    b"X-A: a\r\n" * 130,
)


def test_refused_upgrades_do_not_spoil_its_end(package: Path) -> None:
    upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    with process(package, "--port", 0) as (running, url), ExitStack() as stack:
        port = int(url.rpartition(":")[2].partition("/")[0])
        for headers in REFUSED:
            standing = stack.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE))
            standing.sendall(b"GET /stream HTTP/1.1\r\nHost: localhost\r\n" + upgrade + headers + b"\r\n")
            assert standing.recv(12).startswith(b"HTTP/1.1 4"), headers[:20]
        viewers = [stack.enter_context(connect(url, proxy=None, open_timeout=PATIENCE)) for _ in range(5)]
        for ws in viewers:
            ws.send(Hello(VIEW).to_bytes())
            assert ws.recv(timeout=PATIENCE)
        running.send_signal(signal.SIGTERM)
        for ws in viewers:
            with suppress(ConnectionClosed):
                while True:
                    ws.recv(timeout=PATIENCE)
            assert ws.close_code == 1012
        _, said = running.communicate(timeout=PATIENCE)
    assert running.returncode == 0
    assert "Error" not in said


@pytest.mark.slow
def test_killed_in_mid_stream_and_started_again_it_sends_what_is_missing_once(package: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    came: list[int] = []

    async def stream(first: subprocess.Popen[str], url: str, after: ExitStack) -> StreamClient:
        client = StreamClient(url, VIEW, ClientConfig(first_wait_s=0.05), clock=ManualClock())

        def look(received: object) -> None:
            came.extend(received.gaussians.tolist())  # type: ignore[attr-defined]
            if first.poll() is None:
                first.kill()  # while more is under way
                first.wait()
            if has_all(client.receiver, package):
                client.stop()

        running = asyncio.create_task(asyncio.wait_for(client.run(still, on_batch=look), PATIENCE))
        while first.poll() is None:
            await asyncio.sleep(0.02)
        assert not has_all(client.receiver, package)
        await asyncio.to_thread(after.enter_context, process(package, "--port", port))
        await running
        return client

    with process(package, "--port", port) as (first, url), slow_link(url, 200e3) as link, ExitStack() as after:
        client = asyncio.run(stream(first, link.url, after))
    assert client.connections == 2
    assert client.restarts == 0
    assert has_all(client.receiver, package)
    assert len(came) == len(set(came)) == len(client.receiver.holdings.received)


def test_what_cannot_be_served_is_reported_in_one_line(
    package: Path, tmp_path: Path, failed: Callable[..., str]
) -> None:  # fmt: skip
    assert "no such file" in failed(tmp_path / "none.gsvis")
    damaged = tmp_path / "room.gsvis"
    shutil.copytree(package, damaged)
    part = max((damaged / "parts").iterdir())
    part.write_bytes(b"x" * part.stat().st_size)
    assert "content that fits its name" in failed(damaged, "--tables", tmp_path / "tables")  # no tables from before
    part.write_bytes(b"x")
    assert "bytes" in failed(damaged)  # whether there are tables or not
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "address already in use" in failed(package, "--port", taken.getsockname()[1])
    assert "ssl_certfile" in failed(package, "--ssl-keyfile", "key.pem")
    assert "no such file" in failed(package, "--ssl-certfile", tmp_path / "none.pem")


def test_tls(package: Path, tmp_path: Path) -> None:
    chain, key = certificate(tmp_path)
    with process(package, "--port", 0, "--ssl-certfile", chain, "--ssl-keyfile", key) as (running, url):
        assert url.startswith("wss://")
        trusting = ssl.create_default_context(cafile=str(chain))
        client, _ = patient(url, package, config=ClientConfig(tls=trusting))
        assert has_all(client.receiver, package)
        with pytest.raises(ConnectionError, match="certificate"):
            give_up(url)
        running.send_signal(signal.SIGINT)
        running.communicate(timeout=PATIENCE)
    assert running.returncode == 0


def test_the_log_is_as_before_once_the_server_has_ended(
    package: Path, failed: Callable[..., str], caplog: pytest.LogCaptureFixture
) -> None:
    assert "nowhere" in failed(package.with_name("nowhere"))
    logging.getLogger("gsvis.serve").warning("after it")
    assert caplog.messages[-1:] == ["after it"]


@pytest.fixture(autouse=True)
def set_aside() -> Iterator[None]:
    """Set aside what was set aside before: a server that ends gives everything back, and each look then takes long."""
    yield
    gc.freeze()


def test_the_garbage_collector_passes_over_what_stays(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frozen = []
    gc.unfreeze()  # what tests set aside does not count

    def run(server: Server, **_: object) -> None:
        frozen.append(gc.get_freeze_count())
        server._socket.close()

    monkeypatch.setattr(Server, "run", run)
    assert main(["serve", str(package), "--port", "0"]) == 0
    assert frozen[0] > 10_000
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize("name", ["scene.ply", "scan/meta.json", "scan/lod-meta.json", "levels/levels.arrow"])
def test_a_bare_scene_is_answered_with_the_commands_for_it(
    tmp_path: Path, failed: Callable[..., str], name: str
) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(b"{}")
    scene = file if file.parent == tmp_path else file.parent
    said = failed(scene)
    assert f"gsvis view {scene}" in said
    assert f"gsvis prepare {scene}" in said
