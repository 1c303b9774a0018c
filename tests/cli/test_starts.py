"""Views to begin with in a scene that nobody has prepared."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import asking
from gsvis.cli.asking import settle_visit
from gsvis.cli.options import Placed, Shown, Where
from gsvis.cli.terminal import Status
from gsvis.cli.where import find_place
from gsvis.export.start import find_starts, plan_visit
from gsvis.io.sources import load_source
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, rotations_from_quats
from gsvis.scene.place import Place
from gsvis.scene.procedural import two_rooms
from gsvis.scene.source import Source
from tests.known_spaces import remember_spaces
from tests.scene.places import apartment

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module", autouse=True)
def known_spaces() -> Iterator[None]:
    """Find spaces as they are found for a visitor: in coarse ones a ball has no outside."""
    with remember_spaces():
        yield


def test_a_visit_of_rooms_begins_within_them_upright(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.scene.source.SOME", 20_000)  # half of its Gaussians
    source = load_source("builtin:two_rooms", None)
    found = find_starts(source, UP)
    assert found is not None
    space, _ = source.thin().navigable()
    assert space is not None
    known = two_rooms().navigable
    for start in found:
        assert start.mode == "fly"
        assert space.contains([start.position]).all()
        assert known.contains([start.position]).all()
        across = rotations_from_quats(np.array([start.rotation]))[0][:, 0]
        assert abs(across @ UP) < 1e-3


def test_a_visit_of_a_thing_begins_outside_of_it() -> None:
    rng = np.random.default_rng(0)
    out = rng.standard_normal((3000, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    quats = np.tile([1.0, 0, 0, 0], (3000, 1))
    ball = Gaussians(out, quats, np.full((3000, 3), 0.05), np.full(3000, 0.95), np.zeros((3000, 1, 3)))
    found = find_starts(Source("ball", ball), UP)
    assert found is not None
    for start in found:
        assert start.mode == "orbit"
        away = np.linalg.norm(start.position)
        assert away > 1.0
        ahead = rotations_from_quats(np.array([start.rotation]))[0][:, 2]
        assert ahead @ -np.array(start.position) > 0.0


def test_a_scene_without_room_for_an_eye_has_no_such_view() -> None:
    source = load_source("builtin:two_rooms", None)
    assert find_starts(replace(source, gaussians=source.gaussians[:0]), UP) is None


def test_a_part_of_a_scene_covers_as_much(monkeypatch: pytest.MonkeyPatch) -> None:
    source = load_source("builtin:two_rooms", None)
    monkeypatch.setattr("gsvis.scene.source.SOME", 10_000)
    some = source.thin()
    assert len(some.gaussians) == 10_000
    scales = [each.gaussians.scales for each in (source, some)]
    area = [float(np.sort(each, axis=1)[:, 1:].prod(axis=1).sum()) for each in scales]
    assert area[1] == pytest.approx(area[0], rel=0.05)


@pytest.fixture(scope="module")
def cloud() -> Source:
    """A cloud of which nobody can say what it is."""
    spread = np.random.default_rng(0).standard_normal((1000, 3))
    quats = np.tile([1.0, 0, 0, 0], (1000, 1))
    return Source(
        "cloud", Gaussians(spread, quats, np.full((1000, 3), 0.05), np.full(1000, 0.9), np.zeros((1000, 1, 3)))
    )


def test_a_visit_says_what_is_not_sure_and_begins_where_either_reading_has_eyes(cloud: Source) -> None:
    visit = plan_visit(cloud)
    assert visit.starts
    (line,) = [each for each in visit.remarks if "Not sure: " in each]
    assert line == find_place(cloud, Where()).doubt.replace(find_place(cloud, Where()).decided_by, Place.decided_by)
    known = plan_visit(load_source("builtin:two_rooms", None))
    assert not any("Not sure" in each for each in known.remarks)


def test_a_visit_in_doubt_asks_as_every_command_does(
    cloud: Source, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(asking, "_may_ask", lambda where: where.kind is None)
    monkeypatch.setattr(asking, "write_picture", lambda path, source, place: Path(path).write_bytes(b"png"))
    monkeypatch.setattr("sys.stdin", io.StringIO("1\n"))
    with Status() as status:
        answered, visit = settle_visit(Shown(), cloud, None, status, quiet=False)
    said = capsys.readouterr().err
    assert "Not sure: " in said
    assert "where.png" in said
    assert answered.kind is not None
    assert visit.starts
    assert not any("Not sure" in each for each in visit.remarks)


def test_a_visit_in_doubt_shows_where_people_stand(cloud: Source, tmp_path: Path) -> None:
    with Status() as status:
        _, unasked = settle_visit(Shown(), cloud, None, status, quiet=True)
        _, visit = settle_visit(Shown(show=str(tmp_path / "a.png")), cloud, None, status, quiet=True)
    assert unasked.remarks[-1] == " --show FILE.png shows the first view and a plan with eyes."
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert str(tmp_path / "a.png") in visit.remarks[-1]


def test_a_visit_begins_in_the_box_of_the_user() -> None:
    source = load_source("builtin:two_rooms", None)
    box = (0.5, 0.5, 1.0, 1.5, 1.5, 2.0)
    with Status() as status:
        _, visit = settle_visit(Shown(box=box), source, None, status, quiet=True)
    assert visit.starts
    for each in visit.starts:
        assert np.all(each.position >= np.array(box[:3])) & np.all(each.position <= np.array(box[3:]))


def test_cameras_say_where_a_visit_begins_and_which_way_is_up(tmp_path: Path) -> None:
    g = apartment()
    turned = g.transform(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))  # +y is up
    eyes = np.array([[1.0 + 0.2 * k, 1.5, -1.5] for k in range(6)])
    targets = eyes + [[np.cos(k), 0.0, np.sin(k)] for k in range(6)]
    cameras = Cameras.look_at(eyes, targets, up=(0, 1, 0), width=64, height=48, fov=60.0)
    poses = np.linalg.inv(cameras.viewmats) * [1.0, -1.0, -1.0, 1.0]  # OpenGL axes
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose.tolist()} for k, pose in enumerate(poses)]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({"fl_x": 55.4, "w": 64, "h": 48, "frames": frames}))
    seen = Placed(cameras=str(file))
    visit = plan_visit(Source("rooms", turned), find_place(Source("rooms", turned), seen))
    assert np.allclose(visit.up, [0, 1, 0], atol=1e-3)
    assert visit.starts
    given = plan_visit(Source("rooms", turned), find_place(Source("rooms", turned), replace(seen, up="-z")))
    assert given.up.tolist() == [0, 0, -1]
