"""Freed memory goes back to the system, and nothing that is in use changes."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gsvis.jobs.freed_memory import keep_freed_memory, release_freed_memory

BLOCK = 64 << 10  # below the size from which a block is given back at once
BLOCKS = 1600


def resident() -> int:
    """Bytes of this process in memory."""
    return 4096 * int(Path("/proc/self/statm").read_text().split()[1])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc, which Linux has")
def test_freed_blocks_between_used_ones_go_back_to_the_system() -> None:
    if not hasattr(ctypes.CDLL(None), "malloc_trim"):
        pytest.skip("needs glibc")
    blocks = [np.full(BLOCK, k % 251, np.uint8) for k in range(BLOCKS)]
    kept = blocks[::16]
    del blocks
    before = resident()
    release_freed_memory()
    assert before - resident() > BLOCK * BLOCKS // 2
    assert all((block == 16 * k % 251).all() for k, block in enumerate(kept))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc, which Linux has")
def test_freed_blocks_of_arrow_go_back_to_the_system() -> None:
    pa = pytest.importorskip("pyarrow")
    blocks = [pa.allocate_buffer(16 * BLOCK) for _ in range(BLOCKS // 16)]
    for block in blocks:
        np.frombuffer(block, np.uint8).fill(1)
    del block, blocks
    release_freed_memory()
    blocks = [pa.allocate_buffer(16 * BLOCK) for _ in range(BLOCKS // 16)]
    for block in blocks:
        np.frombuffer(block, np.uint8).fill(1)
    full = resident()
    del block, blocks
    release_freed_memory()
    assert full - resident() > BLOCK * BLOCKS // 2


def test_without_that_allocator_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    for problem in (AttributeError, OSError, TypeError):

        def fail(_name: object, problem: type[Exception] = problem) -> None:
            raise problem("no such library")

        monkeypatch.setattr(ctypes, "CDLL", fail)
        release_freed_memory()
        keep_freed_memory()


_STEPS = """
import resource, sys
import numpy as np
from gsvis.jobs.freed_memory import keep_freed_memory

def step():
    blocks = [np.ones(12 << 20, np.uint8) for _ in range(8)]

if sys.argv[1] == "keep":
    keep_freed_memory()
step()
step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
step()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts page faults as Linux does")
def test_what_a_step_frees_is_there_for_the_next() -> None:
    if not hasattr(ctypes.CDLL(None), "mallopt"):
        pytest.skip("needs glibc")
    usual = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "GLIBC_TUNABLES"))}

    def faults(how: str, **more: str) -> int:
        """Page faults of a step of a process that frees all it allocates."""
        ran = subprocess.run(
            [sys.executable, "-c", _STEPS, how], env={**usual, **more}, capture_output=True, text=True, check=True
        )
        return int(ran.stdout)

    kept = faults("keep")
    assert 10 * kept < faults("give")
    assert 10 * kept < faults("keep", MALLOC_TRIM_THRESHOLD_="0")  # who sets this has the last word
