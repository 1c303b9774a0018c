"""Packages to be streamed in tests: small, with levels, terms and visible sets."""

from __future__ import annotations

from pathlib import Path

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.package import Contents, Package, PackageInfo, write_package
from gsvis.package.rounding import Quality, limits_of
from gsvis.stream import Hello, Receiver, Session, StreamedScene, parse_client
from tests.package.worlds import EPSILON, colors_of, levels_of, sets_of


def package_of(
    folder: Path,
    n: int = 400,
    variant: str = "rgb",
    seed: int = 0,
    *,
    stores: bool = True,
    lattice: bool = False,
    quality: Quality | None = None,
) -> Package:
    """A package, with records that are rounded unless `quality` is None."""
    levels, (_, colors) = levels_of(n, seed, lattice=lattice), colors_of(n, variant, seed)
    sets = sets_of(folder.parent / f"{folder.name}-stores", levels) if stores else None
    info = PackageInfo((0, -1, 0), 0.5, epsilon=EPSILON if stores else None)
    limits = None if quality is None else limits_of(Contents.from_levels(levels, colors), quality)
    return write_package(folder, levels, colors, info=info, visibility=sets, limits=limits)


def greet(scene: StreamedScene, receiver: Receiver, view: FieldOfView, config: AbrConfig | None = None) -> Session:
    """Return the session of a new connection of a client, with WELCOME acknowledged."""
    hello = parse_client(receiver.hello(view).to_bytes(), most_hello=scene.most_hello)
    assert isinstance(hello, Hello)
    assert hello.memory == receiver.memory
    session = Session.from_hello(scene, hello, config)
    assert receiver.resume(session.welcome(0.0).data)
    session.on_ack(0.0, 0)
    return session
