"""Checkpoints that are damaged: a clear error or the same run, whatever bit is wrong and wherever the file ends."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.checkpoint import load_checkpoint, save_checkpoint
from gsvis.train.images import PosedImages
from gsvis.train.trainer import TrainConfig, Trainer


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    rng = np.random.default_rng(0)
    g = Gaussians(
        rng.normal(size=(4, 3)), rng.normal(size=(4, 4)), np.full((4, 3), 0.2), np.full(4, 0.5), np.zeros((4, 1, 3))
    )
    cameras = Cameras.orbit((0, 0, 0), 4.0, 8, width=8, height=8)
    return Trainer(PosedImages(cameras, np.zeros((8, 8, 8, 3), np.uint8)), g, TrainConfig(iterations=2, sh_degree=1))


def values(trainer: Trainer) -> list[bytes]:
    return [tensor.detach().numpy().tobytes() for tensor in trainer.parameters.values.values()]


def damaged(whole: bytes, flips: range, cuts: range) -> list[bytes]:
    out = [whole[:length] for length in cuts]
    for bit in flips:
        changed = bytearray(whole)
        changed[bit >> 3] ^= 1 << (bit & 7)
        out.append(bytes(changed))
    return out


def outcome(path: Path, data: bytes, trainer: Trainer) -> bool:
    """Whether damage was noticed; what was not has to be the same run."""
    path.write_bytes(data)
    before = values(trainer)
    try:
        load_checkpoint(path, trainer)
    except FormatError as error:
        assert "checkpoint" in str(error)
        return True
    assert values(trainer) == before
    return False


def test_damage_is_reported_and_never_loaded(trainer: Trainer, tmp_path: Path) -> None:
    path = tmp_path / "run.ckpt"
    save_checkpoint(path, trainer)
    whole = path.read_bytes()
    assert not outcome(path, whole, trainer)
    ends = 8 * len(whole)
    some = damaged(whole, range(0, ends - 400, 53), range(0, len(whole), 53))
    some += damaged(whole, range(ends - 400, ends), range(len(whole) - 40, len(whole)))
    noticed = [outcome(path, data, trainer) for data in some]
    assert sum(noticed) > 0.9 * len(noticed)  # bits of the mark itself do no harm


def test_damage_of_a_checkpoint_without_checksum_is_reported(trainer: Trainer, tmp_path: Path) -> None:
    path = tmp_path / "run.ckpt"
    save_checkpoint(path, trainer)
    with zipfile.ZipFile(path, "a") as archive:
        archive.comment = b"of an earlier version"
    whole = path.read_bytes()
    assert not outcome(path, whole, trainer)
    for data in damaged(whole, range(0, 8 * len(whole), 211), range(0, len(whole), 211)):
        path.write_bytes(data)
        try:
            load_checkpoint(path, trainer)
        except (FormatError, ValueError):  # a wrong key is one of another run
            continue
