"""Say in one line which device a command draws and trains on."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gsvis.cli.terminal import Status
    from gsvis.render.device import Device

__all__ = ["say_device"]


def say_device(device: Device, status: Status) -> None:
    """Print the device in one line, unless nothing asks for a GPU: then it is the CPU, as ever."""
    if device.about:
        status.line(device.line)
