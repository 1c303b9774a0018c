"""Answer questions about scenes one at a time, beside the streams, and keep the answers that do not change."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from typing import Any

from starlette.responses import PlainTextResponse, Response

from gsvis.files.cache import Cache
from gsvis.serve.facts import describe_cells, describe_floor, describe_sight, describe_walk, explain
from gsvis.serve.scenes import ServedScene
from gsvis.stream import StreamedScene

__all__ = ["FACTS", "Questions"]

FACTS: dict[str, Callable[[StreamedScene], Any]] = {
    "cells": describe_cells,
    "floor": describe_floor,
    "seen": describe_sight,
    "walk": describe_walk,
}
"""Facts about a whole scene, by the last part of their address."""

_MOST_WAITING = 8  # with the one that is being answered
_KEPT_BYTES = 16 << 20
_KEEP = "no-cache"


class Questions:
    """Answer one question after the other; refuse more than a few at once.

    Args:
        now: The server's clock, seconds.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._turn = asyncio.Semaphore(1)
        self._now = now
        self._waiting = 0
        self._kept: Cache[bytes] = Cache(_KEPT_BYTES)

    async def answer(self, served: ServedScene, fact: str, gaussian: int | None = None) -> Response:
        """Return the answer to one question about a scene, as JSON.

        Args:
            served: A scene that is open.
            fact: "why", or one of `FACTS`.
            gaussian: Id of a Gaussian, for "why".

        Raises:
            FormatError: If the package is damaged where it is read.
        """
        if gaussian is not None and gaussian >= (served.gaussians or 0):
            return PlainTextResponse("no such Gaussian\n", 404)
        key = id(served), served.openings, fact, gaussian
        found = self._kept.find(key)
        if found is None:
            if self._waiting >= _MOST_WAITING:
                return PlainTextResponse("too many questions; try again later\n", 503, {"retry-after": "1"})
            self._waiting += 1
            try:
                async with self._turn:
                    found = self._kept.find(key)  # the question before may have been the same
                    if found is None:
                        found = await asyncio.to_thread(self._find, served, fact, gaussian)
            finally:
                self._waiting -= 1
            self._kept.keep(key, found, len(found))
        return Response(found, 200, {"cache-control": _KEEP, "x-content-type-options": "nosniff"}, "application/json")

    def _find(self, served: ServedScene, fact: str, gaussian: int | None) -> bytes:
        """Compute an answer; a thread runs it."""
        with served.in_use(self._now) as scene:
            found: Mapping[str, Any] | None = FACTS[fact](scene) if gaussian is None else explain(scene, gaussian)
        return json.dumps(found, allow_nan=False, separators=(",", ":")).encode()
