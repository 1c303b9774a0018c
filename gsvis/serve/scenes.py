"""The scenes of a server: packages by name, opened once, and refused from then on when one turns out to be damaged."""

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
from gsvis.stream import Hello, Session, StreamedScene

__all__ = ["Scenes", "ServedScene", "open_scenes"]


_REACH = 100.0
_WALK = 8  # cells that a warm-up walks through
_PIECE = 65536.0  # bytes that it sends in each


@dataclass(eq=False)
class ServedScene:
    """A package under the name that clients ask for.

    Attributes:
        name: In addresses.
        path: Its folder.
        opened: Ready to be sent; None where it could not be opened.
        fault: Why it is refused; "" while it is served. For the log: it may name files.
    """

    name: str
    path: Path
    opened: StreamedScene | None
    fault: str = ""

    @property
    def scene(self) -> StreamedScene:
        """The scene.

        Raises:
            RuntimeError: If it could not be opened.
        """
        if self.opened is None:
            raise RuntimeError(f"{self.name} is not open")
        return self.opened

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
        """Make ready what the first viewers would wait for: compiled code, and cells as far as there is room for them.

        Raises:
            FormatError: If a part that is read for it is damaged.
        """
        scene, grid = self.scene, self.scene.index.grid
        view, holdings = FieldOfView.from_degrees(90.0, 70.0, margin=8.0), b""
        for _ in range(2):  # a viewer that comes, and one that comes back
            session = Session.from_hello(scene, Hello(view, bytes.fromhex(scene.about.identity), holdings))
            session.welcome(0.0)
            for k, center in enumerate(grid.centers[:_WALK]):
                session.on_pose(0.1 * k, center, (1.0, 0.1 * k, 0.0, 0.0))
                message = session.next_message(0.1 * k + 0.02, _PIECE)
                session.on_ack(0.1 * k + 0.05, message.sequence if message is not None else 0)
            holdings = session.holdings.to_bytes()
        for cell in range(len(grid)):
            if scene.candidates.cache.fill > 0.9:
                break
            scene.candidates.in_cell(cell)

    def refuse(self, line: str) -> None:
        """Serve it to nobody else from now on."""
        self.fault = line


class Scenes(Mapping[str, ServedScene]):
    """Scenes by name, in their order; closed together.

    Args:
        served: The scenes.
    """

    def __init__(self, served: Iterable[ServedScene]) -> None:
        self._served = {scene.name: scene for scene in served}

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
        """Let go of the packages; nobody may be served any more."""
        for scene in self.values():
            if scene.opened is not None:
                scene.opened.package.close()


def open_scenes(
    packages: Sequence[str | PathLike[str]],
    *,
    max_cache_bytes: int = 512 << 20,
    warm: bool = False,
    log: EventLog | None = None,
) -> Scenes:
    """Open packages; one that is damaged is kept as refused, so that the others can be served.

    Args:
        packages: Folders. The name of a scene is that of its folder without suffix.
        max_cache_bytes: Most bytes of what is decoded for cells, all scenes together.
        warm: Whether to make ready what the first viewers would wait for, some seconds for a large scene.
        log: Where to say what happened.

    Returns:
        Scenes by name, in the order given; to be closed.

    Raises:
        ValueError: If there is none, or two have one name.
        GsvisError: If none of them can be opened.
        OSError: The same.
        Exception: The same, of a package that fails in another way.
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
            served = _open(name, path, max_cache_bytes // len(packages), warm)
        except Exception as error:  # a reader that fails in a way of its own must not keep the others from being served
            expected = isinstance(error, GsvisError | OSError)
            why = str(error) if expected else f"{type(error).__name__}: {error}"
            first = first or error
            log("damaged", logging.ERROR, scene=name, why=why)
            LOGGER.debug("scene %s", name, exc_info=None if expected else error)
            found[name] = ServedScene(name, path, None, why)
            continue
        found[name] = served
        about = served.scene.about
        log("ready", scene=name, gaussians=about.gaussians, terms=about.terms, cells=len(served.scene.index.grid))
    if first is not None and all(served.opened is None for served in found.values()):
        raise first
    return Scenes(found.values())


def _open(name: str, path: Path, max_cache_bytes: int, warm: bool) -> ServedScene:
    package = Package.open(path)
    try:
        served = ServedScene(name, path, StreamedScene.open(package, max_cache_bytes=max_cache_bytes))
        if warm:
            served.warm_up()
        return served
    except BaseException:
        package.close()
        raise
