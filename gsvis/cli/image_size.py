"""Pixels of images that --width and --height state."""

from __future__ import annotations

from typing import Protocol

__all__ = ["image_size"]


class _Sized(Protocol):
    @property
    def width(self) -> int | None: ...
    @property
    def height(self) -> int | None: ...


def image_size(command: _Sized, usual: tuple[int, int] | None) -> tuple[int, int] | None:
    """Return (width, height) in pixels as a command states them; None if it states neither.

    Args:
        command: Arguments with --width and --height.
        usual: (width, height) that replaces the one that is not given; None where both are needed, as for photographs,
            whose shape is not known here.

    Raises:
        ValueError: If one is given and the other is needed.
    """
    width = command.width
    height = command.height
    if width is None and height is None:
        return None
    if usual is None and (width is None or height is None):
        missing, given = ("--width", "--height") if width is None else ("--height", "--width")
        raise ValueError(f"{given}: expected {missing} with it for photographs, got none; add it or use --downscale")
    across, down = usual or (0, 0)
    return width or across, height or down
