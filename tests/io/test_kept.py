"""Nothing is lost in silence: pairs of formats keep each property within its step, or a line says what they lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsvis.io.compressed_ply_writer import save_compressed_ply
from gsvis.io.gltf_splats_writer import save_glb
from gsvis.io.ksplat import save_ksplat
from gsvis.io.losses import Loss, watch_losses
from gsvis.io.ply import save_ply
from gsvis.io.scenes import load_scene
from gsvis.io.sog_writer import save_sog
from gsvis.io.spz import save_spz
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.morton import morton_order
from gsvis.scene.sh import SH_C0
from tests.io.scene_files import random_scene


@dataclass(frozen=True)
class Format:
    """How a format is written, and its steps: the largest error that rounding makes."""

    suffix: str
    save: Callable[[Gaussians, Path], Any]
    means: float = 0.0
    log_scales: float = 2e-6
    opacities: float = 1e-6
    sh0: float = 1e-6
    shN: float = 1e-6  # noqa: N815  the field's own name
    turn: float = 1e-3
    order: Callable[[Any], Any] | None = None


BYTE = 0.5 / 255.0
SPZ = {
    "log_scales": 0.5 / 16 + 1e-5,
    "opacities": BYTE + 1e-6,
    "sh0": BYTE / 0.15 + 1e-5,
    "shN": 0.5 / 128,
    "turn": 3e-3,
}
KSPLAT = {"opacities": BYTE + 1e-6, "sh0": BYTE / SH_C0 + 1e-5}
HALF = {**KSPLAT, "log_scales": 6e-4, "turn": 1.5e-3}
COMPRESSED = {
    "log_scales": 0.5 / 32,
    "opacities": BYTE + 1e-6,
    "sh0": BYTE / SH_C0 + 1e-5,
    "shN": 4.0 / 256,
    "turn": 3e-3,
}
FORMATS = {
    "ply": Format(".ply", save_ply),
    "spz": Format(".spz", save_spz, means=4e-5, **SPZ),
    "sog": Format(".sog", save_sog, means=2e-4, log_scales=1e-5, opacities=BYTE + 1e-6, sh0=1e-5, shN=0.05, turn=0.015),
    "ksplat0": Format(".ksplat", lambda g, p: save_ksplat(g, p, compression=0), **KSPLAT),
    "ksplat1": Format(".ksplat", save_ksplat, means=4e-5, shN=1e-3, **HALF),
    "ksplat2": Format(".ksplat", lambda g, p: save_ksplat(g, p, compression=2), means=4e-5, shN=0.02, **HALF),
    "compressed": Format(".compressed.ply", save_compressed_ply, means=4e-3, order=morton_order, **COMPRESSED),
    "glb": Format(".glb", save_glb),
    "glb-spz": Format(".glb", lambda g, p: save_glb(g, p, compression="spz"), means=4e-5, **SPZ),
}
Writer = Callable[[SceneFacts, str], tuple[Gaussians, list[Loss]]]
PAIRS = list(product(FORMATS, FORMATS))
FACTS = SceneFacts(
    up=(0.6, 0.8, 0.0),
    up_source="a test",
    antialiased=True,
    meters_per_unit=0.5,
    box=((-1.0, -2.0, -3.0), (1.0, 2.0, 3.0)),
)


def tame() -> Gaussians:
    """A scene that every format holds."""
    g = random_scene(60, 2, seed=5)
    sh0 = np.clip(g.sh0, -0.45 / SH_C0, 0.45 / SH_C0)
    scales = np.clip(g.scales, 1e-3, 0.5)
    return Gaussians(g.means, g.quats, scales, g.opacities, sh0, np.clip(g.shN, -0.9, 0.9))


def wild() -> Gaussians:
    """A scene with a flyaway, bright colors, a disc, a wide Gaussian and strong harmonics of degree 3."""
    g = random_scene(60, 3, seed=6)
    means, scales, sh0, higher = (np.array(part) for part in (g.means, g.scales, g.sh0, g.shN))
    means[0] = 1e6, 3.0, 0.0
    scales[1, 2], scales[2, 0] = 1e-30, 1e5
    sh0[3], sh0[4] = 9.0, -9.0
    higher[5, 0] = 4.0
    return Gaussians(means, g.quats, scales, g.opacities, sh0, higher)


def reread(g: Gaussians, name: str, folder: Path) -> tuple[Gaussians, list[Loss]]:
    path = folder / f"{name}{FORMATS[name].suffix}"
    with watch_losses() as losses:
        FORMATS[name].save(g, path)
        return load_scene(path), list(losses)


@pytest.fixture(scope="module")
def written_once(tmp_path_factory: pytest.TempPathFactory) -> Writer:
    """The scene that every format holds, with facts, as it comes back from a format: the first of each pair, once."""
    folder = tmp_path_factory.mktemp("once")

    @cache
    def write(facts: SceneFacts, name: str) -> tuple[Gaussians, list[Loss]]:
        return reread(tame().with_facts(facts), name, folder)

    return write


def check_kept(before: Gaussians, after: Gaussians, fmt: Format, losses: list[Loss]) -> None:
    said = {loss.what for loss in losses}
    assert len(after) == len(before)
    there, here = (g.facts.to_source(g.means) for g in (before, after))
    if "centers" not in said:
        away, match = cKDTree(here).query(there)
        assert away.max() <= fmt.means + 1e-12 * np.abs(there).max()
    elif fmt.order is not None:
        match = np.argsort(fmt.order(before.means))
    else:
        match = np.arange(len(before))  # the others keep the order where they move centers
    after = after[match]
    found = {
        "scales": np.abs(np.log(after.scales.astype(float)) - np.log(before.scales.astype(float))).max()
        - fmt.log_scales,
        "opacities": np.abs(after.opacities - before.opacities).max() - fmt.opacities,
        "colors": np.abs(after.sh0 - before.sh0).max() - fmt.sh0,
        "rotations": (1.0 - np.abs((after.quats * before.quats).sum(axis=1))).max() - fmt.turn**2,
    }
    wide = before.shN.shape[1]
    higher = np.pad(after.shN, ((0, 0), (0, wide - after.shN.shape[1]), (0, 0)))
    found["SH"] = np.abs(higher - before.shN).max(initial=0.0) - fmt.shN
    assert {what: over for what, over in found.items() if over > 0.0 and what not in said} == {}


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_every_pair_of_formats_keeps_a_scene(tmp_path: Path, written_once: Writer, first: str, second: str) -> None:
    once, losses = written_once(SceneFacts(), first)
    assert losses == []
    check_kept(tame(), once, FORMATS[first], losses)
    twice, losses = reread(once, second, tmp_path)
    assert losses == []
    check_kept(once, twice, FORMATS[second], losses)


@pytest.mark.parametrize("name", FORMATS)
def test_what_a_format_cannot_hold_is_said(tmp_path: Path, name: str) -> None:
    again, losses = reread(wild(), name, tmp_path)
    check_kept(wild(), again, replace(FORMATS[name], means=2e-3 if name == "sog" else FORMATS[name].means), losses)
    assert bool(losses) == (name not in ("ply", "glb", "sog"))


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_facts_survive_every_pair_of_formats(tmp_path: Path, written_once: Writer, first: str, second: str) -> None:
    once, _ = written_once(FACTS, first)
    twice, losses = reread(once, second, tmp_path)
    up, source = twice.facts.up, twice.facts.up_source
    np.testing.assert_allclose(up, FACTS.up, atol=1e-7)
    assert source == FACTS.up_source
    assert replace(twice.facts, up=None, up_source="") == replace(FACTS, up=None, up_source="")
    assert {loss.what for loss in losses} <= {"antialiased"}
    assert bool(losses) == (second not in ("ply", "compressed", "spz", "sog"))  # kept for gsvis alone: one line


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_projected_coordinates_survive_every_pair_of_formats(
    tmp_path: Path, written_once: Writer, first: str, second: str
) -> None:
    origin = (500_120.0, 4_649_780.0, 210.0)
    scene = tame().with_facts(SceneFacts(origin=origin))
    once, _ = written_once(scene.facts, first)
    twice, losses = reread(once, second, tmp_path)
    assert twice.facts.origin == origin
    assert losses == []
    loose = FORMATS[first].means + FORMATS[second].means + 1e-8
    check_kept(scene, twice, replace(widest(FORMATS[first], FORMATS[second]), means=loose), losses)


def widest(a: Format, b: Format) -> Format:
    names = ("log_scales", "opacities", "sh0", "shN", "turn")
    return replace(a, **{name: getattr(a, name) + getattr(b, name) for name in names})


def test_files_of_ordinary_scenes_state_nothing(tmp_path: Path) -> None:
    for name, fmt in FORMATS.items():
        fmt.save(tame(), tmp_path / f"{name}{fmt.suffix}")
        data = (tmp_path / f"{name}{fmt.suffix}").read_bytes()
        assert b"comment" not in data
        assert b"gsvis facts" not in data
        assert b'"extras"' not in data
