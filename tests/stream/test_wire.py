"""Messages: what is written is read, and whatever else comes is refused in one line, by both ends."""

from __future__ import annotations

import copy
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.abr.classes import FieldOfView
from gsvis.abr.holdings import Holdings
from gsvis.errors import ProtocolError
from gsvis.stream import Ack, Bye, Hello, PoseAt, Receiver, Session, StreamedScene, Token, parse_client
from gsvis.stream.header import SceneHeader
from gsvis.stream.wire import FAULTS, MOST_HELLO, ServerFault
from tests.stream.worlds import package_of

VIEW = FieldOfView.from_degrees(80, 60, margin=8)
NUMBER = st.floats(-1e6, 1e6, width=32)


def said() -> list[Hello | PoseAt | Ack | Bye | Token]:
    """One of each."""
    rng = np.random.default_rng(0)
    held = Holdings(5000, 9000)
    held.add(rng.permutation(5000)[:1700], rng.permutation(9000)[:500], np.array([1, 7]))
    pose = PoseAt(123456, (1.5, -2.25, 0.125), (0.5, 0.5, -0.5, 0.5))
    return [Hello(VIEW), Hello(VIEW, bytes(range(32)), held.to_bytes()), pose, Ack(77), Bye(), Token("s3cret word")]


def mutated(rng: np.random.Generator, data: bytes) -> bytes:
    """Cut, lengthened, with some bytes or bits changed, or other bytes altogether."""
    made = bytearray(data)
    kind = int(rng.integers(6))
    if kind == 0:
        return bytes(made[: int(rng.integers(len(made) + 1))])
    if kind == 1:
        return bytes(made) + rng.bytes(int(rng.integers(1, 40)))
    if kind == 2:
        return bytes([int(rng.choice([0, 1, 2, 3, 4, 5, 129, 130, 131, 255]))]) + rng.bytes(int(rng.integers(0, 120)))
    for _ in range(int(rng.integers(1, 6))):
        place = int(rng.integers(len(made)))
        if kind == 3:
            made[place] = int(rng.integers(256))
        elif kind == 4:
            made[place] ^= 1 << int(rng.integers(8))
        else:
            word = rng.choice([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FC00000, 0x7F800000])
            made[place : place + 4] = struct.pack("<I", int(word))
    return bytes(made)


def test_ten_thousand_messages_are_read_or_refused() -> None:
    rng, valid = np.random.default_rng(7), [message.to_bytes() for message in said()]
    read = refused = 0
    for k in range(10_000):
        data = mutated(rng, valid[k % len(valid)])
        try:
            found = parse_client(data, most_hello=20_000)
        except ProtocolError as error:
            assert error.code in FAULTS.values()
            assert "expected" in str(error)
            assert "\n" not in str(error)
            refused += 1
            continue
        read += 1
        assert found.to_bytes()[:1] == data[:1]
        if isinstance(found, PoseAt):
            assert np.isfinite([*found.position, *found.quat]).all()
            assert np.linalg.norm(found.quat) > 0
        if isinstance(found, Hello):
            found.view.planes((0, 0, 0), (1, 0, 0, 0))
    assert min(read, refused) > 500


@given(st.binary(max_size=200))
def test_bytes_of_any_kind_are_read_or_refused(data: bytes) -> None:
    try:
        assert parse_client(data).to_bytes() == data
    except ProtocolError as error:
        assert error.code in FAULTS.values()


@given(st.integers(0, 2**32 - 1), st.tuples(NUMBER, NUMBER, NUMBER), NUMBER)
def test_poses_are_read_as_they_were_written(time: int, position, turn: float) -> None:
    pose = PoseAt(time, position, (0.5, 0.0, -0.25, float(np.float32(turn / 16))))  # a float32, also next to 0
    assert parse_client(pose.to_bytes()) == pose
    assert len(pose.to_bytes()) == 36


def test_what_is_written_is_read() -> None:
    for message in said():
        data = message.to_bytes()
        assert parse_client(data).to_bytes() == data
    fault = ServerFault(FAULTS["flood"], "slow down: ä")
    assert ServerFault.parse(fault.to_bytes()) == fault
    assert len(ServerFault(1, 5000 * "ä").to_bytes()) <= 1004
    assert ServerFault.from_error(ProtocolError("x", 3)) == ServerFault(3, "x")
    assert "secret" not in ServerFault.from_error(OSError("secret")).line


