"""Open the scene of a command and show that it is read; what commands print of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from gsvis.errors import SceneError
from gsvis.io.sources import load_source
from gsvis.scene.inspection import inspect_scene
from gsvis.scene.source import Source

if TYPE_CHECKING:
    from gsvis.progress import Progress

__all__ = ["inspect_scene_of", "levels_spelled", "open_source", "summarize_levels"]

Loader = Callable[[str, "int | None"], Source]


def open_source(
    scene: str, lod: int | None, status: Progress, what: str | None = None, load: Loader = load_source
) -> Source:
    """Load a scene and show that it is read.

    Args:
        scene: A path or a `builtin:NAME`.
        lod: Level of detail of a streamed scene.
        status: The display of progress.
        what: Completes "there is nothing to", where an empty scene is an error; None takes any scene.
        load: What loads it, such as `load_shown`.

    Raises:
        GsvisError: If the file cannot be read as a scene, or is empty.
        ValueError: If there is no built-in scene of that name.
        FileNotFoundError: If there is no such file.
    """
    status("reading", 0, 1)
    source = load(scene, lod)
    if what is not None and len(source.gaussians) == 0:
        raise SceneError(f"{scene}: the scene has no Gaussian: there is nothing to {what}")
    status("reading", 1, 1)
    return source


def summarize_levels(source: Source) -> list[dict[str, Any]] | None:
    """Return names and sizes of the levels for JSON; None for a scene without levels."""
    found = source.levels
    if found is None:
        return None
    return [{"name": name, "gaussians": n} for name, n in zip(found.names, found.counts, strict=True)]


def levels_spelled(source: Source) -> str:
    """Return text such as ' in levels low 300, high 1,000'; empty for a scene without levels."""
    sizes = ", ".join(f"{each['name']} {each['gaussians']:,}" for each in summarize_levels(source) or ())
    return f" in levels {sizes}" if sizes else ""


def inspect_scene_of(source: Source) -> dict[str, Any]:
    """Return the inspection of a scene as a dict; guess the up axis only where it is not known."""
    return inspect_scene(source.gaussians, up=source.known_up).as_dict()
