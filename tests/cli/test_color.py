"""`gsvis color` in this process and as one of its own: what it writes, says, refuses, keeps and leaves behind."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.color import load_srbf, srbf_info
from gsvis.color.fit import FitConfig
from gsvis.color.variants import DEFAULT_VARIANT, VARIANTS
from gsvis.io import load_scene, save_scene
from gsvis.package.active_terms import ActiveTerms
from gsvis.prepare.colors import ColorConfig
from gsvis.prepare.fitted_colors import PRECISION_NAMES
from gsvis.pvs import VisibilityStore
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import two_rooms
from gsvis.scene.view_sampling import ViewSampling
from tests.cli.halted import Halted
from tests.train.photo_files import write_photos

Capture = pytest.CaptureFixture[str]
LEARN = ["--views", "4", "--held-out", "2", "--width", "48", "--height", "36", "--max-terms", "2", "--mean-terms", "1"]
QUICK = [*LEARN, "--color-steps", "0"]


@pytest.fixture(scope="module")
def ply(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("in")
    save_scene(two_rooms(1000, sh_degree=2).gaussians, folder / "rooms.ply")
    return folder / "rooms.ply"


@pytest.fixture(scope="module")
def pvs(ply: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pvs") / "rooms.pvs"
    quick = ["--cells", "4", "--face-size", "16", "--workers", "1", "--certify", "256", "--max-inner", "1"]
    box = ["--box", "0.5", "0.5", "0.5", "3.5", "3.5", "2.5"]
    assert main(["pvs", str(ply), "-o", str(path), *quick, *box]) == 0
    return path


def document(capsys: Capture, *words: object) -> dict:
    capsys.readouterr()
    assert main(["color", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys: Capture, *words: object) -> str:
    capsys.readouterr()
    assert main(["color", *map(str, words)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    return " ".join(err.split())


def test_a_file_is_written_and_summarized(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "new" / "rooms.arrow"
    assert main(["color", str(ply), "-o", str(out), *QUICK]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.replace(str(tmp_path), "").splitlines())) <= 80
    assert "…" not in text
    for label in ("directions", "terms", "bytes of a color", "all terms", "base colors alone"):
        assert label in text
    assert [path.name for path in out.parent.iterdir()] == ["rooms.arrow"]  # what was kept has gone
    scene, (geometry, colors) = load_scene(ply), load_srbf(out)
    assert np.array_equal(geometry.means, scene.means)
    assert colors.variant == DEFAULT_VARIANT
    assert colors.counts.max() <= 2
    assert colors.num_terms / len(colors) == pytest.approx(1.0, abs=0.2)
    info = srbf_info(out)
    assert info.provenance["fit"]["max_terms"] == 2
    assert info.provenance["epsilon"] is None


def test_the_document_and_the_same_bytes_again(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    found = document(capsys, ply, "-o", tmp_path / "a.arrow", *QUICK)
    assert (found["format"], found["version"]) == ("gsvis-color", 1)
    assert found["file_bytes"] == (tmp_path / "a.arrow").stat().st_size
    _, colors = load_srbf(tmp_path / "a.arrow")
    assert found["terms"]["total"] == colors.num_terms
    assert sum(found["terms"]["gaussians_by_count"]) == pytest.approx(1.0)
    assert sum(found["terms"]["importance_by_count"]) == pytest.approx(1.0)
    assert found["bytes_per_gaussian"]["sh_32"] == 4 * 27
    quality = found["quality"]
    assert quality["views"] == len(quality["cameras"]) == 2
    assert quality["all_terms"]["psnr"]["mean"] > quality["base_only"]["psnr"]["mean"]
    assert found["epsilon"] is found["active_in_cells"] is None
    document(capsys, ply, "-o", tmp_path / "b.arrow", *QUICK)
    assert (tmp_path / "a.arrow").read_bytes() == (tmp_path / "b.arrow").read_bytes()


def test_visible_sets_give_directions_and_active_terms(ply: Path, pvs: Path, tmp_path: Path, capsys: Capture) -> None:
    out, active = tmp_path / "rooms.arrow", tmp_path / "rooms.terms.arrow"
    words = [ply, "-o", out, "--pvs", pvs, "--active", active, "--epsilon", "0.02", *QUICK]
    found = document(capsys, *words, "--precision", "fine")
    assert found["epsilon"] == {"value": 0.02, "from": "given"}
    assert found["directions"]["from"].startswith("of the visible sets")
    scene, (_, colors) = load_scene(ply), load_srbf(out)
    with VisibilityStore.open(pvs) as sets, ActiveTerms.open(active, scene=scene, colors=colors, sets=sets) as store:
        assert store.epsilon == 0.02
        shares = [store.share(cell).of_all for cell in range(len(store))]
    assert found["active_in_cells"]["cells"] == len(shares)
    assert found["active_in_cells"]["share_of_all"]["mean"] == pytest.approx(np.mean(shares))
    assert srbf_info(out).provenance["epsilon"] == 0.02


def test_visible_sets_of_another_scene_are_refused(ply: Path, pvs: Path, tmp_path: Path, capsys: Capture) -> None:
    save_scene(two_rooms(1000, sh_degree=1).gaussians, tmp_path / "other.ply")
    output = refused(capsys, tmp_path / "other.ply", "-o", tmp_path / "a.arrow", "--pvs", pvs, *QUICK)
    assert "expected a store of" in output
    assert "no.pvs: no such file" in refused(capsys, ply, "-o", tmp_path / "a.arrow", "--pvs", tmp_path / "no.pvs")
    assert [path.name for path in tmp_path.iterdir()] == ["other.ply"]


def test_no_terms_and_no_view_dependence(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    words = [ply, "-o", tmp_path / "a.arrow", *QUICK[:8], "--max-terms", "0", "--color-steps", "0"]
    found = document(capsys, *words, "--precision", "exact")
    assert found["terms"]["total"] == 0
    assert found["quality"]["all_terms"] == found["quality"]["base_only"]
    save_scene(two_rooms(1000, sh_degree=0).gaussians, tmp_path / "plain.ply")
    assert main(["color", str(tmp_path / "plain.ply"), "-o", str(tmp_path / "b.arrow"), *QUICK]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "nothing to fit" in text
    _, colors = load_srbf(tmp_path / "b.arrow")
    assert (len(colors), colors.num_terms) == (len(load_scene(tmp_path / "plain.ply")), 0)


@pytest.fixture
def few_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    from gsvis.prepare import learned_colors

    monkeypatch.setattr(learned_colors, "RENDERS", ViewSampling(9, 48, 36, stream=3))


def test_colors_learn_from_renders(ply: Path, tmp_path: Path, capsys: Capture, few_renders: None) -> None:
    words = [ply, "-o", tmp_path / "a.arrow", *LEARN, "--color-steps", "5"]
    found = document(capsys, *words)
    learned = found["learned"]
    assert (learned["from"], learned["views"], learned["held_out"]) == ("renders", 7, 2)
    assert set(learned["psnr"]) == {"fitted", "learned"}
    assert learned["psnr"]["learned"]["mean"] != learned["psnr"]["fitted"]["mean"]
    assert srbf_info(tmp_path / "a.arrow").provenance["learned"]["config"]["steps"] == 5
    assert document(capsys, *words[:2], tmp_path / "b.arrow", *words[3:])["learned"] == learned
    assert (tmp_path / "a.arrow").read_bytes() == (tmp_path / "b.arrow").read_bytes()
    assert document(capsys, ply, "-o", tmp_path / "c.arrow", *QUICK)["learned"] is None


def test_colors_learn_unless_told_otherwise(
    ply: Path, tmp_path: Path, capsys: Capture, few_renders: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsvis.prepare import learned_colors

    monkeypatch.setattr(learned_colors, "_STEPS", 2)
    found = document(capsys, ply, "-o", tmp_path / "a.arrow", *LEARN)
    assert found["learned"]["config"]["steps"] == 2


def test_colors_learn_from_photographs(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    photos = write_photos(tmp_path / "photos")
    out = tmp_path / "a.arrow"
    found = document(capsys, ply, "-o", out, "--photos", photos, "--color-steps", "10", *LEARN)
    learned = found["learned"]
    assert (learned["from"], learned["views"], learned["held_out"]) == ("photographs", 8, 2)
    assert set(learned["psnr"]) == {"sh", "fitted", "learned"}
    unlike = [remark for remark in found["remarks"] if "unlike the photographs" in remark]
    assert len(unlike) == 1  # they show something else
    said = refused(capsys, ply, "-o", out, "--photos", tmp_path / "none")
    assert "no such file or folder" in said
    assert "--downscale: expected --photos" in refused(capsys, ply, "-o", out, "--downscale", "2")


def test_a_report(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    words = [ply, "-o", tmp_path / "a.arrow", "--report", tmp_path / "r", *QUICK]
    found = document(capsys, *words)
    report = json.loads((tmp_path / "r" / "report.json").read_text(encoding="utf-8"))
    assert report["format"] == "gsvis-color-report"
    assert report["terms"] == found["terms"]
    assert report["quality"]["all_terms"] == found["quality"]["all_terms"]
    assert "--max-terms 2 --mean-terms 1" in report["command"]
    assert found["epsilon"]["from"] == "calibrated"  # without being asked for, since the report shows it
    assert srbf_info(tmp_path / "a.arrow").provenance["epsilon"] == found["epsilon"]["value"]
    assert found["epsilon"]["value"] in [each["epsilon"] for each in found["quality"]["active"]]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.arrow", "r"]


def test_contradictions_are_refused_before_the_work(ply: Path, pvs: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "a.arrow"
    assert "--active: expected --pvs" in refused(capsys, ply, "-o", out, "--active", tmp_path / "b.arrow")
    assert "--up: expected none with --pvs" in refused(capsys, ply, "-o", out, "--pvs", pvs, "--up", "-y")
    assert "--held-out" in refused(capsys, ply, "-o", out, "--report", tmp_path / "r", "--held-out", "0")
    assert "got one twice" in refused(capsys, ply, "-o", out, "--pvs", pvs, "--active", out)
    assert "which is read" in refused(capsys, ply, "-o", ply)
    assert "which is read" in refused(capsys, ply, "-o", out, "--pvs", pvs, "--active", pvs)
    (tmp_path / "notes.txt").write_text("keep me")
    assert "something else" in refused(capsys, ply, "-o", tmp_path / "notes.txt")
    assert "got a folder" in refused(capsys, ply, "-o", tmp_path)
    assert "rooms.ply" in refused(capsys, ply, "-o", ply / "below.arrow")
    assert "no.ply: no such file" in refused(capsys, tmp_path / "no.ply", "-o", out)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_without_flip_it_is_not_used_and_refused_at_once_where_it_is_needed(
    ply: Path, pvs: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    base = [ply, "-o", tmp_path / "a.arrow", *QUICK]
    assert 'pip install "gsvis[metrics]"' in refused(capsys, *base, "--epsilon", "auto")
    assert "give a number" in refused(capsys, *base, "--pvs", pvs, "--active", tmp_path / "b.arrow")
    assert list(tmp_path.iterdir()) == []
    assert main(["color", *map(str, base)]) == 0
    assert "FLIP was not asked" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--variant", "magic"], "rgb, hsl"),
        (["--max-terms", "33"], "0 to 32"),
        (["--max-terms", "-1"], "0 to 32"),
        (["--mean-terms", "few"], "or all"),
        (["--mean-terms", "nan"], "or all"),
        (["--epsilon", "0"], "or auto"),
        (["--epsilon", "2"], "or auto"),
        (["--precision", "float"], "exact"),
        (["--views", "0"], "at least 1"),
        (["--up", "up"], "+z"),
    ],
)
def test_wrong_arguments_exit_with_2_and_say_which(words: list[str], message: str, capsys: Capture) -> None:
    assert message in refused(capsys, "builtin:two_rooms", "-o", "x.arrow", *words)
    assert not Path("x.arrow").exists()


def test_the_help_states_the_defaults_and_choices_of_the_library(capsys: Capture) -> None:
    assert main(["color", "--help-all"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "{" + ",".join(VARIANTS) + "}" in text
    assert "{" + ",".join(PRECISION_NAMES) + "}" in text
    values = (DEFAULT_VARIANT, FitConfig.max_terms, f"{FitConfig.mean_terms:g}", ColorConfig.views.count, "wire")
    for value in values:
        assert f"(default: {value})" in text


def test_a_scene_that_does_not_fit_the_memory_is_refused_before_it_is_read(
    ply: Path, tmp_path: Path, capsys: Capture
) -> None:
    said = refused(capsys, ply, "-o", tmp_path / "a.arrow", *QUICK, "--max-memory", "100MB")
    assert "--max-memory: expected at least" in said
    assert "gsvis world --until levels" in said
    assert list(tmp_path.iterdir()) == []


def test_scenes_that_cannot_serve_are_refused_with_a_remedy(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scene.ply").touch()
    base = [tmp_path / "scene.ply", "-o", tmp_path / "a.arrow", *QUICK]
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: Gaussians.empty())
    assert "nothing to color" in refused(capsys, *base)
    faint = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.001], np.zeros((1, 1, 3)), np.ones((1, 3, 3)))
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: faint)
    message = refused(capsys, *base)
    assert "no navigable space" in message
    assert "with --box, or give visible sets with --pvs" in message
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_a_run_that_is_stopped_leaves_no_file_and_is_resumed(tmp_path: Path) -> None:
    out = tmp_path / "rooms.arrow"
    save_scene(two_rooms(12_000, sh_degree=1).gaussians, tmp_path / "rooms.ply")
    words = [str(tmp_path / "rooms.ply"), "-o", str(out), "--held-out", "0", "--views", "2", "--mean-terms", "0.5"]
    words += ["--width", "32", "--height", "24", "--max-terms", "2", "--color-steps", "0"]
    words += ["--box", "1", "1", "1", "7", "3", "2"]
    stopped = Halted("directions", 8193, "color", *words)  # more than one block of 8,192
    stopped.wait()
    code, said, text = stopped.end(signal.SIGINT)
    assert (code, said) == (130, ""), text
    (kept,) = tmp_path.glob("rooms.arrow.partial-*")
    assert f"{kept.name}; run the same command to resume" in text.splitlines()[-1]
    assert "Traceback" not in text
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["rooms.ply", kept.name])
    with np.load(kept / "found.npz") as file:
        assert file["traced"][0] == 8192
    assert main(["color", *words]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rooms.arrow", "rooms.ply"]