@pytest.mark.parametrize(
    ("data", "code", "message"),
    [
        (b"", "malformed", "got nothing"),
        (b"\x09abc", "malformed", "got 9"),
        (bytes([1, 4]) + bytes(80), "version", "expected version 3, got version 4"),
        (b"\x01", "version", "expected version 3, got none"),
        (bytes([1, 1]) + bytes(MOST_HELLO), "too-large", "at most"),
        (Hello(VIEW).to_bytes() + b"x", "malformed", "bytes"),
        (PoseAt(0, (0, 0, float("nan")), (1, 0, 0, 0)).to_bytes(), "malformed", "finite"),
        (PoseAt(0, (0, 0, 0), (0, 0, 0, 0)).to_bytes(), "malformed", "rotation"),
        (b"\x03\x00\x01\x00abcd", "malformed", "zeros"),
        (b"\x05\x00\x00\x00", "malformed", "5 to 1,004 bytes"),
        (b"\x05\x00\x02\x00a", "malformed", "its length"),
        (b"\x05\x01\x01\x00a", "malformed", "its length"),
        (b"\x05\x00\x01\x00\n", "malformed", "printable"),
        (b"\x05\x00" + (1001).to_bytes(2, "little") + bytes(1001), "malformed", "1,004 bytes"),
    ],
)
def test_what_is_refused_says_why(data: bytes, code: str, message: str) -> None:
    with pytest.raises(ProtocolError, match=message) as caught:
        parse_client(data)
    assert caught.value.code == FAULTS[code]


@pytest.mark.parametrize("text", ["", "a" * 1001, "ü", "a\n"])
def test_a_token_is_short_and_printable(text: str) -> None:
    with pytest.raises(ValueError, match="printable"):
        Token(text).to_bytes()


def test_a_field_of_view_without_an_inside_is_refused() -> None:
    data = bytearray(Hello(VIEW).to_bytes())
    struct.pack_into("<2f", data, 8, -1.0, -1.0)
    with pytest.raises(ProtocolError, match=r"left \+ right > 0"):
        parse_client(bytes(data))


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
def test_a_client_takes_a_batch_whole_or_not_at_all(tmp_path: Path, variant: str) -> None:
    with package_of(tmp_path / "s.gsvis", variant=variant) as package:
        scene = StreamedScene.open(package)
        session, receiver = Session(scene, VIEW), Receiver(scene.header)
        session.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
        first, second = session.next_message(0.0, 3000.0), session.next_message(0.0, 6000.0)
        assert first is not None
        assert second is not None
        receiver.receive(first.data)
        before = receiver.holdings.to_bytes(), receiver.shown().tolist()
        rng = np.random.default_rng(3)
        refused = 0
        for _ in range(600):
            data, other = mutated(rng, second.data), receiver
            if rng.random() < 0.3:  # where the ids are, and the ends of rows
                made = bytearray(second.data)
                made[int(rng.integers(160, 260))] ^= 1 << int(rng.integers(8))
                data = bytes(made)
            if data[:8] == second.data[:8]:
                other = copy.deepcopy(receiver)
            try:
                received = other.receive(data)
            except ProtocolError as error:
                refused += 1
                assert (other.holdings.to_bytes(), other.shown().tolist()) == before, str(error)
                continue
            gaussians, colors = other.scene()  # records may differ, but can be drawn
            assert len(gaussians) == len(colors) == len(other.shown()) == len(other.holdings.shown)
            assert np.isfinite(gaussians.means).all()
            assert len(received.gaussians)
        assert refused > 150
        receiver.receive(second.data)
        for again in (second.data, first.data):
            with pytest.raises(ProtocolError, match="expected number 3"):
                receiver.receive(again)


def test_a_welcome_is_read_or_refused(tmp_path: Path) -> None:
    with package_of(tmp_path / "s.gsvis", stores=False) as package:
        scene = StreamedScene.open(package)
        assert SceneHeader.parse(scene.header) == scene.about
        rng = np.random.default_rng(11)
        for _ in range(1500):
            data = mutated(rng, scene.header)
            try:
                SceneHeader.parse(data)
            except ProtocolError as error:
                assert "\n" not in str(error)
        newer = bytes([scene.header[0], 9]) + scene.header[2:]
        with pytest.raises(ProtocolError, match="version 3, got 9") as caught:
            Receiver(newer)
        assert caught.value.code == FAULTS["version"]
