"""OpenUSD: another program's library reads what was written, value by value, and knows the schema."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io.losses import watch_losses
from gsvis.io.usd_writer import save_usd
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.similarity import upright_matrix
from tests.io.scene_files import random_scene

pytest.importorskip("pxr", reason="needs usd-core, of the extra usd")

from pxr import Usd, UsdGeom, UsdValidation, UsdVol


def splats_of(path: Path) -> tuple[Usd.Stage, UsdVol.ParticleField3DGaussianSplat]:
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    return stage, UsdVol.ParticleField3DGaussianSplat(prim)


def values(prim: Usd.Prim, name: str) -> np.ndarray:
    return np.asarray(prim.GetAttribute(name).Get())


@pytest.mark.parametrize("suffix", [".usdz", ".usdc", ".usda", ".usd"])
@pytest.mark.parametrize("degree", [0, 3])
def test_every_value_is_kept(tmp_path: Path, suffix: str, degree: int) -> None:
    scene = random_scene(30, degree)
    size = save_usd(scene, tmp_path / f"a{suffix}")
    assert size == (tmp_path / f"a{suffix}").stat().st_size
    _, splats = splats_of(tmp_path / f"a{suffix}")
    prim = splats.GetPrim()
    coefficients = np.concatenate([scene.sh0, scene.shN], axis=1)
    np.testing.assert_array_equal(values(prim, "positions"), scene.means)
    np.testing.assert_array_equal(values(prim, "scales"), scene.scales)
    np.testing.assert_array_equal(values(prim, "opacities"), scene.opacities)
    found = values(prim, "radiance:sphericalHarmonicsCoefficients")
    np.testing.assert_array_equal(found.reshape(30, -1, 3), coefficients)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == degree
    quats = prim.GetAttribute("orientations").Get()
    np.testing.assert_array_equal([[q.GetReal(), *q.GetImaginary()] for q in quats], scene.quats)


def test_the_prim_is_placed_upright_at_its_origin(tmp_path: Path) -> None:
    g = random_scene(5, 0)
    origin = (500_000.0, -4_000_000.0, 200.0)
    scene = g.with_facts(SceneFacts(origin=origin))
    upright = upright_matrix(np.array([0.0, 0.0, 1.0]), 0.5)
    save_usd(scene, tmp_path / "a.usdz", upright=upright)
    stage, splats = splats_of(tmp_path / "a.usdz")
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    matrix = UsdGeom.Xformable(splats.GetPrim()).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    for center in g.means.astype(np.float64):
        want = upright[:3, :3] @ (center + origin) + upright[:3, 3]
        np.testing.assert_allclose(matrix.Transform(center.tolist()), want, rtol=1e-12)


def test_its_own_validators_find_no_fault(tmp_path: Path) -> None:
    save_usd(random_scene(20, 2), tmp_path / "a.usdz")
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []


def test_the_box_holds_three_standard_deviations(tmp_path: Path) -> None:
    scene = random_scene(20, 0)
    save_usd(scene, tmp_path / "a.usdc")
    _stage, splats = splats_of(tmp_path / "a.usdc")
    low, high = values(splats.GetPrim(), "extent")
    assert (low <= (scene.means - 2.9 * scene.scales.max(axis=1)[:, None]).min(axis=0)).all()
    assert (high >= (scene.means + 2.9 * scene.scales.max(axis=1)[:, None]).max(axis=0)).all()


def test_what_it_cannot_hold_is_said(tmp_path: Path) -> None:
    with watch_losses() as losses:
        save_usd(random_scene(3, 0).with_facts(SceneFacts(antialiased=True)), tmp_path / "a.usdc")
    assert [loss.what for loss in losses] == ["antialiased"]
    with pytest.raises(ValueError, match="at least one"):
        save_usd(Gaussians.empty(), tmp_path / "b.usdc")
    with pytest.raises(ValueError, match=r"ends in \.usdz"):
        save_usd(random_scene(3, 0), tmp_path / "b.obj")
    assert [path.name for path in tmp_path.iterdir()] == ["a.usdc"]


def test_export_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rooms.usdz"
    assert main(["export", "builtin:two_rooms", "-o", str(out), "--format", "usd"]) == 0
    assert "SH degree 3" in capsys.readouterr().out
    _stage, splats = splats_of(out)
    matrix = UsdGeom.Xformable(splats.GetPrim()).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    up = matrix.TransformDir((0, 0, 1))
    np.testing.assert_allclose(up, (0, 1, 0), atol=1e-9)
    assert main(["export", "builtin:two_rooms", "-o", str(tmp_path / "a.glb"), "--format", "usd"]) == 2
    assert "--out: expected a file that ends in .usdz, .usdc, .usda, .usd" in capsys.readouterr().err
