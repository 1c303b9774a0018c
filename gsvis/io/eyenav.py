"""Read EyeNavGS recordings: head poses of people walking through 3DGS scenes with a headset (`user101_room.csv`).

A row is one eye of one frame; `scene_setting.csv` has the tilt and the scale of each scene. Paths come out in meters
with +y up, x and z level, the head in OpenCV axes.

Two groups published recordings. The first (Rutgers) ends rows with `Timestamp`, gaze position before gaze rotation; the
second (NTHU) with `timestep`, gaze rotation before gaze position. Each has its own settings: a recording needs the
`scene_setting.csv` of its group.

Times are milliseconds. The first group's notes say so for `Timestamp`. For `timestep` it is inferred: the second
group's script for frame rates divides it by 1000 for seconds, and the data agree: all 289 recordings end at 59,882 to
60,000 (one minute), the median distance of frames is 28 (36 Hz, half of the headset's 72), and the median person walks
at 0.18 m/s with the 99th percentile of speed at 0.2 to 1.3 m/s, as in the first group.

The data set does not state its axes. They follow from the 44 recordings of the room and the truck (tests check this):

- Positions and quaternions (xyzw) are world from head, in a right-handed frame. The right eye lies at +x of the left
  in the head's axes, by 120 to 138 mm in room (scale 2) and 45 to 53 mm in truck (scale 0.76), constant to a
  millimeter within a recording: +x is right, and meters are `position / Scale`, as pupils are 59 to 70 mm apart.
  In the second group it is 70 mm in every recording, by its own scales.
- Turned by the scene's quaternion, the head's +y is up: its mean lies within 20 degrees of world +y in every recording.
- People walk forwards and look ahead: -z of the head agrees with the direction of walking (mean cosine 0.4) and with
  -z of the gaze, where that was recorded (median cosine above 0.9). These are the axes of OpenXR.
- Both eyes of a frame have the same orientation, though their rows have stamps 4 ms apart: the two poses are of one
  instant. Therefore the head is the mean of the pair at the first stamp, without interpolation between the eyes.
- FOV1 to FOV4 are radians: left, right, *down*, up (OpenXR's signs), not top, bottom as the data set's notes say. They
  are those of the headset, the same in all recordings, and are not read.

References:
    Ding et al., "EyeNavGS", arXiv 2506.02380, 2025.
"""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.io._table import Table, join_names, read_table
from gsvis.scene.gaussians import quats_from_rotations, rotations_from_quats
from gsvis.scene.paths import HeadPath

__all__ = ["SceneSetting", "is_eyenav", "path_of_recording", "read_eyenav", "read_scene_settings"]

F64 = NDArray[np.float64]

SETTINGS = "scene_setting.csv"
COLUMNS = (
    "ViewIndex",
    *(f"Position{axis}" for axis in "XYZ"),
    *(f"Quaternion{axis}" for axis in "XYZW"),
)
TIMES = ("Timestamp", "timestep")  # last column of the first and the second group, milliseconds
_UNREAD = (
    *(f"FOV{side}" for side in "1234"),
    *(f"GazePos{axis}" for axis in "XYZ"),
    *(f"GazeQ{axis}" for axis in "XYZW"),
)
_OPENGL = np.diag([1.0, -1.0, -1.0])  # OpenXR axes to OpenCV axes: y and z are reversed
_SAME_TURN = 1.0 - 1e-5  # least |dot| of equal quaternions rounded to three decimals; half a degree
_MOST_DROPPED = 0.1
_LONG_GAP = 1.0  # seconds
_ROUNDING = 0.1  # tolerance on the length of a quaternion

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SceneSetting:
    """Tilt and scale of a scene of the data set.

    Attributes:
        quat: xyzw rotation that levels the scene: raw frame to one with +y up.
        scale: Raw units in a meter.
    """

    quat: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    scale: float = 1.0


