"""Scenes that are opened from kept tables send what scenes in memory send, to the byte."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.errors import FormatError
from gsvis.files.mapped import MappedArrays, write_arrays
from gsvis.package import Package
from gsvis.stream import Quality, Receiver, Session, StreamedScene
from gsvis.stream import kept as module
from gsvis.stream.kept import check_kept, open_kept
from tests.stream.worlds import greet, package_of

VIEW = FieldOfView.from_degrees(80, 60, margin=8)
SCENES = {"rgb": ("rgb", True), "hsl": ("hsl", True), "bare": ("hsl", False)}


@pytest.fixture(scope="module", params=SCENES)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    variant, stores = SCENES[request.param]
    folder = tmp_path_factory.mktemp("kept") / f"{request.param}.gsvis"
    package_of(folder, 1500, variant, stores=stores).close()
    return folder


def walk(scene: StreamedScene, memory: float | None = None, between: object = None) -> list[bytes]:
    """Return all messages of a walk, with a reconnect in the middle."""
    config = AbrConfig(start_rate=3e4)
    session, receiver = Session(scene, VIEW, config, memory=memory), Receiver(scene.header, memory=int(memory or 0))
    found = [session.welcome(0.0).data]
    session.on_ack(0.0, 0)
    for k in range(80):
        t = 0.1 * (k + 1)
        if k == 40 and memory is None:
            session = greet(scene, receiver, VIEW, config)
        session.on_pose(t, [0.05 * k - 2, 0.3, 0.1 * np.sin(k)], [1.0, 0.0, 0.03 * k, 0.0])
        message = session.next_message(t, 4000.0)
        if message is not None:
            found.append(message.data)
            session.on_ack(t + 0.05, receiver.receive(message.data).sequence)
        if callable(between):
            between()
    return found


@pytest.mark.parametrize("quality", [None, Quality()])
def test_the_bytes_are_those_of_a_scene_in_memory(path: Path, tmp_path: Path, quality: Quality | None) -> None:
    with Package.open(path) as package, Package.open(path) as first, Package.open(path) as again:
        eager = StreamedScene.open(package, quality=quality)
        expected = walk(eager), walk(eager, 3000.0)
        for opened in (first, again):  # computed, then found
            scene, tables = open_kept(opened, tmp_path, quality=quality)
            assert tables is not None
            assert (walk(scene, between=tables.release), walk(scene, 3000.0)) == expected
            assert scene.most_hello == eager.most_hello
            assert np.array_equal(scene.contents.records, eager.contents.records)
        assert "contents" not in again.__dict__  # no record of the package was read


def test_kernels_are_not_compiled_again(path: Path, tmp_path: Path) -> None:
    """Mapped arrays have the types of those in memory."""
    with Package.open(path) as package, Package.open(path) as other:
        eager, (scene, _) = StreamedScene.open(package), open_kept(other, tmp_path)
        for name in ("records", "links", "spheres", "spreads", "bodies", "highest", "traits", "every"):
            mine, theirs = getattr(scene.candidates.tables, name), getattr(eager.candidates.tables, name)
            pairs = zip(mine, theirs, strict=True) if isinstance(mine, tuple) else [(mine, theirs)]
            for a, b in pairs:
                assert (a.dtype, a.shape, a.flags.writeable) == (b.dtype, b.shape, b.flags.writeable), name
                assert a.flags.c_contiguous == b.flags.c_contiguous
                assert np.array_equal(a, b)


def test_two_that_open_the_same_package_compute_once(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    write = module.write_tables
    monkeypatch.setattr(
        module, "write_tables", lambda target, *a, **b: (made.append(target.name), write(target, *a, **b))
    )

    def open_one() -> None:
        with Package.open(path) as package:
            open_kept(package, tmp_path)

    threads = [threading.Thread(target=open_one) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1


def test_damaged_tables_are_made_again(path: Path, tmp_path: Path) -> None:
    with Package.open(path) as package:
        expected = walk(open_kept(package, tmp_path)[0])
    (file,) = tmp_path.glob("*.tables")
    whole = file.read_bytes()
    for bad in (whole[: len(whole) // 2], b"", b"x" * 5000, whole[:20] + b"?" + whole[21:]):
        file.write_bytes(bad)
        with Package.open(path) as package:
            assert walk(open_kept(package, tmp_path)[0]) == expected
        assert file.stat().st_size == len(whole)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "small.gsvis"
    package_of(folder, 60, "rgb", stores=True).close()
    return folder


def flips(data: bytes, count: int, seed: int) -> Iterator[bytes]:
    """Yield the bytes with one bit changed: at the begin, at the end, and all over."""
    rng = np.random.default_rng(seed)
    for place in [0, 9, 40, len(data) - 1, *rng.integers(0, len(data), count)]:
        changed = bytearray(data)
        changed[place] ^= 1 << int(rng.integers(8))
        yield bytes(changed)


def test_no_bit_of_a_kept_file_changes_what_is_sent(small: Path, tmp_path: Path) -> None:
    """Whatever bit of whatever file changes, the package opens, and its tables are those of the package."""
    with Package.open(small) as package:
        open_kept(package, tmp_path)
    files = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert {path.suffix for path in files} == {".tables", ".lock"}
    with Package.open(small) as package:
        assert len(check_kept(package, tmp_path)) == 1
    for path, whole in files.items():
        for k, data in enumerate(flips(whole, 24, len(whole)) if whole else [b"x"]):
            path.write_bytes(data)
            with Package.open(small) as package:
                assert open_kept(package, tmp_path)[1] is not None
                check_kept(package, tmp_path)
            now = {each: each.read_bytes() for each in files}
            padded = path.suffix == ".tables" and now[path] == data  # a byte between arrays, which nobody reads
            assert padded or now | {path.with_suffix(".lock"): b""} == files, (path.name, k)


def test_visible_sets_that_changed_since_tables_were_kept_are_refused(small: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(small, tmp_path / "copy.gsvis"))
    with Package.open(copy) as package:
        open_kept(package, tmp_path / "t")
        sets = package.set_files()
    for path in sets:
        whole = path.read_bytes()
        for data in flips(whole, 8, len(whole)):
            path.write_bytes(data)
            with Package.open(copy) as package, pytest.raises(FormatError):
                open_kept(package, tmp_path / "t")
        path.write_bytes(whole)


@pytest.mark.parametrize("is_held", [True, False])
def test_a_package_that_is_removed_while_it_is_open_is_streamed_on(
    small: Path, tmp_path: Path, is_held: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As when it is prepared again meanwhile. Files that are too many to be held leave cells that see everything."""
    copy = Path(shutil.copytree(small, tmp_path / "copy.gsvis"))
    with Package.open(copy) as package, Package.open(small) as other:
        monkeypatch.setattr("gsvis.package.sets._MOST_HELD", 128 if is_held else 0)
        scene, expected = open_kept(package, tmp_path / "t")[0], open_kept(other, tmp_path / "t")[0]
        scene.index.sets.visible_masks(0)
        scene.index.sets.ring_masks([[0]])  # in memory from now on
        shutil.rmtree(copy)
        assert len(scene.candidates.in_cell(0))
        for cell in range(len(scene.index.grid)):
            mine = scene.index.sets.classes(cell)[0]
            known = expected.index.sets.classes(cell)[0] if is_held else np.arange(len(scene))
            assert np.array_equal(mine, known)
            assert len(scene.candidates.in_cell(cell))
        assert walk(scene)
        assert caplog.text.count("cannot be read") == (0 if is_held else 1)


