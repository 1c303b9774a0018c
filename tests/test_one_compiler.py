"""The suite's own rule: a kernel that several processes want at once is compiled by one of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import one_compiler

PROGRAM = """
import sys
from tests.one_compiler import compile_once

compile_once()
sys.path.insert(0, sys.argv[1])
from kernel_of_a_test import outer

print("ready", flush=True)
sys.stdin.readline()
assert outer(3) == 14
print(sum(outer.stats.cache_misses.values()), flush=True)
"""
KERNEL = """
from numba import njit


@njit(cache=True)
def inner(n):
    return n * n


@njit(cache=True)
def outer(n):
    total = 0
    for i in range(n + 1):
        total += inner(i)
    return total
"""


def test_processes_that_want_a_kernel_at_once_compile_it_once(tmp_path: Path) -> None:
    (tmp_path / "kernel_of_a_test.py").write_text(KERNEL)
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(tmp_path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for _ in range(3)
    ]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:  # all at once
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    misses = [int(process.communicate(timeout=300)[0]) for process in processes]
    assert sorted(misses) == [0, 0, 1]


def test_locks_lie_in_the_checkout_and_a_link_there_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert one_compiler.LOCKS.is_relative_to(Path(__file__).parent)
    (tmp_path / "locks").symlink_to(tmp_path / "elsewhere")
    monkeypatch.setattr(one_compiler, "LOCKS", tmp_path / "locks")
    monkeypatch.setattr(one_compiler, "_files", {})
    with one_compiler.locked("a kernel"):
        assert one_compiler._file() is None
    assert not (tmp_path / "elsewhere").exists()
