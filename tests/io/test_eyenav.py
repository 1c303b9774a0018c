"""EyeNavGS recordings: axes and meters by construction, faults, and what real recordings say of the axes."""

from __future__ import annotations

import gzip
import logging
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.io._table import read_table
from gsvis.io.eyenav import SceneSetting, read_eyenav, read_scene_settings
from gsvis.io.poses import load_path
from gsvis.scene.gaussians import quats_from_rotations, rotations_from_quats

F64 = NDArray[np.float64]

HEADER = (
    "ViewIndex,FOV1,FOV2,FOV3,FOV4,PositionX,PositionY,PositionZ,QuaternionX,QuaternionY,QuaternionZ,QuaternionW,"
    "GazePosX,GazePosY,GazePosZ,GazeQX,GazeQY,GazeQZ,GazeQW,Timestamp"
)
GAZE_POS, GAZE_TURN = "GazePosX,GazePosY,GazePosZ", "GazeQX,GazeQY,GazeQZ,GazeQW"
OTHER_HEADER = HEADER.replace(f"{GAZE_POS},{GAZE_TURN},Timestamp", f"{GAZE_TURN},{GAZE_POS},timestep")
SETTING = SceneSetting((-0.2334, 0.0, 0.0, 0.9724), 2.0)
SETTINGS = '\ufeffScene_Name,Quaternion,Scale,Initial_Position\nroom,"-0.2334, 0.0000, 0.0000, 0.9724",2,"0,1.15,0"\n'
IPD = 0.064


def level() -> F64:
    x, y, z, w = SETTING.quat
    return np.asarray(rotations_from_quats(np.array([[w, x, y, z]]) / np.hypot(x, w))[0])