def test_verify_reads_kept_tables(small: Path, tmp_path: Path) -> None:
    with Package.open(small) as package:
        assert check_kept(package, tmp_path / "none") == []
        open_kept(package, tmp_path)
        open_kept(package, tmp_path, quality=Quality())
        assert len(check_kept(package, tmp_path)) == 2
        for path in tmp_path.glob("*.tables"):
            whole = path.read_bytes()
            for place in (3, len(whole) // 2, len(whole) - 3):
                path.write_bytes(whole[:place] + bytes([whole[place] ^ 64]) + whole[place + 1 :])
                if np.array_equal(whole, path.read_bytes()):
                    continue
                with pytest.raises(FormatError, match="remove the file; it is made again"):
                    check_kept(package, tmp_path)
                path.write_bytes(whole)
        (tmp_path / "0000.tables").write_bytes(b"of something else")
        assert len(check_kept(package, tmp_path)) == 2


def test_a_folder_that_cannot_be_written_means_memory(
    path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    with Package.open(path) as package:
        scene, tables = open_kept(package, tmp_path / "file" / "tables")
        assert tables is None
        assert walk(scene) == walk(StreamedScene.open(package))
    assert "tables are not kept" in caplog.text


def test_a_package_without_a_part_is_refused_though_its_tables_are_kept(path: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(path, tmp_path / "copy.gsvis"))
    with Package.open(copy) as package:
        open_kept(package, tmp_path / "t")
    part = max((copy / "parts").iterdir())
    for bad in (part.read_bytes()[:-1], None):
        part.unlink() if bad is None else part.write_bytes(bad)
        with Package.open(copy) as package, pytest.raises(FormatError, match=r"bytes|no such file"):
            open_kept(package, tmp_path / "t")


def test_arrays_that_share_memory_are_written_once(tmp_path: Path) -> None:
    a = np.arange(5000)
    write_arrays(tmp_path / "x.tables", {"a": a, "b": a, "none": np.zeros((0, 3), np.float32)}, {"n": 1})
    found = MappedArrays(tmp_path / "x.tables")
    assert found.facts == {"n": 1}
    assert (tmp_path / "x.tables").stat().st_size < 12 * 4096
    found.arrays["a"][0] = 7  # stays in this process
    found.release()
    assert np.array_equal(found.arrays["b"], a)
    assert found.arrays["none"].shape == (0, 3)
