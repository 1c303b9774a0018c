"""The scenes of a server, packages and worlds by name, open while they have viewers. A damaged one is refused.

With a folder of kept tables a scene opens in milliseconds, so one without viewers is closed after a while and opened
again for the next viewer. Without such a folder scenes stay open.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._text import as_line
from gsvis.abr.classes import FieldOfView
from gsvis.errors import GsvisError
from gsvis.package import Package
from gsvis.serve._log import LOGGER, EventLog
from gsvis.serve.sites import Site, is_site
from gsvis.stream import Hello, Quality, Session, StreamedScene
from gsvis.stream.kept import KeptTables, open_kept
from gsvis.world import is_world

__all__ = ["Scenes", "ServedScene", "name_of", "open_scene", "open_scenes", "promise_scene"]


_REACH = 100.0
_WALK = 8  # cells that a warm-up visits
_FULL = 0.9  # share of the cache at which warming up stops
Opened = tuple[StreamedScene, KeptTables | None]
_PIECE = 65536.0  # bytes that a warm-up sends in each cell


@dataclass(eq=False)
class ServedScene:
    """A package, or a static scene, under the name that clients ask for. Threads may share it.

    Attributes:
        name: Name in addresses.
        path: Folder of the package or of the static scene.
        opened: The scene, ready to send; None while it is closed, if it could not be opened, or is a static scene.
        fault: Why the scene is refused; "" while it is served. Only for the log: it may name files.
        site: Files of a static scene, which a viewer reads by itself; None for a package.
        preparing: Whether a package is being prepared that will take its place; its page asks again until then.
        tables: The kept tables of the open scene; None if it is in memory.
        reopen: Opens the scene again after it was closed; None if it is never closed.
        users: Who uses the open scene now: viewers and questions.
        used_at: When the last of them left, seconds of the server's clock.
        openings: How often the scene was opened.
        sessions: The sessions of its viewers.
    """

    name: str
    path: Path
    opened: StreamedScene | None
    fault: str = ""
    site: Site | None = None
    preparing: bool = False
    tables: KeptTables | None = None
    reopen: Callable[[], Opened] | None = None
    users: int = field(default=0, init=False)
    used_at: float = field(default=0.0, init=False)
    openings: int = field(default=0, init=False)
    sessions: set[Session] = field(default_factory=set, init=False)

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._is_world = False
        self._facts: tuple[int, int, NDArray[np.float64]] | None = None
        if self.opened is not None:
            self._note(self.opened)

    @property
    def is_streamed(self) -> bool:
        """Whether the scene is a package that could be opened."""
        return self.opened is not None or self._facts is not None

    @property
    def is_world(self) -> bool:
        """Whether the scene is a world of several packages, whose files are not served one by one."""
        return self._is_world

    @property
    def gaussians(self) -> int | None:
        """Number of Gaussians; None if it is not known."""
        return self._facts[0] if self._facts else self.site.gaussians if self.site else None

    @property
    def scene(self) -> StreamedScene:
        """The scene.

        Raises:
            RuntimeError: If the scene is closed, could not be opened, or is a static one.
        """
        if self.opened is None:
            raise RuntimeError(f"{self.name} is not open")
        return self.opened

    @property
    def most_hello(self) -> int:
        """Most bytes of a HELLO for this scene, or for a package that may take the place of a static one."""
        return self._facts[1] if self._facts else (1 << 16) + 2 * (self.gaussians or 0)

    def use(self) -> StreamedScene:
        """Return the scene and keep it open until `leave`; open it if it is closed, which may take a while.

        Raises:
            RuntimeError: If the scene could not be opened at the start, or is a static one.
            GsvisError: If the package cannot be opened any more.
            OSError: If the package cannot be read.
        """
        with self._lock:
            if self.opened is None and self.reopen is not None and self.is_streamed:
                self.opened, self.tables = self.reopen()
                self._note(self.opened)
            self.users += self.opened is not None
            return self.scene

    def leave(self, now: float) -> None:
        """Say that the scene is no longer used, once for each `use`."""
        with self._lock:
            self.users = self.users - 1
            self.used_at = now

    @contextmanager
    def in_use(self, now: Callable[[], float]) -> Iterator[StreamedScene]:
        """Keep the scene open in the block; `now` is the server's clock."""
        scene = self.use()
        try:
            yield scene
        finally:
            self.leave(now())

    def close_unused(self, now: float, after_s: float) -> bool:
        """Close the scene if nobody has used it for so many seconds and it can be opened again; return whether."""
        if not self._lock.acquire(blocking=False):  # a thread is opening it
            return False
        try:
            if self.users or self.opened is None or self.reopen is None or now - self.used_at < after_s:
                return False
            self.opened.source.close()
            self.opened = self.tables = None
            return True
        finally:
            self._lock.release()

    def within(self, position: ArrayLike) -> NDArray[np.float64]:
        """Return a position clamped to a hundred times the size of the scene, where arithmetic is still accurate."""
        assert self._facts is not None, "a viewer of a scene has opened it"
        low, high = self._facts[2]  # `np.clip` takes five times as long
        return np.asarray(np.minimum(np.maximum(position, low), high), np.float64)

    def _note(self, scene: StreamedScene) -> None:
        """Remember what clients may ask about the scene while it is closed."""
        self.openings += 1
        self._is_world = not scene.source.is_single
        grid = scene.index.grid
        low = grid.centers.min(axis=0) - grid.cell_size
        high = grid.centers.max(axis=0) + grid.cell_size
        reach = _REACH * float((high - low).max())
        self._facts = scene.about.gaussians, scene.most_hello, np.stack([low - reach, high + reach])

    def warm_up(self) -> None:
        """Load what the first viewers would wait for: compiled kernels, and as many cells as the cache holds.

        Raises:
            FormatError: If a part that is read is damaged.
        """
        scene = self.scene
        grid = self.scene.index.grid
        view = FieldOfView.from_degrees(90.0, 70.0, margin=8.0)
        holdings = b""
        for _ in range(2):  # a new viewer, and one that reconnects
            session = Session.from_hello(scene, Hello(view, bytes.fromhex(scene.about.identity), holdings))
            session.welcome(0.0)
            stops = [*grid.centers[:1], *grid.centers[:_WALK]]  # the first twice: a second plan needs other kernels
            for k, center in enumerate(stops):
                session.on_pose(0.1 * k, center, (1.0, 0.1 * k, 0.0, 0.0))
                message = session.next_message(0.1 * k + 0.02, _PIECE)
                session.on_ack(0.1 * k + 0.05, message.sequence if message is not None else 0)
            holdings = session.holdings.to_bytes()
        for cell in range(len(grid) if self.reopen is None else 0):  # else memory follows what viewers look at
            if scene.candidates.cache.fill > _FULL:
                break
            scene.candidates.in_cell(cell)

    def refuse(self, line: str) -> None:
        """Refuse the scene to new viewers from now on."""
        self.fault = line


