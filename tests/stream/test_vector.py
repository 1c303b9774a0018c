"""A recorded exchange: what other implementations can check themselves against, and what this one must go on saying.

`python tests/stream/test_vector.py --write` records it anew, after a change of the protocol and of its version.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.planner import Batch
from gsvis.color.evaluate import evaluate
from gsvis.stream import Ack, Bye, Hello, PoseAt, Receiver, Session, StreamedScene, parse_client
from gsvis.stream.header import SceneHeader

PATH = Path(__file__).with_name("vector.json")
EYE = [0.25, -1.5, 0.5]


def package_of(folder: Path) -> Any:
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from tests.stream.worlds import package_of

    return package_of(folder, 300, "hsl", seed=4, lattice=True)


def drawn(receiver: Receiver) -> dict[str, Any]:
    """What a client shows at the end, by rising ids."""
    order = np.argsort(receiver.shown())
    gaussians, colors = receiver.scene()
    rgb = evaluate(colors, gaussians.means, EYE)
    arrays = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities")} | {"rgb": rgb}
    return {"ids": receiver.shown()[order].tolist()} | {
        name: array[order].astype(np.float64).round(7).tolist() for name, array in arrays.items()
    }


def recorded() -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder, package_of(Path(folder) / "s.gsvis") as package:
        scene = StreamedScene.open(package)
        view = FieldOfView(1.0, 1.0, 0.75, 0.75, 0.125, 0.0625)
        config = AbrConfig(policy="low-first", start_rate=100.0)
        session, receiver = Session(scene, view, config), Receiver(scene.header)
        steps: list[dict[str, Any]] = []

        def said(side: str, data: bytes, **facts: Any) -> None:
            steps.append({"from": side, **facts, "bytes": data.hex()})

        said("client", Hello(view).to_bytes())
        said("server", session.welcome(0.0).data)
        said("client", Ack(0).to_bytes())
        for k in range(3):
            pose = PoseAt(100 * k, (1.5 * k - 1.5, -1.0, 0.25), (1.0, 0.0, 0.25 * k, 0.0))
            said("client", pose.to_bytes())
            session.on_pose(k / 10, pose.position, pose.quat)
            message = session.next_message(k / 10, (1100.0, 1300.0, 4000.0)[k])
            assert message is not None
            received = receiver.receive(message.data)
            lists = {name: getattr(received, name).tolist() for name in ("gaussians", "terms", "dropped")}
            held = session.holdings
            said("server", message.data, **lists, gone=sorted({int(g) for g in np.flatnonzero(bits(held.gone))}))
            said("client", Ack(received.sequence).to_bytes())
            if k == 1:  # the connection breaks
                hello = receiver.hello(view)
                session = Session.from_hello(scene, hello)  # and the link is a better one
                said("client", hello.to_bytes())
                said("server", session.welcome(0.2).data)
                receiver.resume(scene.header)
        said("client", Bye().to_bytes())
        return {"protocol": 3, "eye": EYE, "steps": steps, "drawn": drawn(receiver)}


def bits(words: np.ndarray) -> np.ndarray:
    return np.unpackbits(words.view(np.uint8), bitorder="little")


@pytest.fixture(scope="module")
def vector() -> dict[str, Any]:
    return json.loads(PATH.read_text(encoding="utf-8"))


def test_a_client_of_the_record_draws_what_it_says(vector: dict[str, Any]) -> None:
    receiver = None
    for step in vector["steps"]:
        data = bytes.fromhex(step["bytes"])
        if step["from"] == "client":
            assert parse_client(data).to_bytes() == data
        elif "gaussians" not in step:
            if receiver is None:
                receiver = Receiver(data)
            assert receiver.resume(data)
        else:
            assert receiver is not None
            received = receiver.receive(data)
            assert received.gaussians.tolist() == step["gaussians"]
            assert received.terms.tolist() == step["terms"]
            assert received.dropped.tolist() == step["dropped"]
            assert np.flatnonzero(bits(receiver.holdings.gone)).tolist() == step["gone"]
    assert receiver is not None
    found = drawn(receiver)
    for name, values in vector["drawn"].items():
        np.testing.assert_allclose(found[name], values, atol=1e-6, err_msg=name)


def test_a_server_of_the_record_says_the_same_bytes(vector: dict[str, Any], tmp_path: Path) -> None:
    """Whatever order a planner finds, what is chosen becomes the same bytes."""
    with package_of(tmp_path / "s.gsvis") as package:
        scene, session = StreamedScene.open(package), None
        # The identity is of the files of the package, whose bytes are not the same with every version of pyarrow.
        welcome = next(bytes.fromhex(step["bytes"]) for step in vector["steps"] if step["from"] == "server")
        scene.about = replace(scene.about, identity=SceneHeader.parse(welcome).identity)
        scene.header = scene.about.to_message()
        chosen: list[dict[str, Any]] = []

        def next_batch(t: float, budget: float, rate: float, *, spare: float) -> Batch:
            assert session is not None
            step = chosen.pop()
            ids = [np.array(step[name], np.int64) for name in ("gaussians", "terms", "gone")]
            before = session.holdings.gone.copy()
            session.holdings.add(*ids)
            fresh = np.flatnonzero(bits(session.holdings.gone & ~before)).astype(np.int32)
            return Batch(ids[0][::-1].astype(np.int32), ids[1][::-1].astype(np.uint32), fresh, 1000.0)

        for step in vector["steps"]:
            data = bytes.fromhex(step["bytes"])
            if step["from"] == "client":
                said = parse_client(data)
                if isinstance(said, Hello):
                    session = Session.from_hello(scene, said)
                    session.planner.next_batch = next_batch
            elif "gaussians" not in step:
                assert SceneHeader.parse(data) == SceneHeader.parse(scene.header)
            else:
                assert session is not None
                chosen.append(step)
                message = session.next_message(0.0, 2000.0)
                assert message is not None
                assert message.data == data


def test_the_page_shows_the_bytes_around_the_rows(vector: dict[str, Any]) -> None:
    page = (Path(__file__).parents[2] / "docs" / "streaming.md").read_text(encoding="utf-8")
    (data, *_) = (bytes.fromhex(step["bytes"]) for step in vector["steps"] if "gaussians" in step)
    text = page.split("```")[1].split("\n160  ")[0]
    for name, place in (("body", 48), ("rows", 136)):
        text = text.replace(f"[{name}, i64]", data[place : place + 8].hex())
    lines = [line.partition(" ")[2].replace(" ", "") for line in text.strip().splitlines()]
    assert "".join(lines) == data[8:168].hex()


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        raise SystemExit("python tests/stream/test_vector.py --write")
    PATH.write_text(json.dumps(recorded(), indent=1) + "\n", encoding="utf-8")
