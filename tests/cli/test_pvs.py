"""`gsvis pvs` in this process and as one of its own: what it says, refuses, keeps and leaves behind."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import save_scene
from gsvis.io.poses import write_poses
from gsvis.pvs import PvsConfig, VisibilityStore
from gsvis.pvs.certificate import CertificateConfig, Certifier
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import two_rooms
from tests.cli.halted import Halted

Capture = pytest.CaptureFixture[str]
QUICK = ["--cells", "8", "--face-size", "16", "--workers", "1", "--certify", "256", "--max-inner", "1"]
BOX = ["--box", "0.5", "0.5", "0.5", "3.5", "3.5", "2.5"]
GSVIS = [sys.executable, "-m", "gsvis"]


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    save_scene(two_rooms(1000, sh_degree=0).gaussians, tmp_path / "in" / "rooms.ply")
    return tmp_path / "in" / "rooms.ply"


def document(capsys: Capture, *words: object) -> dict:
    assert main(["pvs", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys: Capture, *words: object) -> str:
    assert main(["pvs", *map(str, words)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    return " ".join(err.split())


def test_a_store_is_written_and_summarized(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "new" / "rooms.pvs"
    assert main(["pvs", str(ply), "-o", str(out), *QUICK, *BOX]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.replace(str(tmp_path), "").splitlines())) <= 80
    for label in ("visible from a cell", "viewpoints a cell", "light missed", "proven to miss", "two tracers agree"):
        assert label in text
    assert [path.name for path in out.parent.iterdir()] == ["rooms.pvs"]
    found = document(capsys, ply, "-o", out, *QUICK, *BOX)
    assert (found["format"], found["version"], found["out"]) == ("gsvis-pvs", 2, str(out))
    with VisibilityStore.open(out) as store:
        assert found["cells"] == len(store) <= 8
        assert found["visible_share"]["mean"] == pytest.approx(store.visible_counts.mean() / store.gaussians)
        assert found["certificates"] == store.certificates.as_dict()
        assert found["certificates"]["cells"] == len(store)
        above = int(np.count_nonzero(store.certificates.bound > PvsConfig.limit))
        assert found["cells_above_limit"] == above == len(store)  # 256 rays prove no more than a hundredth
        assert found["traced_twice"] == store.info.config["traced_twice"]
        assert found["cells_without_a_free_viewpoint"] == 0
        assert found["bytes"] == out.stat().st_size
        assert found["viewpoints"]["total"] == store.viewpoints.sum()
    assert f"{above} of {above} cells are not proven to miss at most 0.15% of the light" in " ".join(text.split())


def test_a_looser_limit_is_met_and_nothing_is_remarked(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out, words = tmp_path / "rooms.pvs", [*QUICK, *BOX, "--limit", "0.1", "--certify", "512", "--max-inner", "8"]
    assert main(["pvs", str(ply), "-o", str(out), *words]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "not proven" not in text
    with VisibilityStore.open(out) as store:
        assert store.certificates.bound.max() <= 0.1
        assert f"at most {store.certificates.bound.max():.3%} in any cell" in text


def test_a_limit_of_one_in_two_thousand_is_reached_and_holds_for_fresh_rays(tmp_path: Path, capsys: Capture) -> None:
    out, made = tmp_path / "rooms.pvs", two_rooms(1000, sh_degree=0)
    save_scene(made.gaussians, tmp_path / "rooms.ply")
    words = ["--cells", "2", "--face-size", "128", "--workers", "1", "--limit", "0.0005", *BOX]
    found = document(capsys, tmp_path / "rooms.ply", "-o", out, *words)
    assert found["cells_above_limit"] == 0
    assert 0.0 < found["certificates"]["bound"]["max"] <= 0.0005
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(made.gaussians)))
    space = NavigableSpace.from_box((0.5, 0.5, 0.5), (3.5, 3.5, 2.5), 96)
    with VisibilityStore.open(out) as store:
        places = CellViewpoints(store.grid, space)
        for cell in range(len(store)):
            fresh = CertificateConfig(limit=0.0, rays=20_000, round_rays=20_000, seed=77)
            assert certifier.certify(places.voxels(cell), store.visible(cell), fresh).missed <= 0.0005


def test_what_a_store_without_certificates_or_a_second_tracer_says() -> None:
    from gsvis.cli.pvs import spell_certificates
    from gsvis.pvs.stored_certificates import StoredCertificates

    assert dict(spell_certificates(StoredCertificates.none(3), None)) == {"light missed": "not certified by rays"}
    one, share = np.ones(2, np.int64), np.array([0.001, np.nan])
    rows = dict(spell_certificates(StoredCertificates(one, 256 * one, share, 2.0 * share, share), None))
    assert rows["light missed"].startswith("0.100% on average, 0.100% in the worst cell")
    assert rows["proven to miss"].startswith("at most 0.200% in any cell")
    assert rows["worst 16 x 16 tile"] == "0.1% missed on average, 0.1% in the worst cell"
    assert rows["rays"].startswith("512 ")
    assert "Open3D is not installed" in rows["two tracers agree"]
    agreed = {"rays": 16, "agreeing": 15, "largest_difference": 0.5}
    rows = dict(spell_certificates(StoredCertificates(one, one, share, share, share), agreed))
    assert "15 of 16 rays" in rows["two tracers agree"]


def test_the_space_may_be_a_box(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    found = document(capsys, ply, "-o", tmp_path / "a.pvs", *QUICK, *BOX)
    assert found["space"]["rule"] == "box"
    with VisibilityStore.open(tmp_path / "a.pvs") as store:
        assert store.cell_at((2.0, 2.0, 1.5)) >= 0
        assert store.cell_at((6.0, 2.0, 1.5)) == -1
    sized = document(capsys, ply, "-o", tmp_path / "a.pvs", "--cell-size", "1.5", *QUICK[2:], *BOX)
    assert sized["grid"]["cell_size"] == pytest.approx(1.5, rel=0.05)


def test_the_space_may_lie_along_a_path(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    line = np.linspace((1.0, 2.0, 1.5), (3.0, 2.0, 1.5), 20)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (20, 1))
    write_poses(HeadPath(np.arange(20) / 10, line, still), tmp_path / "walk.csv")
    words = [ply, "-o", tmp_path / "walk.pvs", "--path", tmp_path / "walk.csv", *QUICK]
    found = document(capsys, *words, "--margin", "0.3")
    assert found["space"]["volume"] < 3.0
    with VisibilityStore.open(tmp_path / "walk.pvs") as store:
        assert (store.grid.cell_at(line) >= 0).all()
        assert store.cell_at((6.0, 2.0, 1.5)) == -1
    write_poses(HeadPath(np.arange(20) / 10, line * 100 + 900, still), tmp_path / "walk.csv")
    assert "--retarget" in refused(capsys, *words)
    assert document(capsys, *words, "--retarget")["cells"] >= 1


def test_a_dry_run_prints_the_cost_and_writes_nothing(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    words = [ply, "-o", tmp_path / "out" / "a.pvs", *QUICK, *BOX, "--up", "+z", "--dry-run"]
    assert main(["pvs", *map(str, words)]) == 0
    text = capsys.readouterr().out
    for label in ("time", "memory", "disk", "Nothing was written."):
        assert label in text
    estimate = document(capsys, *words)["estimate"]
    assert estimate["finished"] == 0
    assert min(estimate[name] for name in ("seconds", "memory", "disk", "working_disk", "cells", "workers")) > 0
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_contradictions_and_impossible_wishes_are_refused_before_the_work(
    ply: Path, tmp_path: Path, capsys: Capture
) -> None:
    base = [ply, "-o", tmp_path / "a.pvs"]
    (tmp_path / "walk.csv").write_text("t,x,y,z,qw,qx,qy,qz\n0,1,1,1,1,0,0,0\n")
    walk = ["--path", tmp_path / "walk.csv"]
    assert "--path: expected none with --box" in refused(capsys, *base, *BOX, *walk)
    assert "--margin: expected --path" in refused(capsys, *base, "--margin", "1")
    assert "--retarget: expected --path" in refused(capsys, *base, "--retarget")
    assert "no.csv: no such file" in refused(capsys, *base, "--path", tmp_path / "no.csv")
    assert "--up" in refused(capsys, *base, "--up", "up")
    assert "expected an address" in refused(capsys, *base, "--scheduler", "here")
    cluster = ["--scheduler", "tcp://127.0.0.1:1"]
    assert "--workers: expected none with --scheduler" in refused(capsys, *base, *cluster, "--workers", "2")
    assert "--max-memory: expected none" in refused(capsys, *base, *cluster, "--max-memory", "2GB")
    assert "--max-memory: expected at least" in refused(capsys, *base, *QUICK, *BOX, "--max-memory", "20MB")
    assert "make them larger" in refused(capsys, *base, *QUICK, "--cell-size", "0.2", *BOX)
    assert not (tmp_path / "a.pvs").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--max-memory", "4"], "4GB"),
        (["--max-memory", "lots"], "4GB"),
        (["--max-memory", "0GB"], "4GB"),
        (["--cells", "0"], "1 to 100000"),
        (["--face-size", "3"], "4 to 4096"),
        (["--tau", "0.6"], "0.5"),
        (["--limit", "2"], "share"),
        (["--certify", "-1"], "at least 0"),
        (["--max-inner", "0.5"], "at least 0"),
        (["--growth", "0.1"], "--growth"),
        (["--max-viewpoints", "4"], "--max-viewpoints"),
        (["--method", "magic"], "hybrid"),
        (["--workers", "0"], "at least 1"),
        (["--box", "1", "1", "1", "0", "2", "2"], "X0 < X1"),
    ],
)
def test_wrong_arguments_exit_with_2_and_say_which(words: list[str], message: str, capsys: Capture) -> None:
    assert message in refused(capsys, "builtin:two_rooms", "-o", "x.pvs", *words)
    assert not Path("x.pvs").exists()


@pytest.mark.parametrize(
    ("said", "size"), [("4GB", 4e9), ("2GiB", 2**31), ("500MB", 5e8), ("1.5 gb", 1.5e9), ("64kib", 65536)]
)
def test_sizes_are_in_powers_of_ten_or_of_two(said: str, size: float) -> None:
    from gsvis.cli import parse
    from gsvis.cli.options import value_of

    assert value_of(parse(["pvs", "x", "-o", "y", "--max-memory", said]), "max_memory") == size


def test_what_is_no_store_is_not_replaced(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    before = ply.read_bytes()
    assert "something else" in refused(capsys, ply, "-o", ply, *QUICK)
    assert ply.read_bytes() == before
    assert "folder" in refused(capsys, ply, "-o", tmp_path, *QUICK)
    assert "rooms.ply" in refused(capsys, ply, "-o", ply / "below.pvs", *QUICK)
    (tmp_path / "cut.pvs").write_bytes(b"\x93GSPVS\r\n and the rest is lost")
    assert main(["pvs", str(ply), "-o", str(tmp_path / "cut.pvs"), *QUICK, *BOX]) == 0
    VisibilityStore.open(tmp_path / "cut.pvs").close()


def test_scenes_that_cannot_serve_are_refused_with_a_remedy(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scene.ply").touch()
    base = [tmp_path / "scene.ply", "-o", tmp_path / "a.pvs", *QUICK]
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: Gaussians.empty())
    assert "nothing to see" in refused(capsys, *base)
    block = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[9, 9, 9]], [0.99], np.zeros((1, 1, 3)))
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: block)
    assert "something solid; give" in refused(capsys, *base, "--box", "-1", "-1", "-1", "1", "1", "1")
    faint = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.001], np.zeros((1, 1, 3)))
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: faint)
    assert "--box" in refused(capsys, *base)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.ply"]


def test_the_help_states_the_defaults_of_the_library(capsys: Capture) -> None:
    assert main(["pvs", "--help-all"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for value in (PvsConfig.size, f"{PvsConfig.limit:g}", PvsConfig.rays, PvsConfig.max_inner):
        assert f"(default: {value})" in text


def test_the_time_left_does_not_count_what_was_done_before(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    from gsvis.cli import terminal

    clock = iter(np.arange(0.0, 1000.0, 20.0))
    monkeypatch.setattr(terminal, "_clock", lambda: float(next(clock)))
    with terminal.Status() as status:
        status("cells", 90, 100)
        status("cells", 91, 100)
    assert "91 of 100, about 6 min 00 s left" in capsys.readouterr().err


def test_killed_interrupted_and_finished(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "rooms.pvs"
    long = [str(ply), "--cells", "8", "--face-size", "16", "--certify", "256", "--max-inner", "1", *BOX]
    killed = Halted("cells", 2, "pvs", *long, "-o", out, "--workers", "2")
    killed.wait()
    assert len(killed.members()) > 1
    code, *_ = killed.end(signal.SIGKILL, group=False)  # returns once its workers have noticed
    assert code == -signal.SIGKILL
    earlier = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.partial-*/*.bin")}
    assert len([name for name in earlier if name.startswith("cell-")]) == 2
    assert not out.exists()
    stopped = Halted("cells", 4, "pvs", *long, "-o", out, "--workers", "2")
    stopped.wait()
    code, said, text = stopped.end(signal.SIGINT)
    assert (code, said) == (130, "")
    last = text.splitlines()[-1]
    assert "Traceback" not in text
    assert last.startswith("gsvis: interrupted; ")
    assert "run the same command to resume" in last
    now = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.partial-*/*.bin")}
    assert earlier.items() <= now.items()
    looked, found = (len([name for name in now if name.startswith(kind)]) for kind in ("viewpoint-", "cell-"))
    assert found == 4
    assert f"{looked} of {looked} viewpoints and 4 of" in last
    assert main(["pvs", *long, "-o", str(out), "--workers", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["format"] == "gsvis-pvs"
    assert main(["pvs", *long, "-o", str(tmp_path / "at_once.pvs"), "--workers", "1"]) == 0
    assert out.read_bytes() == (tmp_path / "at_once.pvs").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["at_once.pvs", "in", "rooms.pvs"]