class Scenes(Mapping[str, ServedScene]):
    """Scenes by name, in their order; closed together.

    Args:
        served: The scenes.
    """

    def __init__(self, served: Iterable[ServedScene]) -> None:
        self._served = {scene.name: scene for scene in served}
        self._former: list[ServedScene] = []

    def replace(self, scene: ServedScene) -> None:
        """Serve a scene under its name from now on; viewers of the former scene keep it until `close`."""
        former = self._served.get(scene.name)
        self._served[scene.name] = scene
        if former is not None:
            self._former.append(former)

    def __getitem__(self, name: str) -> ServedScene:
        return self._served[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._served)

    def __len__(self) -> int:
        return len(self._served)

    def __enter__(self) -> Scenes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the packages; the scenes must not be served after that."""
        for scene in (*self.values(), *self._former):
            if scene.opened is not None:
                scene.opened.source.close()


def name_of(package: str | PathLike[str]) -> str:
    """Return the name under which clients ask for a package: that of its folder up to the first dot, on one line."""
    return as_line(Path(package).resolve().name.partition(".")[0]) or "scene"


def open_scenes(
    packages: Sequence[str | PathLike[str]],
    *,
    max_cache_bytes: int = 512 << 20,
    warm: bool = False,
    quality: Quality | None = None,
    terms: str = "pose",
    tables: str | PathLike[str] | None = None,
    log: EventLog | None = None,
) -> Scenes:
    """Open packages; keep a damaged one as refused, so that the others can be served.

    Args:
        packages: Folders of packages, or of static scenes (`gsvis export --format static`). The name of a scene is that
            of its folder without suffix.
        max_cache_bytes: Most bytes of decoded data of cells, for all scenes together.
        warm: Whether to load what the first viewers would wait for; takes some seconds for a large scene.
        quality: How to round records before they are sent; None means not at all.
        terms: Which terms are sent: one of `gsvis.stream.scene.TERMS`.
        tables: Folder for kept tables (`gsvis.stream.kept`); None decodes scenes into memory and never closes them.
        log: Log of events.

    Returns:
        Scenes by name, in the order given; the caller closes them.

    Raises:
        ValueError: If no package is given, or two have the same name.
        GsvisError: If no package can be opened.
        OSError: If no package can be opened, because of the file system.
        Exception: If no package can be opened, because of another fault.
    """
    if not packages:
        raise ValueError("packages: expected at least one, got none")
    log = log or EventLog()
    found: dict[str, ServedScene] = {}
    first: Exception | None = None
    for package in packages:
        path = _check.path("package", package)
        name = name_of(path)
        if name in found:
            raise ValueError(f"packages: expected different names, got {name!r} twice; rename a folder")
        try:
            share = max_cache_bytes // len(packages)
            served = open_scene(
                path, name, max_cache_bytes=share, warm=warm, quality=quality, terms=terms, tables=tables
            )
        except Exception as error:  # a reader that fails in a way of its own must not keep the others from being served
            expected = isinstance(error, GsvisError | OSError)
            why = str(error) if expected else f"{type(error).__name__}: {error}"
            first = first or error
            log("damaged", logging.ERROR, scene=name, why=why)
            LOGGER.debug("scene %s", name, exc_info=None if expected else error)
            found[name] = ServedScene(name, path, None, why)
            continue
        found[name] = served
        _report(served, log)
    if first is not None and all(served.fault for served in found.values()):
        raise first
    return Scenes(found.values())


def open_scene(
    path: str | PathLike[str],
    name: str = "",
    *,
    max_cache_bytes: int = 512 << 20,
    warm: bool = False,
    quality: Quality | None = None,
    terms: str = "pose",
    tables: str | PathLike[str] | None = None,
) -> ServedScene:
    """Open one package or static scene.

    Args:
        path: The folder.
        name: Name in addresses; "" takes that of the folder without suffix.
        max_cache_bytes: Most bytes of decoded data of cells.
        warm: Whether to load what the first viewers would wait for.
        quality: How to round records before they are sent; None means not at all.
        terms: Which terms are sent: one of `gsvis.stream.scene.TERMS`.
        tables: Folder for kept tables; None decodes the scene into memory.

    Raises:
        GsvisError: If it cannot be opened.
        OSError: If it cannot be opened, because of the file system.
    """
    folder = _check.path("path", path)
    name = name or name_of(folder)
    if is_site(folder):
        return ServedScene(name, folder, None, site=Site(folder))

    def reopen() -> Opened:
        """Open the package or world."""
        scene, kept = open_any()
        return scene.sending(terms), kept

    def open_any() -> Opened:
        """Open the package or world, with terms chosen by pose."""
        if is_world(folder):
            from gsvis.world.streamed import open_world  # seldom needed

            return open_world(folder, tables=tables, max_cache_bytes=max_cache_bytes, quality=quality)
        package = Package.open(folder)
        try:
            if tables is None:
                return StreamedScene.open(package, max_cache_bytes=max_cache_bytes, quality=quality), None
            return open_kept(package, tables, max_cache_bytes=max_cache_bytes, quality=quality)
        except BaseException:
            package.close()
            raise

    scene, kept = reopen()
    served = ServedScene(name, folder, scene, tables=kept, reopen=None if kept is None else reopen)
    try:
        if warm:
            served.warm_up()
        return served
    except BaseException:
        scene.source.close()
        raise


def promise_scene(folder: str | PathLike[str], name: str, gaussians: int) -> ServedScene:
    """Return a static scene that is still being written: whoever asks for it waits. `Site.read` ends that.

    Args:
        folder: The folder that it is written to.
        name: Name in addresses.
        gaussians: Number of its Gaussians.
    """
    path = _check.path("folder", folder)
    return ServedScene(name, path, None, site=Site(path, gaussians))


def _report(served: ServedScene, log: EventLog) -> None:
    """Log that a scene is ready."""
    if served.opened is None:
        log("ready", scene=served.name, gaussians=served.gaussians, form="static")
        return
    about = served.opened.about
    log("ready", scene=served.name, gaussians=about.gaussians, terms=about.terms, cells=len(served.opened.index.grid))
