"""Do honest viewers get every byte, in time, while every kind of hostile client is at the server?

A server process pinned to one core; viewers who keep what they receive; after a sixth of the time all kinds of
`_hostile.py` at once, in processes on the other cores. What a visit has brought is compared with the package, byte for
byte: records, terms, rows of chunks as they came, and what the viewer then draws. What is expected comes from the
manifest, as JSON, and from the parts, through the reader of packages that the server uses, too; messages are taken
apart by the code of our client. Neither is what encodes messages. WELCOME is compared with the rules of
docs/streaming.md, but for its identity, which only has to be the same in all visits.

Given: 30 viewers behind links of one rate (`--mbit`), each walking and beginning anew when the server has nothing more
    for it; the numbers of hostile clients and their pauses, in `_hostile.CROWD`; 30 minutes, five sixths of them under
    attack.
    Attackers and checks yield to the viewers on the cores that the server does not use (nice 15 and 10), as on machines
    of their own; where 60 visits wait for checks, no other visit begins.
Measured: bytes that differ; visits that the server cut; the delay from the acknowledgement that makes room for a batch
    until it is there, with and without attackers in one run, which is what counts on a machine that is busy with other
    things; how late the process of the viewers itself is in both phases; memory and descriptors of the server each
    second; its exit code when it is stopped under attack. PSS counts pages that several processes share in part: it
    rises when another process ends, without a byte more; USS is what the server has alone. Memory: the largest of the
    last fifth of the samples less that of the first. Descriptors: medians of these, since as many attackers come and go
    in a second as the limits let in.
Defaults chosen on: builtin:two_rooms, for viewers and rate, so that one core is not full without attackers.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import resource
import shutil
import ssl
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from _harness import add_arguments, write_result
from _honest import Checks, Link, Viewer, begin_checks
from _hostile import CROWD, Target, attack, unverified

from gsvis.package import Package

HEALTH_S = 10.0  # in which /healthz has to answer
SETTLE_S = 300.0  # memory and descriptors have to be flat from then on
LATE_S = 0.02  # sleep by which the lateness of the viewers' own process is found
BACKLOG = 2  # visits of each viewer that may wait to be checked
QUICK = (
    "--steps", "10", "--views", "6", "--width", "96", "--height", "72", "--cells", "24", "--limit", "0.01",
    "--max-inner", "1", "--face-size", "96", "--max-terms", "4",
)  # fmt: skip


def prepared(folder: Path) -> Path:
    """Return a package of a built-in scene, made with little care for its looks."""
    package = folder / "two_rooms.gsvis"
    command = [sys.executable, "-m", "gsvis", "prepare", "builtin:two_rooms", "-o", str(package), *QUICK]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return package


def certificate(folder: Path) -> list[str]:
    """Return the options of a server with a certificate of its own making."""
    chain, key = folder / "chain.pem", folder / "key.pem"
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=127.0.0.1"),
            *("-keyout", str(key), "-out", str(chain)),
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    return ["--ssl-certfile", str(chain), "--ssl-keyfile", str(key)]


class Lateness:
    """How late the process of the viewers itself is, and how much of a core it takes.

    Attributes:
        found: (time, seconds) by which a sleep was longer than asked for.
        processor: (time, seconds of processor) of this process.
    """

    def __init__(self) -> None:
        self.found: list[tuple[float, float]] = []
        self.processor: list[tuple[float, float]] = []

    async def run(self) -> None:
        """Sample until cancelled."""
        while True:
            began = time.monotonic()
            await asyncio.sleep(LATE_S)
            now = time.monotonic()
            self.found.append((now, now - began - LATE_S))
            self.processor.append((now, time.process_time()))

    def between(self, low: float, high: float) -> dict[str, float]:
        """Return quantiles of the lateness in milliseconds, and the share of a core, between two times."""
        used = [each for each in self.processor if low <= each[0] < high]
        share = (used[-1][1] - used[0][1]) / (used[-1][0] - used[0][0]) if len(used) > 1 else float("nan")
        return {**summary([late for t, late in self.found if low <= t < high]), "cpu_share": share}


class Probe:
    """Samples of a server process: memory, descriptors, its log, and whether its health address answers."""

    def __init__(self, pid: int, url: str, log: Path, tls: ssl.SSLContext | None) -> None:
        self._proc, self._log, self._tls, self._to = Path(f"/proc/{pid}"), log, tls, urlsplit(url)
        self.samples: list[dict[str, float]] = []
        self.health: list[tuple[float, float | None]] = []

    async def run(self) -> None:
        """Sample each second until cancelled."""
        while True:
            with suppress(OSError):
                self.samples.append(await asyncio.to_thread(self._sample))
            self.health.append((time.monotonic(), await self._ask()))
            await asyncio.sleep(1.0)

    def _sample(self) -> dict[str, float]:
        rollup = dict(
            line.split(":", 1) for line in (self._proc / "smaps_rollup").read_text().splitlines() if line.endswith("kB")
        )
        words = (self._proc / "stat").read_text().rpartition(")")[2].split()
        return {
            "t": time.monotonic(),
            "rss_mb": int(rollup["Rss"].split()[0]) / 1024,
            "pss_mb": int(rollup["Pss"].split()[0]) / 1024,
            "uss_mb": sum(int(rollup[name].split()[0]) for name in ("Private_Clean", "Private_Dirty")) / 1024,
            "descriptors": len(os.listdir(self._proc / "fd")),
            "cpu_s": (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK"),
            "log_mb": self._log.stat().st_size / 1e6,
        }

    async def _ask(self) -> float | None:
        """Return the seconds until /healthz has answered 200; None if it has not in time."""
        began, writer = time.monotonic(), None

        async def ask() -> bool:
            nonlocal writer
            reader, writer = await asyncio.open_connection(
                self._to.hostname, self._to.port, ssl=self._tls, local_addr=("127.0.2.1", 0)
            )
            writer.write(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
            return (await reader.readline()).startswith(b"HTTP/1.1 200")

        try:
            return time.monotonic() - began if await asyncio.wait_for(ask(), HEALTH_S) else None
        except (OSError, asyncio.TimeoutError):
            return None
        finally:
            if writer is not None:
                writer.transport.abort()


async def soak(
    link: Link, count: int, times: tuple[float, float, float], pool: ProcessPoolExecutor, probe: Probe, hostile: Any
) -> dict[str, Any]:
    """Run viewers over the warm-up, the quiet phase and the attack; return what they and the checks have found.

    Args:
        link: What viewers share.
        count: Of viewers.
        times: Seconds of the warm-up, the quiet phase and the attack.
        pool: Where visits are checked.
        probe: Of the server.
        hostile: Starts the attackers.
    """
    checks = Checks(pool, BACKLOG * count)
    begin = time.monotonic()
    quiet, assault, end = (begin + float(t) for t in np.cumsum(times))
    viewers = [Viewer(link, k, checks) for k in range(count)]
    running = [asyncio.create_task(viewer.run(end)) for viewer in viewers]
    late = Lateness()
    probing = [asyncio.create_task(each.run()) for each in (probe, late)]
    await asyncio.sleep(assault - time.monotonic())
    await asyncio.to_thread(hostile)
    await asyncio.gather(*running)
    for task in probing:
        task.cancel()
    await checks.finish()

    def between(of: str, low: float, high: float) -> list[float]:
        return [seconds for viewer in viewers for t, seconds in getattr(viewer, of) if low <= t < high]

    return {
        "checked": dict(checks.found),
        "most_visits_waiting_for_checks": checks.longest,
        "waited_for_checks_s": checks.waited_s,
        "memory_of_viewers_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "viewers_process": {"quiet": late.between(quiet, assault), "attack": late.between(assault, end)},
        "marks": (quiet, assault, end),
        "delays": {"quiet": between("delays", quiet, assault), "attack": between("delays", assault, end)},
        "openings": {"quiet": between("openings", quiet, assault), "attack": between("openings", assault, end)},
        "cut": dict(Counter(why for viewer in viewers for t, why in viewer.cut if t >= quiet)),
        "visits": sum(viewer.visits for viewer in viewers),
        "mbytes": sum(viewer.nbytes for viewer in viewers) / 1e6,
    }


def summary(values: list[float]) -> dict[str, float]:
    """Return quantiles in milliseconds."""
    found = np.array(values or [np.nan])
    return {f"p{q:g}_ms": float(1e3 * np.percentile(found, q)) for q in (50, 95, 99, 99.9)} | {"count": len(values)}


def growth(
    samples: list[dict[str, float]], key: str, after: float, of: Callable[[list[float]], float] = max
) -> float:  # fmt: skip
    """Return by how much the last fifth of the samples exceeds the first, after a time; the largest of each."""
    values = [sample[key] for sample in samples if sample["t"] >= after]
    fifth = max(len(values) // 5, 1)
    return of(values[-fifth:]) - of(values[:fifth]) if values else float("nan")


def measured(
    args: argparse.Namespace, package: Path, folder: Path
) -> tuple[dict[str, Any], Probe, dict[str, int], int]:
    """Run it: what viewers found, samples, counts of the attackers, exit code of the server."""
    with Package.open(package) as opened:
        stops, up = opened.visibility.grid.centers, opened.visibility.grid.up
    tls = unverified() if args.tls else None
    log = folder / "server.log"
    command = [sys.executable, "-m", "gsvis", "serve", str(package), "--port", "0", "--json", *args.server_options]
    command += certificate(folder) if args.tls else []
    with log.open("wb") as stderr:
        server = subprocess.Popen(
            ["taskset", "-c", str(args.core), *command], stdout=subprocess.PIPE, stderr=stderr, text=True,
            env=os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
    others = sorted(os.sched_getaffinity(0) - {args.core})
    os.sched_setaffinity(0, others[:1])
    rest = others[1:] or others
    spawn = multiprocessing.get_context("spawn")
    results, attackers = spawn.Queue(), []
    try:
        said = ""
        while not said.endswith("}\n"):
            line = server.stdout.readline()
            assert line, log.read_text()
            said += line
        url = json.loads(said)["url"]
        where = urlsplit(url)
        target = Target(str(where.hostname), int(where.port or 0), args.tls, package.resolve().name.partition(".")[0])
        seconds = 60.0 * args.minutes
        names = [kind.__name__ for kind in CROWD if not args.only or kind.__name__ in args.only]

        def hostile() -> None:
            for k in range(args.attackers):
                left = seconds * 5 / 6 + 10.0  # until the server has ended
                given = target, names[k :: args.attackers], left, rest, k, results
                attackers.append(spawn.Process(target=attack, args=given, daemon=True))
                attackers[-1].start()

        probe = Probe(server.pid, url, log, tls)
        with ProcessPoolExecutor(args.checkers, spawn, begin_checks, (package, others)) as pool:
            times = args.warm, seconds / 6, seconds * 5 / 6
            link = Link(url, stops, up, args.mbit, tls, args.one_address)
            found = asyncio.run(soak(link, args.viewers, times, pool, probe, hostile))
        server.terminate()  # while the attackers are still there
        code = server.wait(60)
        counts: Counter[str] = Counter()
        for _ in attackers:
            counts.update(results.get(timeout=120))
        found["log_tail"] = log.read_text(errors="replace").splitlines()[-5:]
        return found, probe, dict(counts), code
    finally:
        for process in attackers:
            process.kill()
        server.kill()
        server.wait()


def report(
    args: argparse.Namespace, package: Path, found: dict[str, Any], probe: Probe, counts: dict[str, int], code: int
) -> None:
    """Write the figures."""
    quiet, assault, end = found.pop("marks")
    delays = {phase: summary(values) for phase, values in found.pop("delays").items()}
    openings = {phase: summary(values) for phase, values in found.pop("openings").items()}
    checked = found["checked"]
    attack_samples = [sample for sample in probe.samples if assault <= sample["t"] < end]
    settled = assault + min(SETTLE_S, (end - assault) / 3)
    answers = [seconds for t, seconds in probe.health if assault <= t < end - HEALTH_S]
    cpu = {
        name: (rows[-1]["cpu_s"] - rows[0]["cpu_s"]) / (rows[-1]["t"] - rows[0]["t"])
        for name, low, high in (("quiet", quiet, assault), ("attack", assault, end))
        if len(rows := [sample for sample in probe.samples if low <= sample["t"] < high]) > 1
    }
    leaks = sum(count for name, count in counts.items() if name.startswith("leak"))
    log_rate = growth_rate(attack_samples, "log_mb")
    figures = [
        ("wrong bytes of what honest viewers hold", checked.get("wrong", 0), 0, "bytes", "lower"),
        ("messages that honest viewers had to refuse", checked.get("refused", 0), 0, "visits", "lower"),
        ("honest visits that the server cut or turned away", sum(found["cut"].values()), 0, "visits", "lower"),
        ("bytes compared", checked.get("bytes", 0) / 1e6, None, "MB", "higher"),
        ("batch delay, 99th percentile, under attack", delays["attack"]["p99_ms"], None, "ms", "lower"),
        ("the same over that without attack", delays["attack"]["p99_ms"] / delays["quiet"]["p99_ms"], 2.0, "", "lower"),
        ("health asked in vain", sum(seconds is None for seconds in answers), 0, "times", "lower"),
        ("growth of memory (PSS) after settling", growth(attack_samples, "pss_mb", settled), 16, "MB", "lower"),
        ("growth of private memory (USS) after settling", growth(attack_samples, "uss_mb", settled), 16, "MB", "lower"),
        ("largest memory (RSS)", max(sample["rss_mb"] for sample in probe.samples), None, "MB", "lower"),
        (
            "growth of descriptors after settling, medians",
            growth(attack_samples, "descriptors", settled, median),
            16,
            "",
            "lower",
        ),
        ("log", log_rate, 1.0, "MB a minute", "lower"),
        ("files outside of the package that were given away", leaks, 0, "files", "lower"),
        ("exit code of SIGTERM under attack", code, 0, "", "lower"),
    ]
    details = {
        "package": package.name, "minutes": args.minutes, "viewers": args.viewers, "mbit_per_s": args.mbit,
        "tls": args.tls, "one_address": args.one_address,
        "delays": delays, "openings": openings, "server_cpu_share": cpu,
        "health_answered_ms": summary([seconds for seconds in answers if seconds is not None]),
        "settled_after_s": settled - assault,
        "growth_of_most_descriptors": growth(attack_samples, "descriptors", settled), **found, "attackers": counts,
        "crowd": {kind.__name__: count for kind, (count, _) in CROWD.items()},
        "samples": [
            {key: round(value - (quiet if key == "t" else 0.0), 2) for key, value in sample.items()}
            for sample in probe.samples[:: max(1, len(probe.samples) // 300)]
        ],
    }  # fmt: skip
    rows = [dict(zip(("name", "reached", "target", "unit", "better"), row, strict=True)) for row in figures]
    write_result(args.out, "Do honest viewers get every byte, in time, under attack?", rows, details)


def growth_rate(samples: list[dict[str, float]], key: str) -> float:
    """Return by how much a sample grows a minute."""
    if len(samples) < 2:
        return float("nan")
    return 60.0 * (samples[-1][key] - samples[0][key]) / (samples[-1]["t"] - samples[0]["t"])


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--package", type=Path, help="what `gsvis prepare` made; otherwise one of builtin:two_rooms")
    parser.add_argument("--minutes", type=float, default=30.0, help="a sixth of it without attackers")
    parser.add_argument("--warm", type=float, default=10.0, help="seconds before anything counts")
    parser.add_argument("--viewers", type=int, default=30)
    parser.add_argument("--mbit", type=float, default=2.0, help="rate of the link of each, Mbit/s")
    parser.add_argument("--one-address", action="store_true", help="all viewers come from one address, as behind a NAT")
    parser.add_argument("--attackers", type=int, default=2, help="processes")
    parser.add_argument("--checkers", type=int, default=2, help="processes that compare what viewers hold")
    parser.add_argument("--only", nargs="+", help="kinds of attackers, such as flood; otherwise all")
    parser.add_argument("--tls", action="store_true", help="serve with TLS; needs openssl for a certificate")
    parser.add_argument("--core", type=int, default=0, help="of the server")
    parser.add_argument("--server-options", nargs=argparse.REMAINDER, default=[], help="further options of gsvis serve")
    args = parser.parse_args()
    if not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2 or shutil.which("taskset") is None:
        print("skipped: needs Linux, taskset, and two cores", file=sys.stderr)
        return
    with tempfile.TemporaryDirectory(prefix="gsvis-soak-") as temporary:
        folder = Path(temporary)
        package = args.package or prepared(folder)
        report(args, package, *measured(args, package, folder))


if __name__ == "__main__":
    main()
