"""One server as several processes: on one port, restarted, ended together, with limits and counters in common."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gsvis.serve import Limits, Metrics, StreamClient
from gsvis.serve.limits import Seats
from gsvis.serve.log_lines import JsonLines, TextLines
from gsvis.serve.processes import Child, Supervisor, _Place
from gsvis.serve.server import Address, listen
from gsvis.serve.siblings import Siblings
from tests import warm_start
from tests.serve.servers import PATIENCE, VIEW, has_all, serving, still, until


class Many:
    """A `gsvis serve --workers` that runs."""

    def __init__(self, process: subprocess.Popen[str], url: str, log: Path) -> None:
        self.process, self.url, self.log = process, url, log

    @property
    def http(self) -> str:
        return self.url.replace("ws://", "http://").removesuffix("/stream")

    def ask(self, path: str) -> str:
        with urllib.request.urlopen(self.http + path, timeout=PATIENCE) as answer:
            return str(answer.read().decode())

    @property
    def processes(self) -> int:
        return int(json.loads(self.ask("/healthz"))["processes"])

    def children(self) -> list[int]:
        text = subprocess.run(
            ["ps", "-o", "pid=", "--ppid", str(self.process.pid)], capture_output=True, text=True, check=True
        ).stdout
        return [int(line) for line in text.split()]


@contextmanager
def many(*packages: Path, count: int = 2, options: tuple[str, ...] = ()) -> Iterator[Many]:
    log = packages[0].parent / f"{os.getpid()}-{time.monotonic_ns()}.log"
    command = [sys.executable, "-m", "gsvis", "serve", *map(str, packages), "--port", "0", "--json",
               "--workers", str(count), *options]  # fmt: skip
    with log.open("w") as errors:
        process = warm_start.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
    try:
        assert process.stdout is not None
        line = ""
        while not line.rstrip().endswith("}"):
            more = process.stdout.readline()
            assert more, log.read_text()
            line += more
        yield Many(process, json.loads(line)["url"], log)
    finally:
        process.kill()
        process.communicate()


def all_of(url: str, package: Path, count: int = 1) -> list[StreamClient]:
    """Clients at once that stay until each has all."""

    async def stream() -> list[StreamClient]:
        clients = [StreamClient(url, VIEW) for _ in range(count)]

        def stops(client: StreamClient) -> object:
            return lambda _: client.stop() if has_all(client.receiver, package) else None

        await asyncio.wait_for(
            asyncio.gather(*(client.run(still, on_batch=stops(client)) for client in clients)), PATIENCE
        )
        return clients

    return asyncio.run(stream())


@pytest.fixture(scope="module", autouse=True)
def compiled(plain: Path) -> None:
    """Compile here, once, what each of the processes would compile at the same time in a fresh clone."""
    with serving(plain) as server:
        all_of(server.url, plain)


@pytest.mark.skipif(sys.platform == "win32", reason="descriptors are inherited as on Unix")
def test_processes_serve_as_one(plain: Path) -> None:
    with many(plain) as server:
        until(lambda: server.processes == 2)
        for client in all_of(server.url, plain, 6):
            assert has_all(client.receiver, plain)
        # Counters of all processes are in files, sooner or later.
        until(lambda: 'gsvis_clients_opened_total{scene="plain"} 6.0' in server.ask("/metrics"))
        until(lambda: 'process_resident_memory_bytes{process="0"}' in server.ask("/metrics"))
        until(lambda: 'process_resident_memory_bytes{process="1"}' in server.ask("/metrics"))
        lines = server.log.read_text()
        assert " process=0\n" in lines
        assert " process=1\n" in lines

        victim = server.children()[0]
        os.kill(victim, signal.SIGKILL)
        until(lambda: victim not in server.children() and len(server.children()) == 2)
        all_of(server.url, plain, 2)
        assert "died" in server.log.read_text()
        until(lambda: 'gsvis_clients_opened_total{scene="plain"} 8.0' in server.ask("/metrics"))  # of the dead too

        children = server.children()
        server.process.terminate()
        assert server.process.wait(PATIENCE) == 0
        assert not any(is_running(pid) for pid in children)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_children_end_when_the_supervisor_is_killed(plain: Path) -> None:
    with many(plain) as server:
        until(lambda: len(server.children()) == 2)
        until(lambda: server.processes == 2)
        children = server.children()
        server.process.kill()
        until(lambda: not any(is_running(pid) for pid in children))


class Supervised:
    """A supervisor in this thread, and a thread that tries it and then ends it."""

    def __init__(self, command: list[str], count: int, hung_s: float) -> None:
        self.listener = listen(Address("127.0.0.1", 0))
        self.supervisor = Supervisor(command, count, self.listener, hung_s=hung_s)

    @property
    def pids(self) -> list[int]:
        return self.supervisor.pids

    def run(self, trial: Callable[[], None]) -> None:
        """Run until the trial ends; raise what it raises."""
        errors: list[BaseException] = []

        def work() -> None:
            try:
                trial()
            except BaseException as error:
                errors.append(error)
            finally:
                self.supervisor.stop()

        thread = threading.Thread(target=work)
        with self.listener:
            self.supervisor.run(thread.start)
            thread.join()
        if errors:
            raise errors[0]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_process_that_hangs_is_restarted(plain: Path, caplog: pytest.LogCaptureFixture) -> None:
    command = [sys.executable, "-m", "gsvis", "serve", str(plain), "--port", "0", "--workers", "2"]
    server = Supervised(command, 2, hung_s=10.0)
    url = f"ws://127.0.0.1:{server.listener.getsockname()[1]}/stream"

    def trial() -> None:
        until(lambda: len(server.pids) == 2)
        until(lambda: json.loads(ask(url, "/healthz"))["processes"] == 2)
        victim, other = server.pids
        os.kill(victim, signal.SIGSTOP)
        for client in all_of(url, plain, 2):  # the other one serves
            assert has_all(client.receiver, plain)
        until(lambda: not is_running(victim) and len(server.pids) == 2)
        until(lambda: json.loads(ask(url, "/healthz"))["processes"] == 2)
        all_of(url, plain, 2)
        assert is_running(other)  # its signs of life were heard

    with caplog.at_level("ERROR", "gsvis.serve"):
        server.run(trial)
    assert any(line.startswith("hangs process=") for line in caplog.messages)


def test_only_silence_after_a_sign_of_life_counts() -> None:
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    place = _Place(0, beats=reading)
    assert place.listen(100.0) == 0.0  # it may open a large world
    os.write(writing, b".")
    assert place.listen(100.0) == 0.0
    assert [place.listen(2.0), place.listen(3.0)] == [2.0, 5.0]
    os.write(writing, b"..")
    assert place.listen(100.0) == 0.0
    os.close(writing)
    assert place.listen(2.0) == 2.0
    place.forget()
    assert place.listen(100.0) == 0.0


@pytest.mark.parametrize(("beats", "restarts"), [(0, False), (1, True)])
def test_a_process_that_falls_silent_is_restarted(beats: int, restarts: bool) -> None:
    child = (
        "import sys, time; from gsvis.serve.processes import Child; child = Child.from_environment()\n"
        f"child.say_ready()\nfor _ in range({beats}): child.beat()\n"
        "time.sleep(600)"
    )
    server = Supervised([sys.executable, "-c", child], 1, hung_s=1.0)

    def trial() -> None:
        first = server.pids[0]
        if restarts:
            until(lambda: server.pids not in ([], [first]))
        else:
            time.sleep(2.0)
            assert server.pids == [first]

    server.run(trial)


def test_signs_of_life_never_block_or_fail() -> None:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    child = Child(0, 0, 0, writing, "")
    for _ in range(1 << 17):
        child.beat()  # more than a pipe holds
    os.close(reading)
    child.beat()
    os.close(writing)
    child.beat()


def ask(url: str, path: str) -> str:
    with urllib.request.urlopen(
        url.replace("ws://", "http://").removesuffix("/stream") + path, timeout=PATIENCE
    ) as found:
        return str(found.read().decode())


def test_one_process_ends_with_the_same_status(plain: Path) -> None:
    with many(plain, count=1) as server:
        server.ask("/healthz")
        server.process.terminate()
        assert server.process.wait(PATIENCE) == 0


def test_what_is_wrong_shows_once(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gsvis", "serve", str(tmp_path / "none.gsvis"), "--port", "0", "--workers", "3"]
    found = warm_start.run(command, capture_output=True, text=True, timeout=PATIENCE)
    single = warm_start.run([*command[:-2]], capture_output=True, text=True, timeout=PATIENCE)
    assert found.returncode == single.returncode != 0
    assert found.stderr.count("none.gsvis") == single.stderr.count("none.gsvis")


def test_seats_count_those_of_others() -> None:
    others = {"a": (3, 2), "b": (3, 1)}
    seats = Seats(Limits(connections=5, per_address=3), lambda owner: others[owner])

    class Viewer:
        silent_s = 0.0

        def give_way(self) -> None:
            raise AssertionError

    assert seats.take("a", Viewer()) == ""
    assert seats.take("a", Viewer()) == "address-full"
    assert seats.take("b", Viewer()) == ""
    assert seats.take("b", Viewer()) == "too-many"
    assert seats.by_owner == {"a": 1, "b": 1}


def test_counters_of_the_dead_count_and_their_gauges_do_not(tmp_path: Path) -> None:
    ages: dict[str, float] = {}
    made = []
    for number, name in ((0, "old"), (0, "new"), (1, "other")):
        metrics = Metrics()
        metrics.clients.set(2)
        metrics.sent.bytes.add(100)
        metrics.late.observe(0.01)
        found = Siblings(tmp_path, number, age=lambda path: ages.get(path.name, 1.0))
        found.path = tmp_path / f"process-{number}-{name}.json"
        ages[found.path.name] = 5.0 if name == "old" else 1.0
        found.publish(metrics, {"a": 2}, (1, 0))
        made.append((found, metrics))
    other, metrics = made[2]
    assert other.seats_of("a") == (2, 2)
    assert other.seats_of("b") == (2, 0)
    assert other.alive == 2
    assert not other.is_ahead(2)
    assert other.is_ahead(3)
    text = other.text(metrics)
    assert "gsvis_sent_bytes_total 300.0" in text
    assert "gsvis_clients 4.0" in text
    assert "gsvis_late_seconds_count 3.0" in text
    assert text.count("gsvis_build_info{") == 1
    ages["process-0-new.json"] = 60.0  # it hangs, or its supervisor waits to restart it
    ages["process-0-old.json"] = 70.0
    other.publish(metrics, {}, (1, 0))
    assert other.alive == 1
    (tmp_path / "process-7-9.json").write_text("{")  # half of a file is no file
    other.publish(metrics, {}, (1, 0))
    assert other.alive == 1


def test_lines_name_the_process() -> None:
    import logging

    record = logging.LogRecord("gsvis.serve", logging.INFO, "", 0, "closed client=3", None, None)
    assert TextLines(1).format(record).endswith("closed client=3 process=1")
    assert json.loads(JsonLines(1).format(record))["process"] == 1
    assert "process" not in json.loads(JsonLines().format(record))