def is_eyenav(table: Table) -> bool:
    """Return whether a table has most of the columns that only these recordings have; others may be missing."""
    return 2 * len({*COLUMNS} & set(table.header)) > len(COLUMNS)


def read_eyenav(path: str | os.PathLike[str], setting: SceneSetting | None = None) -> HeadPath:
    """Read one recording.

    Args:
        path: The file, gzipped or not.
        setting: Tilt and scale of its scene. By default the row of `scene_setting.csv`, beside the file or up to
            two folders above, for the scene in the file's name (`user101_room.csv`), or the folder's.

    Returns:
        The head's path in meters, up +y, from time 0. Stamps that do not rise are dropped.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If the file or the settings are malformed or missing, or more than a tenth of the timestamps do
            not rise.
    """
    return path_of_recording(read_table(path), setting)


def read_scene_settings(path: str | os.PathLike[str]) -> dict[str, SceneSetting]:
    """Read `scene_setting.csv`: the setting of each scene by its name.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If it is malformed.
    """
    table = read_table(path)
    name = table.column("Scene_Name")
    quat = table.column("Quaternion")
    scales = table.numbers(("Scale",))[:, 0]
    found: dict[str, SceneSetting] = {}
    for row, cells in enumerate(table.rows):
        try:
            parts = tuple(float(part) for part in cells[quat].split(","))
        except ValueError:
            parts = ()
        if len(parts) != 4 or not abs(math.hypot(*parts) - 1.0) <= _ROUNDING:
            expected = "a unit quaternion x, y, z, w"
            raise FormatError(table.path, table.where(row, "Quaternion"), expected, repr(cells[quat][:60]))
        if scales[row] <= 0:
            raise FormatError(table.path, table.where(row, "Scale"), "a number > 0", f"{scales[row]:g}")
        found[cells[name].strip()] = SceneSetting((parts[0], parts[1], parts[2], parts[3]), float(scales[row]))
    return found


def path_of_recording(table: Table, setting: SceneSetting | None = None) -> HeadPath:
    """Return the head's path of a recording read as a table; see `read_eyenav`."""
    setting = setting or _setting_of(table.path)
    time = _time_column(table)
    values = table.numbers((*COLUMNS, time), known=(*_UNREAD, *TIMES))
    if len(values) == 0:
        raise FormatError(table.path, f"line {table.lines[0] + 1}", "at least one pose", "the end of the file")
    eyes = values[:, 0]
    positions = values[:, 1:4]
    quats = values[:, [7, 4, 5, 6]]
    stamps = values[:, 8]
    _check_cells(table, eyes, quats)
    turns = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    rows, heads = _heads(eyes, positions, turns)
    rows, heads = _rising(table, stamps, rows, heads)
    level = rotations_from_quats(np.roll(_unit(np.array([setting.quat])), 1, axis=1))[0]
    rotations = level @ rotations_from_quats(turns[rows]) @ _OPENGL
    return HeadPath(
        (stamps[rows] - stamps[rows[0]]) / 1000.0,
        heads @ level.T / setting.scale,
        quats_from_rotations(rotations),
        up=np.array([0.0, 1.0, 0.0]),
        meters_per_unit=1.0,
    )


def _time_column(table: Table) -> str:
    """Return the column with the time of each row, whose name differs between the groups.

    Raises:
        FormatError: If there is none; the message names the unknown columns of the header.
    """
    time = next((name for name in TIMES if name in table.header), None)
    if time is None:
        missing = [name for name in COLUMNS if name not in table.header]
        others = [name for name in table.header if name not in COLUMNS and name not in _UNREAD]
        unexpected = f"; unexpected: {join_names(others)}" if others else ""
        got = f"no {', '.join([*missing, ' or '.join(TIMES)])}" + unexpected
        raise FormatError(table.path, f"line {table.lines[0]}", f"columns {', '.join(COLUMNS)}, {TIMES[0]}", got)
    return time


