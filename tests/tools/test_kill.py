"""The tool behind `make kill`: it kills what runs, notices what has ended, and sees every difference."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "kill.py"
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


@pytest.fixture(scope="module")
def kill() -> ModuleType:
    spec = importlib.util.spec_from_file_location("gsvis_kill", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    before, sys.modules["gsvis_kill"] = sys.path[:], module
    spec.loader.exec_module(module)
    sys.path[:] = before
    return module


def test_a_run_is_killed_or_has_ended(kill: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("scene.ply", "photos"):
        (tmp_path / name).touch()
    waits = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(3600)'])"
    monkeypatch.setattr(kill, "GSVIS", [sys.executable, "-c", waits])
    assert kill.killed_after(0.0, [], tmp_path / "a")
    monkeypatch.setattr(kill, "GSVIS", [sys.executable, "-c", "open('out', 'w').write('done')"])
    assert not kill.killed_after(600.0, [], tmp_path / "a")
    assert kill.left_alone([], tmp_path / "a")[0] == 0
    assert kill.contents(tmp_path / "a") == {"out": b"done"}
    monkeypatch.setattr(kill, "GSVIS", [sys.executable, "-c", "raise SystemExit('no room')"])
    assert kill.left_alone([], tmp_path / "a") == (1, "no room")


def test_every_difference_and_every_leftover_is_seen(kill: ModuleType, tmp_path: Path) -> None:
    for folder, loss, seconds in (("a", 1, 2), ("b", 1, 3), ("c", 2, 2)):
        work = tmp_path / folder / "work" / "out"
        work.mkdir(parents=True)
        (work / "timings.json").write_text(str(seconds))
        (work / "x.train.json").write_text(f'{{"loss": {loss}, "timing": {seconds}}}')
    a, b, c = (kill.contents(tmp_path / folder) for folder in "abc")
    assert kill.differences(a, b) == []
    assert kill.differences(c, a) == ["out/x.train.json differs"]
    (tmp_path / "b" / "work" / ".out.gsvis-0123456789ab").mkdir()
    assert [name for name in kill.contents(tmp_path / "b") if name not in a] == [".out.gsvis-0123456789ab"]
    (tmp_path / "b" / "work" / "out" / "timings.json").unlink()
    assert kill.differences(kill.contents(tmp_path / "b"), a) == ["out/timings.json is missing"]


def test_every_command_of_the_tool_is_one_of_gsvis(kill: ModuleType) -> None:
    from gsvis.cli import arguments

    assert {name.capitalize() for name in kill.COMMANDS} <= {*arguments.__all__}
