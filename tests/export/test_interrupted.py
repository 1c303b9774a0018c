"""Whatever writes a folder over an older result leaves that whole if it is interrupted, at any step."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from gsvis.export import write_site, write_static, write_streamed_sog
from gsvis.export.tiles import write_tiles
from gsvis.files import swap
from gsvis.io.levels import save_levels
from gsvis.package import Package, unpack_package
from gsvis.scene.levels import Levels
from tests.export.viewers import viewer_of
from tests.io.test_levels import levels_of
from tests.stream.worlds import package_of

Write = Callable[[Path, int], object]


def _unpacked(folder: Path, seed: int) -> None:
    package = folder.parent / f"{seed}.gsvis"
    if not package.exists():
        package_of(package, 40 + seed, "rgb", stores=False).close()
    with Package.open(package) as opened:
        unpack_package(opened, folder)


def _site(folder: Path, seed: int) -> None:
    viewer = folder.parent / "viewer"
    if not viewer.exists():
        viewer_of(viewer)
    write_site(folder, _levels(seed), viewer=viewer)


def _levels(seed: int) -> Levels:
    return levels_of(30 + seed, seed)


WRITERS: dict[str, Write] = {
    "levels": lambda folder, seed: save_levels(_levels(seed), folder),
    "unpack": _unpacked,
    "static": lambda folder, seed: write_static(folder, _levels(seed)),
    "site": _site,
    "streamed-sog": lambda folder, seed: write_streamed_sog(folder, _levels(seed), overwrite=True),
    "3dtiles": lambda folder, seed: write_tiles(folder, _levels(seed), overwrite=True),
    "package": lambda folder, seed: package_of(folder, 40 + seed, "rgb", stores=False).close(),
}


def read(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("can_swap", [True, False])
@pytest.mark.parametrize("name", WRITERS)
def test_an_interrupt_at_any_step_leaves_the_older_result(
    name: str, can_swap: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, out = WRITERS[name], tmp_path / "out"
    write(out, 0)
    write(tmp_path / "fresh", 1)
    old, new, steps = read(out), read(tmp_path / "fresh"), [0]
    assert old != new

    def counted(call: Callable[..., object]) -> Callable[..., object]:
        def step(*args: object, **more: object) -> object:
            steps[0] -= 1
            if steps[0] == 0:
                raise KeyboardInterrupt
            return call(*args, **more)

        return step

    if not can_swap:
        monkeypatch.setattr(swap, "_call", lambda: None)
    monkeypatch.setattr(os, "replace", counted(os.replace))
    monkeypatch.setattr(swap, "_exchange", counted(swap._exchange))
    for k in range(1, 60):
        steps[0] = k
        try:
            write(out, 1)
        except KeyboardInterrupt:
            now = read(out)
            is_old = all(now.get(each) == data for each, data in old.items())
            is_new = all(now.get(each) == data for each, data in new.items())
            assert is_old or is_new, k
            if is_new:
                write(out, 0)
            continue
        break
    assert 1 < k < 59
    steps[0] = 0
    write(out, 1)
    assert read(out) == new
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]
