"""Decide which device draws and trains, and go on without a GPU whose memory runs out.

The device is "cuda" for a GPU with torch and gsplat, or "cpu". Every way in which a GPU can be missing has its words
here, and nowhere else. torch is imported only where gsplat is installed or a GPU is asked for by name.
"""

from __future__ import annotations

import gc
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from gsvis import _check
from gsvis._extras import has, remedy_of
from gsvis.errors import BackendError

__all__ = ["DEVICES", "Device", "OnDevice", "choose_device", "torch_device_of", "why_no_cuda"]

DEVICES = ("auto", "cpu", "cuda")
"""What can be asked for: a GPU where one works, none, or a GPU."""

T = TypeVar("T")

_LOG = logging.getLogger(__name__)
_TORCH_DEVICES = {"cuda": "cuda", "reference": "cpu"}
_INSTEAD = "or use the device 'cpu'"


@dataclass(frozen=True)
class Device:
    """The device that draws and trains.

    Attributes:
        name: "cpu" or "cuda", also the backend of the rasterizer.
        about: What the GPU is, or why none is used; empty for a CPU where nothing asks for a GPU, neither a user nor an
            installed gsplat.
    """

    name: str
    about: str = ""

    @property
    def backend(self) -> str:
        """The backend for the options of a library call: "cuda", or "auto", which is the CPU for arrays."""
        return "cuda" if self.name == "cuda" else "auto"

    @property
    def line(self) -> str:
        """The choice in one line.

        Examples:
            >>> Device("cpu", "expected a CUDA GPU, got none").line
            'device: cpu, because cuda: expected a CUDA GPU, got none'
        """
        if not self.about:
            return f"device: {self.name}"
        return f"device: {self.name}, {'because cuda: ' if self.name == 'cpu' else ''}{self.about}"


def choose_device(asked: str) -> Device:
    """Return the device to use: as asked for; for "auto", "cuda" if it works here, else "cpu".

    Args:
        asked: One of `DEVICES`.

    Raises:
        ValueError: If it is none of them.
        BackendError: If "cuda" is asked for and does not work here; the message says why and what to do.
    """
    _check.one_of("device", asked, DEVICES)
    if asked == "cpu":
        return Device("cpu")
    if asked == "auto" and not has("gsplat"):  # to import torch takes longer than a small render
        return Device("cpu")
    missing = why_no_cuda() or _why_not_drawn()
    if missing and asked == "cuda":
        raise BackendError(missing)
    if missing:
        return Device("cpu", missing.removeprefix("device 'cuda': "))
    return Device("cuda", _title())


def why_no_cuda() -> str:
    """Return why torch and gsplat cannot use a GPU here, with what to do; empty if they can."""
    try:
        import torch
    except ImportError:
        return f"device 'cuda': expected the package torch, got none; {remedy_of('torch')}"
    if torch.version.cuda is None and torch.version.hip is None:
        built = f"torch {torch.__version__}, which is built for the CPU alone"
        return f"device 'cuda': expected a torch that is built for CUDA, got {built}; install the other, {_INSTEAD}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of an old driver; the error below says the same
        works = torch.cuda.is_available()
    if not works:
        wanted = "a CUDA GPU and a driver that is new enough for torch"
        return f"device 'cuda': expected {wanted}, got '{_why_not_started()}'; update the driver, {_INSTEAD}"
    try:
        import gsplat  # noqa: F401
    except ImportError as error:
        return f"device 'cuda': expected an importable gsplat, got '{error}'; {remedy_of('gsplat')}"
    return ""


def torch_device_of(backend: str) -> str | None:
    """Return the torch device that a backend of the rasterizer draws on; None if it needs no tensors.

    The backend "reference" goes the same way as "cuda", on the CPU: what a GPU would do can be tested without one.
    """
    return _TORCH_DEVICES.get(backend)


class OnDevice:
    """Work that is done on a device, and on the CPU from where the memory of the device runs out.

    Args:
        what: What is done, for the one line that is logged: "views are drawn".
        works: Whether there is a device.

    Attributes:
        works: Whether the next work is done there.
    """

    def __init__(self, what: str, works: bool = True) -> None:
        self.what = what
        self.works = works

    def run(self, there: Callable[[], T], here: Callable[[], T]) -> T:
        """Return the result of `there`, or of `here` if there is no device or its memory runs out.

        Args:
            there: Work on the device. It may stop anywhere with `torch.OutOfMemoryError` and leaves nothing half done.
            here: The same on the CPU.
        """
        if not self.works:
            return here()
        found = self.attempt(there)
        if found is not None:
            return found
        self.works = False
        _LOG.warning("the memory of the GPU ran out; %s on the CPU from here", self.what)
        return here()

    @staticmethod
    def attempt(there: Callable[[], T]) -> T | None:
        """Return the result of some work, or None if the memory of the device does not suffice even once emptied."""
        import torch

        try:
            return there()
        except torch.OutOfMemoryError:
            pass  # leave the handler first: the error holds tensors of the frames that it passed
        gc.collect()
        if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
            torch.cuda.empty_cache()
        try:
            return there()
        except torch.OutOfMemoryError:
            return None


def _why_not_started() -> str:
    """Return the first sentence of the error with which CUDA does not start."""
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            torch.cuda.init()  # type: ignore[no-untyped-call]
        except (AssertionError, RuntimeError) as error:
            return str(error).strip().split("\n")[0].split(". ")[0].rstrip(".") or type(error).__name__
    return "no GPU"


def _why_not_drawn() -> str:
    """Return why gsplat cannot draw one Gaussian; empty if it can. Its kernels may be missing, or not for this GPU."""
    from gsvis.render.cuda import draw_one

    try:
        draw_one(_TORCH_DEVICES["cuda"])
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        got = str(error).strip().split("\n")[0] or type(error).__name__
        return f"device 'cuda': expected a gsplat that draws here, got '{got}'; install gsplat for this GPU, {_INSTEAD}"
    return ""


def _title() -> str:
    """Return what the GPU is."""
    import torch

    return str(torch.cuda.get_device_name())
