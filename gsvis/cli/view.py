"""`gsvis view`: show a scene in the browser. A package is streamed; any other scene is shown as it is, from files."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from gsvis.cli.arguments_view import View
from gsvis.cli.terminal import Status, print_json
from gsvis.errors import GsvisError
from gsvis.package.manifest import MANIFEST

if TYPE_CHECKING:
    from gsvis.serve import Server
    from gsvis.serve.scenes import Scenes

__all__ = ["run_view"]

_PORT = 8765
_CACHE = 512_000_000
_IN_FOLDERS = ("lod-meta.json", "meta.json")  # files that are named by their folder


def run_view(command: View) -> None:
    """Open a scene, serve it to this machine, and open the browser.

    Raises:
        GsvisError: If the scene cannot be read.
        ValueError: If an argument is wrong.
        FileNotFoundError: If there is no such file.
        OSError: If the address is taken, or there is no room for temporary files.
    """
    from gsvis.serve import TextLines, open_scenes

    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(TextLines())
    for name in ("gsvis", "uvicorn"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [handler], False
        logger.setLevel(logging.DEBUG if command.debug else logging.WARNING)
    with ExitStack() as stack:
        folder = _folder_of(command, stack)
        scenes = stack.enter_context(open_scenes([folder], max_cache_bytes=_CACHE))
        (name,) = scenes
        server = _listen(command, scenes)
        stack.enter_context(_preparing(command, scenes, name))
        page = server.page(name)
        if command.json:
            print_json({"format": "gsvis-viewing", "version": 1, "url": page, "stream": server.url, "scene": name})
            sys.stdout.flush()
        else:
            sys.stderr.write(f"gsvis: {page} shows {command.scene}; Ctrl-C ends it\n")
        if not command.no_browser:
            # The server listens already; it answers as soon as it runs.
            threading.Thread(target=webbrowser.open, args=(_address(server, page),), daemon=True).start()
        with suppress(KeyboardInterrupt):
            server.run()


def _folder_of(command: View, stack: ExitStack) -> Path:
    """Return the folder to serve: that of a package or of a static scene, or a temporary one for any other scene."""
    given = Path(command.scene)
    if (given / MANIFEST).is_file() or (given / "scene.json").is_file():
        for option, value in (("--lod", command.lod), ("--up", command.up), ("--prepare", command.prepare)):
            if value is not None:
                raise ValueError(f"{option}: expected none for a package or a static scene, got {value}; leave it out")
        return given
    from gsvis.cli.source import check_new, load_source, parse_up
    from gsvis.export.static import StaticOptions, write_static
    from gsvis.scene.inspection import axis_vector, guess_up

    up = parse_up(command.up)
    if command.prepare is not None:
        check_new(Path(command.prepare), False)
    with Status() as status:
        status("reading", 0, 1)
        source = load_source(command.scene, command.lod)
        status("reading", 1, 1)
        if up is None:
            known = source.navigable.up if source.navigable is not None else None
            up = axis_vector(guess_up(source.gaussians)[0]) if known is None else known
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gsvis-view-"))) / _name_of(command.scene)
        x, y, z = (float(value) for value in up)
        write_static(folder, source.whole, StaticOptions(source.name, (x, y, z)), progress=status)
    return folder


def _name_of(scene: str) -> str:
    """Return a name for addresses: that of the file or folder, without suffixes. A streamed scene has its folder's."""
    if scene.startswith("builtin:"):
        return scene.rpartition(":")[2] or "scene"
    path = Path(scene).resolve()
    named = path.parent if path.name in _IN_FOLDERS else path
    return named.name.partition(".")[0] or "scene"


def _listen(command: View, scenes: Scenes) -> Server:
    """Return a server on the port, or on a free one where the usual one is taken."""
    from gsvis.serve import Address, AppConfig, Server

    config = AppConfig(os.environ.get("GSVIS_TOKEN") or None)
    try:
        return Server(scenes, config, Address(command.host, _PORT if command.port is None else command.port))
    except OSError:
        if command.port is not None:
            raise
        return Server(scenes, config, Address(command.host, 0))


def _address(server: Server, page: str) -> str:
    """Return the address to open: with the token, which the server takes out of it again."""
    token = server.config.token
    return page if token is None else f"{page}?token={quote(token, safe='')}"


@contextmanager
def _preparing(command: View, scenes: Scenes, name: str) -> Iterator[None]:
    """Prepare the scene in a process of its own, with what the server leaves of the machine; stop it at the end."""
    if command.prepare is None:
        yield
        return
    words = [sys.executable, "-m", "gsvis.cli", "prepare", command.scene, "-o", command.prepare]
    words += [] if command.lod is None else ["--lod", str(command.lod)]
    words += [] if command.up is None else ["--up", command.up.strip()]
    running = subprocess.Popen(words, stdout=subprocess.DEVNULL, preexec_fn=_be_nice if os.name == "posix" else None)
    threading.Thread(target=_change_over, args=(running, scenes, name, command.prepare), daemon=True).start()
    try:
        yield
    finally:
        if running.poll() is None:
            running.terminate()
        running.wait()


def _be_nice() -> None:
    os.nice(10)


def _change_over(running: subprocess.Popen[bytes], scenes: Scenes, name: str, package: str) -> None:
    """Serve the package in place of the scene as soon as it is ready."""
    from gsvis.serve.scenes import open_scene

    if running.wait() != 0:
        sys.stderr.write(f"gsvis: {package} was not prepared; the scene is shown as it is\n")
        return
    try:
        scenes.replace(open_scene(package, name, max_cache_bytes=_CACHE, warm=True))
    except (GsvisError, OSError) as error:
        sys.stderr.write(f"gsvis: {package} cannot be served: {error}\n")
        return
    sys.stderr.write(f"gsvis: {package} is prepared and served from now on\n")
