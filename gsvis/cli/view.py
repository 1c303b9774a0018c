"""`gsvis view`: show a scene in the browser. A package is streamed; any other scene is shown as it is, from files."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from gsvis.cli.arguments import View
from gsvis.cli.options import PLACING, changed
from gsvis.cli.serve import log_to_stderr
from gsvis.cli.terminal import Status, print_json, say
from gsvis.cli.where import check_where
from gsvis.errors import GsvisError
from gsvis.files.shown import shown_name
from gsvis.files.temporary import temporary_folder
from gsvis.package.manifest import MANIFEST

if TYPE_CHECKING:
    from gsvis.scene.gaussians import Gaussians
    from gsvis.scene.navigable import NavigableSpace
    from gsvis.scene.paths import HeadPath
    from gsvis.serve import Server
    from gsvis.serve.scenes import Scenes

__all__ = ["run_view"]

Later = Callable[[], None]
_PORT = 8765
_CACHE = 512_000_000


def run_view(command: View) -> None:
    """Open a scene, serve it to this machine, and open the browser."""
    from gsvis.serve import TextLines
    from gsvis.serve.scenes import Scenes, open_scene

    with ExitStack() as stack:
        stack.enter_context(log_to_stderr(TextLines(), logging.DEBUG if command.output.debug else logging.WARNING))
        command, folder, name, remarks, later = _folder_of(command, stack)
        scene = open_scene(folder, name, max_cache_bytes=_CACHE)
        scenes = stack.enter_context(Scenes([scene]))
        name = scene.name
        server = _listen(command, scenes)
        stack.enter_context(_preparing(command, scenes, name))
        page = server.page(name)
        if command.output.json:
            found = {"format": "gsvis-viewing", "version": 1, "url": page, "stream": server.url, "scene": name}
            print_json(found | {"remarks": [each.strip() for each in remarks]})
            sys.stdout.flush()
        else:
            for each in remarks:
                say(each.strip())
            say(f"{page} shows {shown_name(command.scene)}; Ctrl-C ends it")
        if later is not None:
            threading.Thread(target=later, daemon=True).start()
        if not command.no_browser:
            # The server listens already; it answers as soon as it runs.
            threading.Thread(target=webbrowser.open, args=(_address(server, page),), daemon=True).start()
        with suppress(KeyboardInterrupt):
            server.run()


def _folder_of(command: View, stack: ExitStack) -> tuple[View, Path, str, list[str], Later | None]:
    """Return the command with answers of the user, the folder to serve, the name in addresses, remarks, what is left.

    A package, a world and a static scene are served from their folder, which gives the name ("" here); any other scene
    from a temporary one. What is left to do, if anything, is done while the scene is shown.
    """
    from gsvis.serve.sites import is_site
    from gsvis.world.world import is_world

    path = Path(command.scene)
    if (path / MANIFEST).is_file() or is_site(path) or is_world(path):
        for option, words in changed(command, ("lod", "prepare", *PLACING)).items():
            got = " ".join(words) or option
            raise ValueError(
                f"{option}: expected none for a package, a world or a static scene, got {got}; leave it out"
            )
        return command, path, "", [], None
    from gsvis.cli.asking import settle_visit
    from gsvis.cli.source import open_source
    from gsvis.export.later_walk import promise_walk
    from gsvis.export.static import StaticOptions, write_static
    from gsvis.io.sources import title_of

    walk = _check_scene(command)
    with Status() as status:
        source = open_source(command.scene, command.lod, status)
        folder = Path(stack.enter_context(temporary_folder()))
        where, visit = settle_visit(command.where, source, walk, status, quiet=command.output.json)
        command = replace(command, where=where)
        x, y, z = visit.up.tolist()
        name = title_of(command.scene, source.lod)
        shown = StaticOptions(name, (x, y, z), poses=visit.starts, most_sets=None)
        write_static(folder, source.whole, shown, progress=status)
        later = None
        if visit.space is not None:
            promise_walk(folder)
            later = partial(_write_walk, folder, source.gaussians, visit.space)
    return command, folder, title_of(command.scene), visit.remarks, later


def _write_walk(folder: Path, g: Gaussians, space: NavigableSpace) -> None:
    """Write where one can walk in the scene that is shown; nothing once the folder is gone with the command."""
    from gsvis.export.later_walk import write_walk

    with suppress(GsvisError, OSError):
        write_walk(folder, g, space)


def _check_scene(command: View) -> HeadPath | None:
    """Check the options of a scene that is no package, before it is read; return the walk of --path."""
    from gsvis.files.output import check_folder

    walk = check_where(command.where)
    if command.prepare is not None:
        if os.path.lexists(command.prepare):
            raise ValueError(f"--prepare: expected a new folder, got {command.prepare}, which exists; name another")
        check_folder(Path(command.prepare).absolute().parent)
    return walk


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
    words = [sys.executable, "-m", "gsvis", "prepare", command.scene, "-o", command.prepare]
    for option, values in changed(command, ("lod", *PLACING, "drop_invalid")).items():
        words += [option, *(value.strip() for value in values)]
    scenes[name].preparing, ending = True, threading.Event()
    nobody = subprocess.DEVNULL  # it must not ask while the scene is shown
    nice = _be_nice if os.name == "posix" else None
    running = subprocess.Popen(words, stdin=nobody, stdout=nobody, preexec_fn=nice)
    waiting = threading.Thread(target=_change_over, args=(running, scenes, name, command.prepare, ending), daemon=True)
    waiting.start()
    try:
        yield
    finally:
        ending.set()
        running.terminate()  # does nothing to a process that has ended
        waiting.join()  # it must not add a scene after these are closed


def _be_nice() -> None:
    """Let other processes go first."""
    os.nice(10)


def _change_over(
    running: subprocess.Popen[bytes], scenes: Scenes, name: str, package: str, ending: threading.Event
) -> None:
    """Serve the package in place of the scene as soon as it is ready, unless the server ends before."""
    from gsvis.serve.scenes import open_scene

    code = running.wait()
    if ending.is_set():
        return
    try:
        if code == 0:
            scenes.replace(open_scene(package, name, max_cache_bytes=_CACHE, warm=True))
            line = "is prepared and served from now on"
        else:
            line = "was not prepared; the scene is shown as it is"
    except (GsvisError, OSError) as error:
        line = f"cannot be served: {error}"
    scenes[name].preparing = False
    say(f"{package} {line}")
