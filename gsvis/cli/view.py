"""`gsvis view`: show a scene in the browser. A package is streamed; any other scene is shown as it is, from files."""

from __future__ import annotations

import gc
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
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

from gsvis.cli.arguments import View
from gsvis.cli.options import PLACING, changed
from gsvis.cli.serve import log_to_stderr
from gsvis.cli.terminal import Status, print_json, say
from gsvis.cli.where import check_where
from gsvis.errors import GsvisError
from gsvis.files.apart import call_apart
from gsvis.files.shown import shown_name
from gsvis.files.temporary import temporary_folder
from gsvis.package.manifest import MANIFEST

if TYPE_CHECKING:
    from concurrent.futures import Future

    from gsvis.export.start import Visit
    from gsvis.export.static import StaticOptions
    from gsvis.scene.gaussians import Gaussians
    from gsvis.scene.navigable import NavigableSpace
    from gsvis.scene.paths import HeadPath
    from gsvis.scene.source import Source
    from gsvis.serve import Server
    from gsvis.serve.scenes import Scenes, ServedScene

    Sample = Future[tuple[Source, int] | None]

__all__ = ["run_view"]

Later = Callable[["Scenes"], None]
_PORT = 8765
_CACHE = 512_000_000
_LARGE = 500_000  # Gaussians of a scene of which a sample is shown first


def run_view(command: View) -> None:
    """Open a scene, serve it to this machine, and open the browser."""
    sample = _read_sample(command)
    from gsvis.serve import TextLines
    from gsvis.serve.scenes import Scenes

    failures: list[Exception] = []
    with ExitStack() as stack:
        stack.enter_context(log_to_stderr(TextLines(), logging.DEBUG if command.output.debug else logging.WARNING))
        with _uncollected():
            shown = _open(command, sample, stack)
        command = shown.command
        scene = shown.serve()
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
        beside = partial(_work_beside, shown, scenes, server, failures)
        threading.Thread(target=copy_context().run, args=(beside,), daemon=True).start()
        if not command.no_browser:
            # The server listens already; it answers as soon as it runs.
            threading.Thread(target=webbrowser.open, args=(_address(server, page),), daemon=True).start()
        with suppress(KeyboardInterrupt):
            server.run()
        failed = tuple(failures)  # what fails from here on fails because the folders go
    for error in failed:
        raise error


@contextmanager
def _uncollected() -> Iterator[None]:
    """Pause the garbage collector: modules make many objects, nearly all for good, and it takes a sixth of the time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _work_beside(shown: _Opened, scenes: Scenes, server: Server, failures: list[Exception]) -> None:
    """Do what is left to do while the scene is shown; an error ends the server, and is kept."""
    try:
        if shown.later is not None:
            shown.later(scenes)
    except Exception as error:
        failures.append(error)
        server.stop()


class _Opened(NamedTuple):
    """A scene that can be served.

    Attributes:
        command: The command, with answers of the user.
        folder: The folder to serve.
        name: The name in addresses; "" for that of the folder.
        remarks: Remarks for the user.
        later: What is left to do while the scene is shown; None for nothing.
        in_part: Gaussians of a sample that `later` writes, and that is shown until the whole is there; 0 without one.
    """

    command: View
    folder: Path
    name: str = ""
    remarks: Sequence[str] = ()
    later: Later | None = None
    in_part: int = 0

    def serve(self) -> ServedScene:
        """Return the scene for a server; a sample is waited for by those who ask."""
        from gsvis.serve.scenes import open_scene, promise_scene

        if self.in_part == 0:
            return open_scene(self.folder, self.name, max_cache_bytes=_CACHE)
        scene = promise_scene(self.folder, self.name, self.in_part)
        scene.preparing = True
        return scene


def _read_sample(command: View) -> Sample | None:
    """Begin to read a sample of a PLY in a thread of its own; None for other scenes, and for those to prepare.

    The sample is not there yet, and None if the scene is not large. The thread imports nothing: what it needs is
    imported before, so that two threads never import modules that need each other.
    """
    if command.prepare is not None or Path(command.scene).suffix.lower() != ".ply":
        return None
    import_module("numpy.random")
    import_module("gsvis.io.ply")
    from gsvis.io.sources import glance_at

    return call_apart(partial(copy_context().run, glance_at, command.scene, _LARGE), "gsvis-sample")


def _import_meanwhile() -> None:
    """Import what finds where people stand, while another thread reads the file."""
    for name in ("scipy.ndimage", "scipy.spatial", "gsvis.export.static", "gsvis.export.start"):
        import_module(name)
    from gsvis._kernels.compiled import load_numba

    load_numba()


def _open(command: View, sample: Sample | None, stack: ExitStack) -> _Opened:
    """Return what to serve: a package, a world and a static scene as they are, any other from a temporary folder.

    Args:
        command: The command.
        sample: What `_read_sample` returns.
        stack: Removes temporary folders at the end.
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
        return _Opened(command, path)
    from gsvis.cli.asking import settle_stay
    from gsvis.cli.source import open_source
    from gsvis.export.later_walk import promise_walk
    from gsvis.export.static import write_static
    from gsvis.io.sources import check_source, title_of

    walk = _check_scene(command)
    with Status() as status:
        check_source(command.scene, command.lod)
        if sample is not None:
            _import_meanwhile()
        glance = None if sample is None else sample.result()
        source = open_source(command.scene, command.lod, status) if glance is None else glance[0]
        folder = Path(stack.enter_context(temporary_folder()))
        settled, plan = settle_stay(command.where, source, walk, status, quiet=command.output.json)
        command = replace(command, where=settled.where)
        name = title_of(command.scene)
        if glance is not None:
            whole = Path(stack.enter_context(temporary_folder()))
            note = f" first {len(source.gaussians):,} of {glance[1]:,} Gaussians; all of them follow by themselves"
            later = partial(_show_sample, command, source, plan, folder, whole)
            return _Opened(command, folder, name, [*settled.remarks, note], later, len(source.gaussians))
        visit = plan()
        write_static(folder, source.whole, _options(command, visit, source.lod), progress=status)
        if visit.space is None:
            return _Opened(command, folder, name, visit.remarks)
        promise_walk(folder)
    return _Opened(
        command, folder, name, visit.remarks, partial(_write_walk, folder, source.gaussians, visit.space, name)
    )


def _options(command: View, visit: Visit, lod: int | None) -> StaticOptions:
    """Return how a scene is written."""
    from gsvis.export.static import StaticOptions
    from gsvis.io.sources import title_of
    from gsvis.serve.server import is_loopback

    x, y, z = visit.up.tolist()
    name = title_of(command.scene, lod)
    return StaticOptions(name, (x, y, z), poses=visit.starts, most_sets=None, is_near=is_loopback(command.host))


def _show_sample(
    command: View, sample: Source, plan: Callable[[], Visit], folder: Path, whole: Path, scenes: Scenes
) -> None:
    """Write the sample of a large scene, for which pages wait, and then the whole of it.

    Args:
        command: The command.
        sample: The sample.
        plan: Finds the first views.
        folder: Where the sample is written.
        whole: Where all of the scene is written.
        scenes: The scenes that are served.
    """
    from gsvis.export.static import write_static
    from gsvis.io.sources import title_of

    visit = plan()
    shown = _options(command, visit, sample.lod)
    write_static(folder, sample.whole, shown)
    site = scenes[title_of(command.scene)].site
    assert site is not None, "the sample is a static scene"
    site.read()
    _show_all(command, whole, shown, visit.space, scenes)


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
