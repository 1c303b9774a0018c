"""nginx as Debian ships it, for tests: one process, all of its files in one folder."""

from __future__ import annotations

import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.serve.servers import until

__all__ = ["GUARD_S", "NGINX", "free_port", "nginx"]

NGINX = shutil.which("nginx") or shutil.which("/usr/sbin/nginx")
GUARD_S = 120.0

_FRAME = """\
daemon off;
master_process off;
pid {folder}/nginx.pid;
error_log {folder}/error.log;
events {{ worker_connections 128; }}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    include {folder}/site.conf;
}}
"""


def free_port() -> int:
    """Return a port of 127.0.0.1 that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@contextmanager
def nginx(folder: Path, site: str, port: int) -> Iterator[None]:
    """nginx with a site that listens on a port; its files are in `folder`."""
    (folder / "site.conf").write_text(site)
    (folder / "nginx.conf").write_text(_FRAME.format(folder=folder))
    running = subprocess.Popen(
        [str(NGINX), "-p", str(folder), "-c", str(folder / "nginx.conf"), "-e", str(folder / "error.log")],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip

    def answers() -> bool:
        assert running.poll() is None, (folder / "error.log").read_text()
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=GUARD_S):
            return True
        return False

    try:
        until(answers, GUARD_S)
        yield
    finally:
        running.kill()
        running.communicate()
