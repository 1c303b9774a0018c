"""The scenes of a server: packages by name, opened once. A scene that proves damaged is refused from then on."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr.classes import FieldOfView
from gsvis.errors import GsvisError
from gsvis.package import Package
from gsvis.serve._log import LOGGER, EventLog
from gsvis.serve.sites import Site, is_site
from gsvis.stream import Hello, Quality, Session, StreamedScene

__all__ = ["Scenes", "ServedScene", "open_scene", "open_scenes"]


_REACH = 100.0
_WALK = 8  # cells that a warm-up visits
_FULL = 0.9  # share of the cache at which warming up stops
_PIECE = 65536.0  # bytes that a warm-up sends in each cell


@dataclass(eq=False)
class ServedScene:
    """A package, or a static scene, under the name that clients ask for.

    Attributes:
        name: Name in addresses.
        path: Folder of the package or of the static scene.
        opened: The scene, ready to send; None if it could not be opened, or is a static scene.
        fault: Why the scene is refused; "" while it is served. Only for the log: it may name files.
        site: Files of a static scene, which a viewer reads by itself; None for a package.
        preparing: Whether a package is being prepared that will take its place; its page asks again until then.
    """

    name: str
    path: Path
    opened: StreamedScene | None
    fault: str = ""
    site: Site | None = None
    preparing: bool = False

    @property
    def gaussians(self) -> int | None:
        """Number of Gaussians; None if it is not known."""
        return self.opened.about.gaussians if self.opened else self.site.gaussians if self.site else None

    @property
    def scene(self) -> StreamedScene:
        """The scene.

        Raises:
            RuntimeError: If the scene could not be opened, or is a static one.
        """
        if self.opened is None:
            raise RuntimeError(f"{self.name} is not open")
        return self.opened

    @property
    def most_hello(self) -> int:
        """Most bytes of a HELLO for this scene, or for a package that may take the place of a static one."""
        if self.opened is not None:
            return self.opened.most_hello
        return (1 << 16) + 2 * (self.gaussians or 0)

    def within(self, position: ArrayLike) -> NDArray[np.float64]:
        """Return a position clamped to a hundred times the size of the scene, where arithmetic is still accurate."""
        return np.clip(np.asarray(position, np.float64), *self._bounds)

    @cached_property
    def _bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        grid = self.scene.index.grid
        low, high = grid.centers.min(axis=0) - grid.cell_size, grid.centers.max(axis=0) + grid.cell_size
        reach = _REACH * float((high - low).max())
        return low - reach, high + reach

    def warm_up(self) -> None:
        """Load what the first viewers would wait for: compiled kernels, and as many cells as the cache holds.

        Raises:
            FormatError: If a part that is read is damaged.
        """
        scene, grid = self.scene, self.scene.index.grid
        view, holdings = FieldOfView.from_degrees(90.0, 70.0, margin=8.0), b""
        for _ in range(2):  # a new viewer, and one that reconnects
            session = Session.from_hello(scene, Hello(view, bytes.fromhex(scene.about.identity), holdings))
            session.welcome(0.0)
            for k, center in enumerate(grid.centers[:_WALK]):
                session.on_pose(0.1 * k, center, (1.0, 0.1 * k, 0.0, 0.0))
                message = session.next_message(0.1 * k + 0.02, _PIECE)
                session.on_ack(0.1 * k + 0.05, message.sequence if message is not None else 0)
            holdings = session.holdings.to_bytes()
        for cell in range(len(grid)):
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
        """Serve another scene under its name from now on; who reads the former one goes on until `close`."""
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
                scene.opened.package.close()


def open_scenes(
    packages: Sequence[str | PathLike[str]],
    *,
    max_cache_bytes: int = 512 << 20,
    warm: bool = False,
    quality: Quality | None = None,
    log: EventLog | None = None,
) -> Scenes:
    """Open packages; keep a damaged one as refused, so that the others can be served.

    Args:
        packages: Folders of packages, or of static scenes (`gsvis export --format static`). The name of a scene is that
            of its folder without suffix.
        max_cache_bytes: Most bytes of decoded data of cells, for all scenes together.
        warm: Whether to load what the first viewers would wait for; takes some seconds for a large scene.
        quality: How to round records before they are sent; None means not at all.
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
        name = path.resolve().name.partition(".")[0] or "scene"
        if name in found:
            raise ValueError(f"packages: expected different names, got {name!r} twice; rename a folder")
        try:
            share = max_cache_bytes // len(packages)
            served = open_scene(path, name, max_cache_bytes=share, warm=warm, quality=quality)
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
) -> ServedScene:
    """Open one package or static scene.

    Args:
        path: The folder.
        name: Name in addresses; "" takes that of the folder without suffix.
        max_cache_bytes: Most bytes of decoded data of cells.
        warm: Whether to load what the first viewers would wait for.
        quality: How to round records before they are sent; None means not at all.

    Raises:
        GsvisError: If it cannot be opened.
        OSError: If it cannot be opened, because of the file system.
    """
    folder = _check.path("path", path)
    name = name or folder.resolve().name.partition(".")[0] or "scene"
    if is_site(folder):
        return ServedScene(name, folder, None, site=Site(folder))
    package = Package.open(folder)
    try:
        scene = StreamedScene.open(package, max_cache_bytes=max_cache_bytes, quality=quality)
        served = ServedScene(name, folder, scene)
        if warm:
            served.warm_up()
        return served
    except BaseException:
        package.close()
        raise


def _report(served: ServedScene, log: EventLog) -> None:
    if served.opened is None:
        log("ready", scene=served.name, gaussians=served.gaussians, form="static")
        return
    about = served.opened.about
    log("ready", scene=served.name, gaussians=about.gaussians, terms=about.terms, cells=len(served.opened.index.grid))
