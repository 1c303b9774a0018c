"""Bring scenes here that a command names by address, or that are zipped, before it runs; remove them after it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from gsvis.cli.options import command_name, replaced

if TYPE_CHECKING:
    from gsvis.cli.arguments import Command
    from gsvis.progress import Progress

__all__ = ["fetched"]

_COMMANDS = ("analyze", "convert", "export", "inspect", "render", "view")
"""Commands that read a scene once; others keep work that belongs to a file."""


@contextmanager
def fetched(command: Command) -> Iterator[Command]:
    """Yield the command with the paths of fetched or unpacked files in place of addresses and zips of scenes.

    Raises:
        ValueError: If the command takes none.
        GsvisError: If a scene cannot be fetched or unpacked.
    """
    scenes = _scenes_of(command)
    if not any(map(_is_elsewhere, scenes)):  # most commands name none: import nothing
        yield command
        return
    from gsvis.cli.terminal import Status
    from gsvis.files.shown import shown_as
    from gsvis.files.temporary import temporary_folder

    name = command_name(type(command))
    if name not in _COMMANDS:
        got = next(filter(_is_elsewhere, scenes))
        what = "address" if "://" in got else "zip"
        remedy = "fetch it with gsvis convert ADDRESS FILE" if what == "address" else "unzip it, name its lod-meta.json"
        raise ValueError(f"SCENE: expected a scene on this disk as it is, got the {what} {got}; {remedy}")
    out = getattr(command, "out", None)
    for scene in scenes:
        if isinstance(out, str) and "://" not in scene and Path(out).resolve() == Path(scene).resolve():
            raise ValueError(f"--out: expected another file than SCENE, got {out}; name another")
    with ExitStack() as stack:
        folder = stack.enter_context(temporary_folder())
        lod = _lod_of(command)
        with Status() as status:
            local = tuple(_local(scene, folder / str(k), lod, status) for k, scene in enumerate(scenes))
        for here, scene in zip(local, scenes, strict=True):
            stack.enter_context(shown_as(here, scene))
        if name == "convert":
            paths = command.paths  # type: ignore[union-attr]
            yield replaced(command, {("paths",): local + paths[len(local) :]})
        else:
            yield replaced(command, {("scene",): local[0]})


def _is_elsewhere(scene: str) -> bool:
    """Return whether a scene is an address or a zipped streamed SOG."""
    if "://" in scene:
        return True
    if not scene.lower().endswith((".ssog", ".zip")):
        return False
    from gsvis.io.streamed_zip import is_streamed_zip

    return is_streamed_zip(scene)


def _scenes_of(command: Command) -> tuple[str, ...]:
    """Return the scenes that a command reads, as its user wrote them."""
    if command_name(type(command)) == "convert":
        paths: tuple[str, ...] = command.paths  # type: ignore[union-attr]
        return paths[:-1] if command.out is None else paths  # type: ignore[union-attr]
    scene = getattr(command, "scene", None)
    return (scene,) if isinstance(scene, str) else ()


def _lod_of(command: Command) -> int | None:
    """Return the level of detail that is to be fetched; None for the finest.

    Raises:
        ValueError: If there are several.
    """
    lod: int | tuple[int, ...] | None = getattr(command, "lod", None)
    if isinstance(lod, tuple):
        if len(lod) > 1:
            raise ValueError(f"--lod: expected one number with addresses, got {len(lod)}; convert them one by one")
        return lod[0]
    return lod


def _local(scene: str, folder: Path, lod: int | None, status: Progress) -> str:
    """Return a path as it is, or that of the scene here for an address or a zip."""
    from gsvis.io.remote import fetch_scene, is_address
    from gsvis.io.streamed_zip import is_streamed_zip, unpack_streamed

    if is_address(scene):
        folder.mkdir()
        scene = str(fetch_scene(scene, folder, lod, progress=status))
    if not is_streamed_zip(scene):
        return scene
    inner = folder / Path(scene).stem  # which gives the title
    return str(unpack_streamed(scene, inner))
