"""In doubt a picture is written and, on a terminal, a question asked; elsewhere eyes are where any reading has them."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import asking, main
from gsvis.cli.asking import Settled, settle
from gsvis.cli.options import Placed, Shown
from gsvis.cli.targets import check_show
from gsvis.cli.terminal import Status
from gsvis.cli.where import find_place
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.place import Evidence, Place
from gsvis.scene.readings import Choice, find_choices
from gsvis.scene.source import Source
from gsvis.scene.upright import Upright

Capture = pytest.CaptureFixture[str]
UP, OTHER = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])
TINY = Source("tiny", Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], np.zeros((1, 1, 3))))


def place_of(kind_sure: bool, up_sure: bool) -> Place:
    """A place with the doubts that a test needs."""
    confidence = 0.95 if kind_sure else 0.6
    kind = SpaceKind("rooms", "it looks so", None, "inside", confidence, None if kind_sure else "object")
    space = NavigableSpace(np.zeros(3), 1.0, np.ones((2, 2, 2), bool), UP, kind=kind)
    upright = Upright(UP, 0.9 if up_sure else 0.5, "it looks so", other=OTHER)
    return Place(space, "", [], upright=upright, evidence=Evidence("scene", confidence, "rooms: it looks so"))


def found(command: Shown) -> Place:
    """Nothing is sure but what an option says."""
    return place_of(command.kind not in (None, "auto"), command.up is not None)


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Settled[Shown]]:
    """Return a function that settles a doubtful place with what a user types."""
    monkeypatch.setattr(asking, "_may_ask", lambda where: where.kind is None)
    monkeypatch.setattr(asking, "write_picture", lambda path, source, place: Path(path).write_bytes(b"png"))

    def typed(text: str, command: Shown | None = None) -> Settled[Shown]:
        monkeypatch.setattr("sys.stdin", io.StringIO(text))
        with Status() as status:
            return settle(command or Shown(), TINY, found, status)

    return typed


class TestChoices:
    def test_there_is_one_without_doubt(self) -> None:
        (choice,) = find_choices(place_of(True, True))
        assert str(choice) == "rooms, up +z"

    def test_they_differ_in_what_is_doubtful(self) -> None:
        assert [str(each) for each in find_choices(place_of(False, True))] == ["rooms, up +z", "an object, up +z"]
        assert [str(each) for each in find_choices(place_of(True, False))] == ["rooms, up +z", "rooms, up -y"]
        both = find_choices(place_of(False, False))
        assert [(each.kind, each.up.tolist()) for each in both] == [
            ("rooms", UP.tolist()),
            ("object", UP.tolist()),
            ("rooms", OTHER.tolist()),
        ]

    def test_an_oblique_axis_is_a_vector(self) -> None:
        assert str(Choice("open place", np.array([0.0, -0.6, 0.8]))) == "an open place, up (0.00, -0.60, 0.80)"


class TestQuestion:
    def test_a_number_chooses_a_reading(self, answers: Callable[..., Settled[Shown]], capsys: Capture) -> None:
        settled = answers("2\n")
        assert (settled.where.kind, settled.where.up) == ("object", "0 0 1")
        assert settled.place.doubt == ""
        assert settled.picture is None
        err = capsys.readouterr().err
        assert "Not sure: the scene was taken for rooms with a confidence of 60%" in err
        assert "where.png" in err
        assert "  2      an object, up +z" in err
        assert "taken as you say; --kind object --up '0 0 1' says so without a question" in err

    @pytest.mark.parametrize("text", ["\n", "", "what\nis\nthis\n"])
    def test_everything_else_is_the_safe_reading(self, text: str, answers: Callable[..., Settled[Shown]]) -> None:
        settled = answers(text)
        assert settled.where == Shown()
        assert settled.place.doubt != ""

    def test_an_axis_is_up_and_the_kind_is_asked_next(self, answers: Callable[..., Settled[Shown]]) -> None:
        settled = answers("0.1 -0.98 0.17\n1\n")
        assert (settled.where.kind, settled.where.up) == ("rooms", "0.1 -0.98 0.17")
        assert answers("-y\n\n").where == Shown(up="-y")

    def test_a_picture_of_an_unsettled_place_goes_where_it_is_wanted(
        self, answers: Callable[..., Settled[Shown]], tmp_path: Path
    ) -> None:
        shown = tmp_path / "eyes.png"
        settled = answers("\n", Shown(show=str(shown)))
        assert settled.picture == shown
        assert shown.read_bytes() == b"png"
        assert str(shown) in settled.remarks[-1]
        assert settled.written == " Nothing else was written."
        with Status() as status:
            beside = settle(Shown(), TINY, found, status, quiet=True, beside=str(tmp_path / "p.gsvis"))
            sure = settle(Shown(kind="rooms", up="+z"), TINY, found, status, beside=str(tmp_path / "q.gsvis"))
        assert beside.picture == tmp_path / "p.gsvis.where.png"
        assert (sure.picture, sure.remarks, sure.written) == (None, [], " Nothing was written.")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["eyes.png", "p.gsvis.where.png"]

    def test_a_pipe_and_ci_are_not_asked(self, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
        for stdin in (io.StringIO("1\n"), None):
            monkeypatch.setattr("sys.stdin", stdin)
            with Status() as status:
                assert settle(Shown(), TINY, found, status).where == Shown()
        assert "Which" not in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix", reason="terminals of POSIX")
class TestTerminal:
    @pytest.mark.parametrize(
        ("typed", "code", "said"),
        [(b"2\n", 0, "asked: object"), (b"\x04", 0, "asked: None"), (b"\x03", 130, "interrupted")],
    )
    def test_a_person_at_a_terminal_is_asked(self, typed: bytes, code: int, said: str, tmp_path: Path) -> None:
        import pty

        program = (
            "import sys, gsvis.cli\n"
            "from pathlib import Path\n"
            "from gsvis.cli import asking\n"
            "from gsvis.cli.terminal import Status\n"
            "from tests.cli.test_asking import TINY, Shown, found\n"
            "asking.write_picture = lambda path, source, place: Path(path).write_bytes(b'png')\n"
            "def run(command):\n"
            "    with Status() as status:\n"
            "        settled = asking.settle(Shown(), TINY, found, status)\n"
            "    print('asked:', settled.where.kind)\n"
            "gsvis.cli._run = run\n"
            "sys.exit(gsvis.cli.main(['inspect', 'builtin:two_rooms']))\n"
        )
        leader, follower = pty.openpty()

        def take_terminal() -> None:
            import fcntl
            import termios

            fcntl.ioctl(follower, termios.TIOCSCTTY, 0)
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # who runs the tests in the background ignores it

        process = subprocess.Popen(
            [sys.executable, "-c", program], stdin=follower, stdout=subprocess.PIPE, stderr=follower,
            cwd=Path(__file__).parents[2], start_new_session=True, preexec_fn=take_terminal, text=True,
        )  # fmt: skip
        os.close(follower)
        seen = b""
        while b"Which is right" not in seen:
            try:
                seen += os.read(leader, 4096)
            except OSError:  # it has ended without a question
                raise AssertionError(seen.decode()) from None
        os.write(leader, typed)
        out, _ = process.communicate(timeout=300)
        rest = b""
        try:
            while more := os.read(leader, 4096):
                rest += more
        except OSError:  # the other end has closed
            pass
        os.close(leader)
        assert process.returncode == code, (seen, rest)
        assert said in out + rest.decode()


class TestShow:
    def test_the_name_is_checked_before_work_begins(self, tmp_path: Path) -> None:
        other = tmp_path / "photo.png"
        other.write_bytes(b"not of gsvis")
        for name in ("picture.jpg", str(tmp_path), str(other)):
            with pytest.raises(ValueError, match=r"^--show: expected"):
                check_show(name)
        assert other.read_bytes() == b"not of gsvis"

    def test_a_kind_contradicts_a_place_given_by_hand(self, tmp_path: Path, capsys: Capture) -> None:
        words = ["pvs", "builtin:two_rooms", "-o", str(tmp_path / "x.pvs"), "--kind", "rooms", "--around", "auto"]
        assert main(words) == 2
        assert "--kind: expected none with --around, which says where eyes are" in capsys.readouterr().err


def test_a_kind_that_is_stated_leaves_no_doubt_about_it() -> None:
    from tests.scene.places import statue

    for kind in ("object", "open-place"):
        place = find_place(Source("statue", statue()), Placed(kind=kind, up="+z"))
        assert place.evidence is not None
        assert (place.evidence.source, place.doubt) == ("kind", "")
        assert place.space is not None
        assert place.space.kind.kind == kind.replace("-", " ")
