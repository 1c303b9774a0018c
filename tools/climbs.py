"""Trace how the preparation of a package walks through the rooms, and count how often it climbs back.

A step of the walk is the first call of a function of another room by a function of `gsvis/prepare`. Methods and
properties of values are no steps, nor are calls of the rooms that every room uses: files, jobs and kernels. A step
climbs back if its room is above the room of the step before, by the order in `tests/test_imports.py`.

Run `python tools/climbs.py` in the root of the repository, with Python 3.11 or newer. It takes a minute.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT)]

from gsvis.prepare import prepare_package  # noqa: E402
from gsvis.scene.procedural import two_rooms  # noqa: E402
from tests.prepare.test_prepare import CONFIG, small  # noqa: E402
from tests.test_imports import ROOMS  # noqa: E402

PACKAGE = f"{ROOT / 'gsvis'}/"
GROUND = ("errors", "progress", "_extras", "_text", "_check", "files", "_kernels", "jobs")


class Walk:
    """The steps of a walk so far.

    Attributes:
        steps: (room, function that calls, function that is called) of each step.
    """

    def __init__(self) -> None:
        self.steps: list[tuple[str, str, str]] = []
        self._known = set[tuple[str, str]]()

    def take(self, frame: FrameType, event: str, _argument: Any) -> None:
        """Note a call; for `sys.setprofile`."""
        if event != "call" or frame.f_back is None:
            return
        if not is_function(frame.f_code) or room_of(frame.f_back.f_code) != "prepare":
            return
        room = room_of(frame.f_code)
        pair = name_of(frame.f_back.f_code), name_of(frame.f_code)
        if room in GROUND or room == "prepare" or pair in self._known:
            return
        self._known.add(pair)
        self.steps.append((room, *pair))

    def climbs(self) -> list[bool]:
        """Return whether each step goes to a room above that of the step before."""
        places = [ROOMS.index(room) for room, _, _ in self.steps]
        return [k > 0 and place < places[k - 1] for k, place in enumerate(places)]


def room_of(code: CodeType) -> str:
    """Return the room of a function; empty outside of gsvis."""
    path = code.co_filename
    return path[len(PACKAGE) :].split("/")[0].removesuffix(".py") if path.startswith(PACKAGE) else ""


def name_of(code: CodeType) -> str:
    """Return the module and the name of a function of gsvis."""
    return f"{code.co_filename[len(PACKAGE) :].removesuffix('.py')}.{code.co_qualname}"


def is_function(code: CodeType) -> bool:
    """Return whether code of gsvis is a function with a name, or a constructor `Class.from_x`."""
    if not code.co_filename.startswith(PACKAGE) or code.co_name.startswith(("_", "<")):
        return False
    return "." not in code.co_qualname or code.co_varnames[:1] == ("cls",)


def main() -> None:
    """Prepare a small scene, and print the walk as JSON lines and the number of steps that climb back."""
    walk = Walk()
    rooms = small(two_rooms(1000, sh_degree=1))
    with tempfile.TemporaryDirectory() as folder:
        sys.setprofile(walk.take)
        try:
            prepare_package(rooms.gaussians, Path(folder) / "rooms.gsvis", rooms.navigable, CONFIG)
        finally:
            sys.setprofile(None)
    climbs = walk.climbs()
    for (room, caller, callee), climb in zip(walk.steps, climbs, strict=True):
        print(json.dumps({"room": room, "from": caller, "to": callee, "climbs": climb}))
    print(f"{len(climbs)} steps, {sum(climbs)} climb back")


if __name__ == "__main__":
    main()
