"""`gsvis serve`: serve packages to viewers until stopped. Logs go to stderr; with --json the address goes to stdout.

With --workers this process supervises: it runs the same command again for each process, on its listening socket.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from gsvis.cli.arguments import Serve
from gsvis.cli.terminal import print_json
from gsvis.errors import BackendError
from gsvis.files.limits import open_regular
from gsvis.files.origins import parse_origins
from gsvis.files.places import TABLES, cache_folder

if TYPE_CHECKING:
    from gsvis.serve.processes import Child

__all__ = ["log_to_stderr", "run_serve"]

_BUILTIN = "builtin:"
_BARE = ("meta.json", "lod-meta.json", "levels.arrow")  # what folders of bare scenes hold


def run_serve(command: Serve) -> None:
    """Open the packages and serve them."""
    from gsvis.serve import JsonLines, TextLines
    from gsvis.serve.processes import Child

    _check_packages(command.package)
    child = Child.from_environment()
    number = None if child is None else child.number
    form = JsonLines(number) if command.log_format == "json" else TextLines(number)
    with log_to_stderr(form, logging.DEBUG if command.output.debug else logging.INFO):
        if child is None and command.workers > 1:
            _supervise(command)
        else:
            _serve(command, child)


def _check_packages(paths: Sequence[str]) -> None:
    """Raise if a path is a bare scene, which has to be prepared before it can be served.

    Raises:
        ValueError: If it is; the message names the commands for it.
    """
    for path in paths:
        if not Path(path).exists() and not path.startswith(_BUILTIN):
            raise FileNotFoundError(2, "no such file or folder", path)
        if path.startswith(_BUILTIN) or Path(path).is_file() or any((Path(path) / name).is_file() for name in _BARE):
            name = Path(path.removeprefix(_BUILTIN)).stem.partition(".")[0]
            raise ValueError(
                f"{path}: expected the folder of a package, got a scene; look at it with gsvis view {path},"
                f" or make a package of it with gsvis prepare {path} -o {name}.gsvis"
            )


def _serve(command: Serve, child: Child | None) -> None:
    """Serve in this process; `child` if another one started it."""
    from gsvis.abr.config import AbrConfig
    from gsvis.serve import Address, AppConfig, Limits, Server, open_scenes
    from gsvis.serve.hang import HUNG_S
    from gsvis.serve.siblings import Siblings
    from gsvis.stream import Quality

    bounds = command.bounds
    limits = Limits(
        connections=bounds.clients,
        message_bytes=bounds.message_bytes,
        messages_per_s=float(bounds.messages),
        poses_per_s=float(bounds.poses),
        handshake_s=bounds.handshake,
        idle_s=bounds.idle,
        stall_s=bounds.stall,
        keep_alive_s=bounds.keep_alive,
        per_address=bounds.per_address,
        close_s=bounds.close,
        tables_bytes=bounds.tables_memory,
    )
    token = command.access.token if command.access.token is not None else os.environ.get("GSVIS_TOKEN") or None
    abr = AbrConfig(policy=command.sending.policy, fill=not command.sending.no_fill)
    opens = parse_origins("--page-origins", command.access.page_origins)
    config = AppConfig(token, command.access.origins, limits, abr, command.access.hosts, command.access.proxies, opens)
    address = Address(**vars(command.address))
    for path in (command.address.ssl_certfile, command.address.ssl_keyfile):
        if path is not None:
            open_regular(path).close()  # an error of OpenSSL would not name the file
    quality = Quality() if command.coarse else None
    tables = None if command.no_tables else command.tables or str(cache_folder() / TABLES)
    siblings = None if child is None else Siblings(Path(child.folder), child.number, beat=child.beat)
    with open_scenes(
        command.package,
        max_cache_bytes=command.cache,
        warm=True,
        quality=quality,
        terms=command.sending.terms,
        tables=tables,
    ) as scenes:
        try:
            listener = None if child is None else child.socket()
            server = Server(scenes, config, address, planners=command.planners, listener=listener, siblings=siblings)
        except OSError as error:
            if error.filename is None:  # OpenSSL rejects a certificate without naming the file
                raise BackendError(f"TLS: {error}; check --ssl-certfile and --ssl-keyfile") from error
            raise
        if child is not None:
            child.say_ready()
            child.watch(server.stop)
        elif command.output.json:
            _print_address(server.url, command)
        with _start_spared_by_gc(), suppress(KeyboardInterrupt):  # how a server ends
            server.run(hung_s=HUNG_S if child is None else None)  # a child has a supervisor for that


def _supervise(command: Serve) -> None:
    """Run this command as several processes until a signal, and end as they do.

    Raises:
        OSError: If the address is taken.
        SystemExit: If the first process ends before it serves; with its status.
    """
    from gsvis.serve.processes import Supervisor
    from gsvis.serve.server import Address, listen, url_of

    address = Address(**vars(command.address))
    with listen(address) as listener:
        supervisor = Supervisor([sys.executable, "-m", "gsvis", *sys.argv[1:]], command.workers, listener)
        url = url_of(address, int(listener.getsockname()[1]))
        status = supervisor.run(lambda: _print_address(url, command) if command.output.json else None)
    if status > 0:  # a signal ends a server as it should: with 0, as without --workers
        raise SystemExit(status)


def _print_address(url: str, command: Serve) -> None:
    """Print the address of the server and of the page of each scene as JSON."""
    from gsvis.serve.scenes import name_of
    from gsvis.serve.server import page_of

    names = [name_of(path) for path in command.package]
    pages = [page_of(url, name) for name in names]
    print_json({"format": "gsvis-serving", "version": 1, "url": url, "scenes": names, "pages": pages})
    sys.stdout.flush()


@contextmanager
def _start_spared_by_gc() -> Iterator[None]:
    """Exclude existing objects from garbage collection: hundreds of thousands of objects that stay.

    A full collection then takes milliseconds. It also runs after fewer new objects, a quarter of those that stay.
    """
    gc.collect()
    gc.freeze()
    gc.collect()  # gives the collector the number of objects that stay
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def log_to_stderr(form: logging.Formatter, level: int) -> Iterator[None]:
    """Write the log of a server to stderr while it runs: lines of gsvis from a level on, and warnings of uvicorn."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(form)
    least = {"gsvis": level, "uvicorn": logging.WARNING}
    loggers = [logging.getLogger(name) for name in least]
    before = [(logger.handlers, logger.propagate, logger.level) for logger in loggers]
    for logger in loggers:
        logger.handlers = [handler]
        logger.propagate = False
        logger.setLevel(least[logger.name])
    try:
        yield
    finally:
        for logger, (handlers, propagate, was) in zip(loggers, before, strict=True):
            logger.handlers = handlers
            logger.propagate = propagate
            logger.setLevel(was)
