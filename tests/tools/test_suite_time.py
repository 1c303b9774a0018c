"""Where the processor time of tests goes: files and their children are counted, and the exit code is that of pytest."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.longest import LONGEST

TOOL = Path(__file__).parents[2] / "tools" / "suite_time.py"
TESTS = """
import subprocess, sys, time

def burn(seconds):
    while time.process_time() < seconds:
        pass

def test_here():
    burn(time.process_time() + 0.3)

def test_in_a_child():
    code = "import time\\nwhile time.process_time() < 0.3: pass"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert {wrong} == 0
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl")
@pytest.mark.parametrize("wrong", [0, 1])
def test_files_and_their_children_are_counted(tmp_path: Path, wrong: int) -> None:
    (tmp_path / "test_two.py").write_text(TESTS.replace("{wrong}", str(wrong)))
    command = [sys.executable, str(TOOL), "-q", "-p", "no:cacheprovider", "-p", "no:dash", "test_two.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == wrong, done.stderr
    found = re.search(r"^ *([\d.]+) +([\d.]+) +([\d.]+)  test_two.py$", done.stdout, flags=re.MULTILINE)
    assert found is not None, done.stdout
    every, children, started = map(float, found.groups())
    assert started == 1
    assert children >= 0.3
    assert every >= children + 0.3 - 0.1  # rounded to tenths
    assert re.search(r"^\d+ s of the processor, \d+ s passed$", done.stdout, flags=re.MULTILINE)


def test_the_longest_files_are_files_of_tests() -> None:
    assert len(set(LONGEST)) == len(LONGEST)
    for name in LONGEST:
        assert (Path(__file__).parents[1] / name).is_file(), name
