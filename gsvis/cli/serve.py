"""`gsvis serve`: serve packages to viewers until stopped. Logs go to stderr; with --json the address goes to stdout."""

from __future__ import annotations

import gc
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from gsvis.cli.arguments_serve import Serve
from gsvis.cli.terminal import print_json
from gsvis.errors import BackendError
from gsvis.files.limits import open_regular

__all__ = ["log_to_stderr", "run_serve"]


def run_serve(command: Serve) -> None:
    """Open the packages and serve them.

    Raises:
        FormatError: If no package can be opened because all are damaged.
        OSError: If the address is taken.
        ValueError: If an argument is wrong.
    """
    from gsvis.abr.config import AbrConfig
    from gsvis.serve import Address, AppConfig, JsonLines, Limits, Server, TextLines, open_scenes
    from gsvis.stream import Quality

    form = JsonLines() if command.log_format == "json" else TextLines()
    log_to_stderr(form, logging.DEBUG if command.debug else logging.INFO)
    limits = Limits(
        connections=command.clients, message_bytes=command.message_bytes, messages_per_s=float(command.messages),
        poses_per_s=float(command.poses), handshake_s=command.handshake, idle_s=command.idle, stall_s=command.stall,
        keep_alive_s=command.keep_alive, per_address=command.per_address,
    )  # fmt: skip
    token = command.token if command.token is not None else os.environ.get("GSVIS_TOKEN") or None
    abr = AbrConfig(policy=command.policy, fill=not command.no_fill)
    config = AppConfig(token, command.origins, limits, abr, command.hosts, command.proxies)
    address = Address(command.host, command.port, command.ssl_certfile, command.ssl_keyfile)
    for path in (command.ssl_certfile, command.ssl_keyfile):
        if path is not None:
            open_regular(path).close()  # an error of OpenSSL would not name the file
    quality = Quality() if command.coarse else None
    with open_scenes(command.package, max_cache_bytes=command.cache, warm=True, quality=quality) as scenes:
        try:
            server = Server(scenes, config, address, planners=command.planners)
        except OSError as error:
            if error.filename is None:  # OpenSSL rejects a certificate without naming the file
                raise BackendError(f"TLS: {error}; check --ssl-certfile and --ssl-keyfile") from error
            raise
        if command.json:
            print_json({"format": "gsvis-serving", "version": 1, "url": server.url, "scenes": list(scenes)})
            sys.stdout.flush()
        with _start_spared_by_gc(), suppress(KeyboardInterrupt):  # how a server ends
            server.run()


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


def log_to_stderr(form: logging.Formatter, level: int) -> None:
    """Write the log of a server to stderr: lines of gsvis from a level on, and warnings of uvicorn."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(form)
    for name, least in (("gsvis", level), ("uvicorn", logging.WARNING)):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [handler], False
        logger.setLevel(least)