def _check_cells(table: Table, eyes: F64, quats: F64) -> None:
    """Raise at the first eye that is not 0 or 1, or quaternion whose length is not 1."""
    bad = np.flatnonzero((eyes != 0) & (eyes != 1))
    if len(bad):
        where = table.where(int(bad[0]), "ViewIndex")
        raise FormatError(table.path, where, "0 (left eye) or 1 (right eye)", f"{eyes[bad[0]]:g}")
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quats, axis=1)
    bad = np.flatnonzero(np.abs(lengths - 1.0) > _ROUNDING)
    if len(bad):
        where = table.where(int(bad[0]), "QuaternionX to QuaternionW")
        got = f"length {lengths[bad[0]]:.3g}"
        raise FormatError(table.path, where, "a quaternion of length 1", got, "was tracking lost there?")


def _heads(eyes: F64, positions: F64, turns: F64) -> tuple[NDArray[np.int64], F64]:
    """Return one row (H,) for each frame, and the midpoint of the eyes (H, 3) in it.

    An eye without its partner is shifted by half of the median eye distance, along the head's x axis.
    """
    same = np.abs(np.sum(turns[:-1] * turns[1:], axis=1)) >= _SAME_TURN
    left = np.flatnonzero((eyes[:-1] == 0) & (eyes[1:] == 1) & same)  # rows whose partner is the next row
    heads = positions.copy()
    heads[left] = 0.5 * (positions[left] + positions[left + 1])
    right_axes = rotations_from_quats(turns)[:, :, 0]
    apart = np.sum(right_axes[left] * (positions[left + 1] - positions[left]), axis=1)
    half = 0.5 * float(np.median(apart)) if len(left) else 0.0
    alone = np.ones(len(eyes), bool)
    alone[left] = alone[left + 1] = False
    heads[alone] += half * np.where(eyes[alone] == 0, 1.0, -1.0)[:, None] * right_axes[alone]
    keep = alone
    keep[left] = True
    rows = np.flatnonzero(keep)
    return rows, heads[rows]


def _rising(table: Table, stamps: F64, rows: NDArray[np.int64], heads: F64) -> tuple[NDArray[np.int64], F64]:
    """Return the frames whose timestamp is later than all before it."""
    latest = np.maximum.accumulate(stamps[rows])
    keep = np.concatenate([[True], stamps[rows[1:]] > latest[:-1]])
    dropped = int(np.count_nonzero(~keep))
    if dropped > _MOST_DROPPED * len(rows):
        row = int(rows[np.flatnonzero(~keep)[0]])
        got = f"{dropped} of {len(rows)} that do not"
        remedy = "does the file hold several recordings?"
        where = table.where(row, _time_column(table))
        raise FormatError(table.path, where, "times that rise", got, remedy)
    if dropped:
        _log.warning("%s: dropped %d frames whose time does not rise", table.path, dropped)
    longest = float(np.diff(stamps[rows[keep]]).max(initial=0.0)) / 1000.0
    if longest > _LONG_GAP:
        _log.warning("%s: a gap of %.1f s is bridged by a straight line", table.path, longest)
    return rows[keep], heads[keep]


def _setting_of(path: Path) -> SceneSetting:
    """Return the setting of the scene named by a recording's file or folder."""
    folder = path.resolve().parent
    files = [place / SETTINGS for place in (folder, folder.parent, folder.parent.parent)]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        got = "none beside the file or in the two folders above"
        raise FormatError(path, "", f"a {SETTINGS} with the scale of the scene", got, "pass setting=SceneSetting(...)")
    settings = read_scene_settings(file)
    names = [path.name.split(".")[0].partition("_")[2], folder.name]
    for name in names:
        if name in settings:
            return settings[name]
    known = join_names(sorted(settings))
    got = " or ".join(map(repr, dict.fromkeys(names)))
    raise FormatError(path, "", f"the name of a scene of {SETTINGS} ({known})", got, "pass setting=SceneSetting(...)")


def _unit(quats: F64) -> F64:
    """Return quaternions of length 1."""
    return np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True))