def turned(degrees: float) -> F64:
    """OpenXR head axes turned to the left about +y: at 0 it looks along -z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rows_of(heads: F64, degrees: F64, period: int = 14, digits: int = 3) -> list[str]:
    """Rows of a level walk in meters, as the headset would have written them for a scene with SETTING."""
    rows = []
    for i, (head, angle) in enumerate(zip(heads, degrees, strict=True)):
        rotation = level().T @ turned(angle)
        w, x, y, z = quats_from_rotations(rotation[None])[0] * (-1 if i % 3 == 0 else 1)
        for eye, side in ((0, -0.5), (1, 0.5)):
            place = SETTING.scale * (level().T @ (head + side * IPD * turned(angle)[:, 0]))
            numbers = [*(round(v, digits) for v in (*place, x, y, z, w)), *[0.0] * 7]
            rows.append(f"{eye},-0.942,0.698,-0.942,0.733," + ",".join(map(str, numbers)) + f",{period * i + 4 * eye}")
    return rows


def written(folder: Path, rows: list[str], name: str = "user1_room.csv.gz", header: str = HEADER) -> Path:
    (folder / "scene_setting.csv").write_text(SETTINGS, encoding="utf-8")
    file = folder / name
    file.parent.mkdir(exist_ok=True)
    text = "\n".join([header, *rows, ""])
    file.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return file


def walk(count: int = 40) -> tuple[F64, F64]:
    heads = np.stack([np.linspace(0, 1, count), np.full(count, 0.1), np.linspace(0, -2, count)], axis=1)
    return heads, np.linspace(0, 270, count)


@pytest.mark.parametrize("name", ["user1_room.csv.gz", "user1_room.csv", "room/user1_room.csv", "room/anything.csv"])
def test_a_known_walk_comes_out_in_meters_level_and_in_opencv_axes(tmp_path: Path, name: str) -> None:
    heads, degrees = walk()
    for digits, slack in ((9, 1e-7), (3, 1.5e-3)):
        path = load_path(written(tmp_path, rows_of(heads, degrees, digits=digits), name))
        assert np.allclose(path.times, 0.014 * np.arange(40))
        assert np.allclose(path.positions, heads, atol=slack)
        ahead = np.stack([-np.sin(np.radians(degrees)), 0 * degrees, -np.cos(np.radians(degrees))], axis=1)
        assert np.allclose(path.forwards, ahead, atol=3 * slack)
        assert np.allclose(path.head_ups, [0, 1, 0], atol=3 * slack)
        assert np.allclose(np.linalg.norm(path.quats, axis=1), 1.0)
        assert np.all(np.sum(path.quats[1:] * path.quats[:-1], axis=1) > 0)
        assert path.meters_per_unit == 1.0
        assert np.allclose(path.upright, [0, 1, 0])


def test_the_other_group_names_its_time_otherwise_and_has_gaze_in_another_order(tmp_path: Path) -> None:
    heads, degrees = walk()
    rows = rows_of(heads, degrees, digits=9)
    first = load_path(written(tmp_path, rows))
    other = load_path(written(tmp_path, rows, header=OTHER_HEADER))
    for field in ("times", "positions", "quats"):
        assert np.array_equal(getattr(other, field), getattr(first, field))
    with pytest.raises(FormatError, match="column timestep: expected times that rise"):
        load_path(written(tmp_path, [*rows, *rows], header=OTHER_HEADER))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (HEADER.replace("Timestamp", "ClockTime"), "no Timestamp or timestep; unexpected: ClockTime"),
        (HEADER.replace("PositionY", "PosY"), "got no PositionY; unexpected: PosY"),
        (
            HEADER.replace("QuaternionW", "QW").replace("ViewIndex", "Eye"),
            "no ViewIndex, QuaternionW; unexpected: Eye, QW",
        ),
        (OTHER_HEADER.replace("timestep", "x" * 400), "no Timestamp or timestep; unexpected: 'xxx"),
        (HEADER.replace("GazeQX", "QuaternionW"), "expected one column QuaternionW, got 2 of that name"),
    ],
)
def test_columns_that_differ_are_named(tmp_path: Path, header: str, message: str) -> None:
    heads, degrees = walk(4)
    with pytest.raises(FormatError) as caught:
        load_path(written(tmp_path, rows_of(heads, degrees), header=header))
    assert message in str(caught.value)
    assert "Gaze" not in caught.value.got
    assert len(str(caught.value)) < 600


def test_an_eye_without_its_partner_still_gives_the_head(tmp_path: Path) -> None:
    heads, degrees = walk()
    rows = rows_of(heads, degrees, digits=9)
    whole = read_eyenav(written(tmp_path, rows))
    lame = [row for i, row in enumerate(rows) if i not in (11, 20, 31, 79)]  # right, left, right, the last right
    path = read_eyenav(written(tmp_path, lame))
    assert len(path) == len(whole)
    assert np.allclose(path.at(whole.times)[0], whole.positions, atol=2e-2)  # a lone right eye is stamped 4 ms later
    assert np.allclose(path.positions, path.positions[0] + (whole.positions - whole.positions[0]), atol=1e-6)
    one_eye = read_eyenav(written(tmp_path, rows[::2]))
    assert np.allclose(one_eye.positions, whole.positions, atol=IPD)


def test_stamps_that_do_not_rise_are_dropped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    heads, degrees = walk()
    rows = rows_of(heads, degrees)
    repeated = [*rows[:10], *rows[8:10], *rows[10:20], *rows[12:14], *rows[20:]]
    with caplog.at_level(logging.WARNING, "gsvis"):
        path = read_eyenav(written(tmp_path, repeated))
    assert "dropped 2 frames" in caplog.text
    assert np.array_equal(path.positions, read_eyenav(written(tmp_path, rows)).positions)
    with pytest.raises(FormatError, match="times that rise, got 40 of 80"):
        read_eyenav(written(tmp_path, [*rows, *rows]))


def test_a_gap_is_bridged_and_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    heads, degrees = walk()
    rows = rows_of(heads, degrees, period=100)
    with caplog.at_level(logging.WARNING, "gsvis"):
        path = read_eyenav(written(tmp_path, [*rows[:20], *rows[60:]]))
    assert "a gap of 2.1 s" in caplog.text
    assert np.allclose(path.at(2.0)[0], heads[20], atol=1e-2)


def test_faults_are_reported_with_line_and_column(tmp_path: Path) -> None:
    heads, degrees = walk(4)
    rows = rows_of(heads, degrees)

    def broken(row: int, column: str, value: str) -> Path:
        cells = [line.split(",") for line in rows]
        cells[row][HEADER.split(",").index(column)] = value
        return written(tmp_path, [",".join(line) for line in cells])

    for column, value, message in (
        ("PositionY", "", "line 5, column PositionY: expected a finite number, got ''"),
        ("Timestamp", "inf", "line 5, column Timestamp"),
        ("ViewIndex", "2", "line 5, column ViewIndex: expected 0"),
        ("QuaternionW", "7", "line 5, column QuaternionX to QuaternionW: expected a quaternion of length 1"),
    ):
        with pytest.raises(FormatError, match=message):
            load_path(broken(3, column, value))
    assert len(load_path(broken(3, "GazeQX", "no gaze"))) == 4  # not needed, not read
    with pytest.raises(FormatError, match="at least one pose"):
        load_path(written(tmp_path, []))
    with pytest.raises(FormatError, match="line 9: expected 20 cells"):
        load_path(written(tmp_path, [*rows[:-1], rows[-1][:40]]))


def test_settings_that_are_missing_or_wrong(tmp_path: Path) -> None:
    heads, degrees = walk(4)
    file = written(tmp_path, rows_of(heads, degrees), "user1_attic.csv")
    with pytest.raises(FormatError, match="'attic'"):
        read_eyenav(file)
    assert len(read_eyenav(file, SETTING)) == 4
    settings = tmp_path / "scene_setting.csv"
    for broken, message in (
        (SETTINGS.replace(",2,", ",0,"), "column Scale"),
        (SETTINGS.replace("0.9724", "one"), "column Quaternion"),
        (SETTINGS.replace("0.9724", "0.2"), "column Quaternion"),
        (SETTINGS.replace("Scale", "Size"), "column Scale"),
    ):
        settings.write_text(broken, encoding="utf-8")
        with pytest.raises(FormatError, match=message):
            read_scene_settings(settings)
    settings.unlink()
    with pytest.raises(FormatError, match=r"scene_setting.csv.*pass setting"):
        read_eyenav(file)


@pytest.mark.slow
@pytest.mark.realdata
def test_recordings_read_and_agree_on_the_axes(realdata: Path) -> None:
    """One in three, of every scene: the others were written by the same programs on the same headset."""
    folder = realdata / "traces" / "eyenav_rutgers"
    files = sorted(folder.glob("*/user*.csv.gz"))
    assert len(files) == 44
    ahead, beside, bobbing = [], [], []
    for file in files[::3]:
        path = load_path(file)
        assert 60.0 < path.duration < 140.0
        assert len(path) / path.duration > 55.0
        assert np.diff(path.times).max() < 0.2
        assert np.quantile(path.speed(), 0.99) < 1.5  # nobody runs
        assert np.ptp(path.positions[:, [0, 2]], axis=0).max() < 3.5  # a play area of 3 x 3 m
        bobbing.append(np.ptp(np.quantile(path.positions[:, 1], [0.1, 0.9])))
        mean = path.head_ups.mean(axis=0)
        assert mean[1] / np.linalg.norm(mean) > np.cos(np.radians(20.0))
        strides = path.resample(2.0)
        velocity = np.diff(strides.positions, axis=0)[:, [0, 2]]
        facing = strides.forwards[:-1, [0, 2]]
        fast = np.linalg.norm(velocity, axis=1) > 0.15
        velocity, facing = (v[fast] / np.linalg.norm(v[fast], axis=1, keepdims=True) for v in (velocity, facing))
        ahead += np.sum(velocity * facing, axis=1).tolist()
        beside += (velocity[:, 0] * facing[:, 1] - velocity[:, 1] * facing[:, 0]).tolist()
    assert np.median(bobbing) < 0.12  # the head keeps its height: +y is up
    assert np.mean(ahead) > 0.3  # people walk the way they look, and to no side
    assert abs(np.mean(beside)) < 0.1


@pytest.mark.realdata
def test_the_other_group_agrees_on_the_axes_and_on_milliseconds(realdata: Path) -> None:
    folder = realdata / "traces" / "eyenav_nthu"
    settings = read_scene_settings(folder / "scene_setting.csv")
    files = sorted(folder.glob("user*.csv.gz"))
    assert files
    ahead: list[float] = []
    for file in files:
        path = load_path(file)
        assert 59.5 < path.duration < 60.5  # one minute, if they are milliseconds
        assert 30.0 < len(path) / path.duration < 80.0  # 36 or 72 Hz
        assert 0.05 < np.quantile(path.speed(), 0.5) < 0.5
        assert np.quantile(path.speed(), 0.99) < 1.5  # nobody runs
        assert np.ptp(path.positions[:, [0, 2]], axis=0).max() < 3.5
        mean = path.head_ups.mean(axis=0)
        assert mean[1] / np.linalg.norm(mean) > np.cos(np.radians(20.0))
        strides = path.resample(2.0)
        velocity, facing = np.diff(strides.positions, axis=0)[:, [0, 2]], strides.forwards[:-1, [0, 2]]
        fast = np.linalg.norm(velocity, axis=1) > 0.15
        velocity, facing = (v[fast] / np.linalg.norm(v[fast], axis=1, keepdims=True) for v in (velocity, facing))
        ahead += np.sum(velocity * facing, axis=1).tolist()
        names = ("ViewIndex", *(f"Position{a}" for a in "XYZ"), *(f"Quaternion{a}" for a in "WXYZ"))
        values = read_table(file).numbers(names)
        pairs = np.flatnonzero((values[:-1, 0] == 0) & np.all(values[:-1, 4:] == values[1:, 4:], axis=1))
        left, right = values[pairs], values[pairs + 1]
        rotations = rotations_from_quats(left[:, 4:] / np.linalg.norm(left[:, 4:], axis=1, keepdims=True))
        apart = np.einsum("nji,nj->ni", rotations, right[:, 1:4] - left[:, 1:4])
        apart /= settings[file.name.split("_")[1].split(".")[0]].scale
        assert np.allclose(apart, [0.070, 0.0, 0.0], atol=0.0005)
    assert np.mean(ahead) > 0.3


@pytest.mark.realdata
def test_real_eyes_are_a_pupil_distance_apart_along_x_at_one_instant(realdata: Path) -> None:
    folder = realdata / "traces" / "eyenav_rutgers"
    settings = read_scene_settings(folder / "scene_setting.csv")
    for scene in ("room", "truck"):
        for file in sorted((folder / scene).glob("*.csv.gz"))[::4]:
            names = ("ViewIndex", *(f"Position{a}" for a in "XYZ"), *(f"Quaternion{a}" for a in "WXYZ"))
            values = read_table(file).numbers(names)
            left = values[values[:, 0] == 0]
            right = values[values[:, 0] == 1][: len(left)]
            left = left[: len(right)]
            assert np.array_equal(left[:, 4:], right[:, 4:])  # one orientation, so one pose
            rotations = rotations_from_quats(left[:, 4:] / np.linalg.norm(left[:, 4:], axis=1, keepdims=True))
            apart = np.einsum("nji,nj->ni", rotations, right[:, 1:4] - left[:, 1:4]) / settings[scene].scale
            assert 0.055 < np.median(apart[:, 0]) < 0.072
            assert np.abs(apart[:, 1:]).max() < 0.004
            assert apart[:, 0].std() < 0.001
