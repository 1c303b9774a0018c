"""`gsvis view`: show a scene in the browser. A package is streamed; any other scene is shown as it is, from files."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from contextvars import copy_context
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
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
    from gsvis.export.static import StaticOptions
    from gsvis.scene.gaussians import Gaussians
    from gsvis.scene.navigable import NavigableSpace
    from gsvis.scene.paths import HeadPath
    from gsvis.serve import Server
    from gsvis.serve.scenes import Scenes

__all__ = ["run_view"]

Later = Callable[["Scenes"], None]
_PORT = 8765
_CACHE = 512_000_000
_LARGE = 500_000  # Gaussians of a scene of which a sample is shown first


def run_view(command: View) -> None:
    """Open a scene, serve it to this machine, and open the browser."""
    from gsvis.serve import TextLines
    from gsvis.serve.scenes import Scenes, open_scene

    with ExitStack() as stack:
        stack.enter_context(log_to_stderr(TextLines(), logging.DEBUG if command.output.debug else logging.WARNING))
        shown = _open(command, stack)
        command = shown.command
        scene = open_scene(shown.folder, shown.name, max_cache_bytes=_CACHE)
        scene.preparing = shown.in_part
        scenes = stack.enter_context(Scenes([scene]))
        name = scene.name
        server = _listen(command, scenes)
        stack.enter_context(_preparing(command, scenes, name))
        page = server.page(name)
        if command.output.json:
            found = {"format": "gsvis-viewing", "version": 1, "url": page, "stream": server.url, "scene": name}
            print_json(found | {"remarks": [each.strip() for each in shown.remarks]})
            sys.stdout.flush()
        else:
            for each in shown.remarks:
                say(each.strip())
            say(f"{page} shows {shown_name(command.scene)}; Ctrl-C ends it")
        if shown.later is not None:
            threading.Thread(target=copy_context().run, args=(shown.later, scenes), daemon=True).start()
        if not command.no_browser:
            # The server listens already; it answers as soon as it runs.
            threading.Thread(target=webbrowser.open, args=(_address(server, page),), daemon=True).start()
        with suppress(KeyboardInterrupt):
            server.run()


class _Opened(NamedTuple):
    """A scene that can be served.

    Attributes:
        command: The command, with answers of the user.
        folder: The folder to serve.
        name: The name in addresses; "" for that of the folder.
        remarks: Remarks for the user.
        later: What is left to do while the scene is shown; None for nothing.
        in_part: Whether a sample is shown until the whole is there.
    """

    command: View
    folder: Path
    name: str = ""
    remarks: Sequence[str] = ()
    later: Later | None = None
    in_part: bool = False


def _open(command: View, stack: ExitStack) -> _Opened:
    """Return what to serve: a package, a world and a static scene as they are, any other from a temporary folder."""
    from gsvis.serve.sites import is_site
    from gsvis.world.world import is_world

    path = Path(command.scene)
    if (path / MANIFEST).is_file() or is_site(path) or is_world(path):
        for option, words in changed(command, ("lod", "prepare", *PLACING)).items():
            got = " ".join(words) or option
            raise ValueError(
                f"{option}: expected none for a package, a world or a static scene, got {got}; leave it out"
            )
        return _Opened(command, path)
    from gsvis.cli.asking import settle_visit
    from gsvis.cli.source import open_source
    from gsvis.export.later_walk import promise_walk
    from gsvis.export.static import StaticOptions, write_static
    from gsvis.io.sources import check_source, glance_at, title_of
    from gsvis.serve.server import is_loopback

    walk = _check_scene(command)
    with Status() as status:
        check_source(command.scene, command.lod)
        glance = None if command.prepare is not None else glance_at(command.scene, _LARGE)
        source = open_source(command.scene, command.lod, status) if glance is None else glance[0]
        folder = Path(stack.enter_context(temporary_folder()))
        where, visit = settle_visit(command.where, source, walk, status, quiet=command.output.json)
        command = replace(command, where=where)
        x, y, z = visit.up.tolist()
        name = title_of(command.scene, source.lod)
        near = is_loopback(command.host)
        shown = StaticOptions(name, (x, y, z), poses=visit.starts, most_sets=None, is_near=near)
        write_static(folder, source.whole, shown, progress=status)
        if visit.space is not None and glance is None:
            promise_walk(folder)
    remarks = list(visit.remarks)
    later: Later | None = None
    if glance is not None:
        whole = Path(stack.enter_context(temporary_folder()))
        later = partial(_show_all, command, whole, shown, visit.space)
        remarks.append(f" first {len(source.gaussians):,} of {glance[1]:,} Gaussians; all of them follow by themselves")
    elif visit.space is not None:
        later = partial(_write_walk, folder, source.gaussians, visit.space, title_of(command.scene))
    return _Opened(command, folder, title_of(command.scene), remarks, later, glance is not None)


def _show_all(command: View, folder: Path, shown: StaticOptions, space: NavigableSpace | None, scenes: Scenes) -> None:
    """Serve the whole scene in place of the sample that is shown, as soon as it is read and written to a folder."""
    from gsvis.export.later_walk import promise_walk
    from gsvis.export.static import write_static
    from gsvis.io.sources import load_source, title_of
    from gsvis.serve.scenes import open_scene

    name = title_of(command.scene)
    try:
        source = load_source(command.scene, command.lod)
        write_static(folder, source.whole, shown)
        if space is not None:
            promise_walk(folder)
        scenes.replace(open_scene(folder, name, max_cache_bytes=_CACHE))
    except (GsvisError, OSError, MemoryError) as error:
        scenes[name].preparing = False
        why = "the memory does not suffice for all of it" if isinstance(error, MemoryError) else error
        say(f"{shown_name(command.scene)} is shown in part: {why}")
        return
    if space is not None:
        _write_walk(folder, source.gaussians, space, name, scenes)


def _write_walk(folder: Path, g: Gaussians, space: NavigableSpace, name: str, scenes: Scenes) -> None:
    """Write where one can walk in the scene that is shown, when pages have the scene itself.

    Nothing is written once the folder is gone with the command.
    """
    from gsvis.export.later_walk import write_walk

    site = scenes[name].site
    if site is not None:
        site.wait_until_quiet()
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
