"""Static scenes: files in ranges, nothing that `scene.json` does not name, and no stream."""

from __future__ import annotations

import json
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from gsvis.errors import FormatError
from gsvis.serve import Address, Scenes, Server, open_scenes
from gsvis.serve.scenes import open_scene, promise_scene
from gsvis.serve.sites import Site
from gsvis.stream.wire import ServerFault
from tests.serve.servers import ask, close_code, has_all, heard, patient, raw, serving

RECORDS = bytes(range(256)) * 4096


@pytest.fixture
def site(tmp_path: Path) -> Path:
    folder = tmp_path / "room"
    folder.mkdir()
    names = ["records.bin", "linked.bin", "../secret.bin", "absent.bin"]
    files = {str(k): {"name": name, "bytes": len(RECORDS)} for k, name in enumerate(names)}
    files["part"] = {"name": "part-0123456789abcdef", "bytes": 2, "count": 2}
    (folder / "part-0123456789abcdef-1.bin").write_bytes(b"22")
    (folder / "part-0123456789abcdef-2.bin").write_bytes(b"beyond")
    about = {"format": "gsvis-static", "version": 1, "gaussians": 65536, "files": files}
    (folder / "scene.json").write_text(json.dumps(about))
    (folder / "records.bin").write_bytes(RECORDS)
    (folder / "unnamed.bin").write_bytes(b"x")
    (tmp_path / "secret.bin").write_bytes(b"secret")
    (folder / "linked.bin").symlink_to(tmp_path / "secret.bin")
    return folder


def test_files_are_served_in_ranges(site: Path, plain: Path) -> None:
    with serving(site, plain) as server:
        rows = json.loads(ask(server, "/")[2])["scenes"]
        assert [(row["name"], row["gaussians"], row["static"] is None) for row in rows] == [
            ("room", 65536, False),
            ("plain", 6000, True),
        ]
        assert json.loads(ask(server, "/" + rows[0]["static"])[2])["format"] == "gsvis-static"
        status, fields, body = ask(server, "/scenes/room/records.bin")
        assert (status, body, int(fields["content-length"])) == (200, RECORDS, len(RECORDS))
        assert ask(server, "/scenes/room/records.bin", If_None_Match=fields["etag"])[0] == 304
        assert ask(server, "/scenes/room/records.bin", If_None_Match="W/" + fields["etag"])[0] == 304
        end = len(RECORDS)
        for asked, start, stop in (("bytes=5-9", 5, 10), ("bytes=-7", end - 7, end), ("bytes=300000-", 300_000, end)):
            status, found, body = ask(server, "/scenes/room/records.bin", Range=asked, If_Range=fields["etag"])
            assert (status, body) == (206, RECORDS[start:stop])
            assert found["content-range"] == f"bytes {start}-{stop - 1}/{len(RECORDS)}"
        assert ask(server, "/scenes/room/records.bin", Range="bytes=99999999-")[0] == 416
        assert ask(server, "/scenes/room/records.bin", Range="bytes=0-1", If_Range='"other"')[2] == RECORDS
        status, found, body = ask(server, "/scenes/room/records.bin", "HEAD")
        assert (status, body, int(found["content-length"])) == (200, b"", len(RECORDS))
        assert ask(server, "/packages/room/manifest.json")[0] == 404
        assert ask(server, "/scenes/room/why/3")[0] == 404
        assert json.loads(ask(server, "/healthz")[2]) == {"status": "ok", "scenes": 2, "refused": 0}


def test_only_named_files_are_served(site: Path) -> None:
    with serving(site) as server:
        status, fields, body = ask(server, "/scenes/room/part-0123456789abcdef-1.bin")
        assert (status, body) == (200, b"22")
        assert "immutable" in fields["cache-control"]
        assert ask(server, "/scenes/room/part-0123456789abcdef-2.bin")[0] == 404
        for name in ("unnamed.bin", "absent.bin", "..%2fsecret.bin", "../secret.bin", "%2e%2e%2fsecret.bin"):
            assert ask(server, f"/scenes/room/{name}")[0] == 404
        status, _, body = ask(server, "/scenes/room/linked.bin")
        assert (status, b"secret" in body) == (500, False)


def test_a_static_scene_is_not_streamed(site: Path) -> None:
    with serving(site) as server, raw(server, b"") as ws:
        assert ServerFault.parse(heard(ws)) == ServerFault(4, "not streamed; read scenes/room/scene.json")
        assert close_code(ws) == 1008


def test_a_scene_gives_way_to_its_package(site: Path, plain: Path) -> None:
    with open_scenes([site]) as scenes:
        server = Server(scenes, None, Address(port=0))
        with server.running() as url:
            assert ask(server, "/scenes/room/scene.json")[0] == 200
            scenes["room"].preparing = True
            (row,) = json.loads(ask(server, "/")[2])["scenes"]
            assert (row["static"], row["preparing"]) == ("scenes/room/scene.json", True)
            scenes.replace(open_scene(plain, "room"))
            (row,) = json.loads(ask(server, "/")[2])["scenes"]
            assert (row["name"], row["stream"], row["static"]) == ("room", "stream/room", None)
            assert not row["preparing"]
            client, _ = patient(url + "/room", plain)
            assert has_all(client.receiver, plain)


@pytest.mark.parametrize("text", ["{", "[]", '{"format": "other"}', "[" * 100_000])
def test_what_is_no_static_scene_is_refused(site: Path, text: str) -> None:
    (site / "scene.json").write_text(text)
    with pytest.raises(FormatError):
        Site(site)
    with pytest.raises(FormatError):
        open_scenes([site])


def test_a_file_of_walking_that_comes_later_is_waited_for(site: Path) -> None:
    about = json.loads((site / "scene.json").read_text())
    about["files"]["walk"] = {"name": "walk-0123456789abcdef.bin", "bytes": 0, "count": 1}
    (site / "scene.json").write_text(json.dumps(about))
    with serving(site) as server, ThreadPoolExecutor(1) as pool:
        asked = pool.submit(ask, server, "/scenes/room/walk-0123456789abcdef.bin")
        assert ask(server, "/scenes/room/absent.bin")[0] == 404  # others are answered meanwhile
        assert not asked.done()
        (site / "part").write_bytes(b"walk")
        (site / "part").rename(site / "walk-0123456789abcdef.bin")
        status, _, body = asked.result()
        assert (status, body) == (200, b"walk")


def test_a_scene_that_is_still_written_is_waited_for(site: Path) -> None:
    scene = promise_scene(site, "room", 7)
    assert scene.site is not None
    with Scenes([scene]) as scenes, ThreadPoolExecutor(1) as pool:
        server = Server(scenes, None, Address(port=0))
        with server.running():
            asked = pool.submit(ask, server, "/scenes/room/scene.json")
            while (
                scene.site.answers == 0 and not asked.done()
            ):  # until the server has the request, however busy the machine is
                time.sleep(0.001)
            (row,) = json.loads(ask(server, "/")[2])["scenes"]  # others are answered meanwhile
            assert (row["gaussians"], row["static"]) == (7, "scenes/room/scene.json")
            assert not asked.done()
            scene.site.read()
            assert json.loads(asked.result()[2])["gaussians"] == 65536
            assert ask(server, "/scenes/room/records.bin")[2] == RECORDS
            assert json.loads(ask(server, "/")[2])["scenes"][0]["gaussians"] == 65536


def test_a_scene_that_does_not_come_is_asked_for_again(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.serve.sites._PATIENCE", 0.0)
    with Scenes([promise_scene(site, "room", 7)]) as scenes:
        server = Server(scenes, None, Address(port=0))
        with server.running():
            status, fields, _ = ask(server, "/scenes/room/records.bin")
            assert (status, fields["retry-after"]) == (503, "1")


def test_browsers_do_not_store_what_is_on_their_machine(site: Path) -> None:
    about = json.loads((site / "scene.json").read_text())
    about["files"]["plain"] = {"name": "plain-0123456789abcdef", "bytes": 1, "count": 1}
    (site / "scene.json").write_text(json.dumps(about))
    (site / "plain-0123456789abcdef-0.bin").write_bytes(b"p")
    with serving(site) as server:
        _, fields, _ = ask(server, "/scenes/room/plain-0123456789abcdef-0.bin")
        assert fields["cache-control"] == "no-store"


def test_work_beside_a_scene_waits_until_pages_have_read_it_or_need_it(site: Path) -> None:
    found = Site(site)
    slept: list[float] = []

    def read(seconds: float) -> None:
        """Let a page ask for a file now and then, twenty times."""
        slept.append(seconds)
        found.answers += len(slept) % 10 == 0 and len(slept) <= 200

    found.wait_until_quiet(sleep=read)
    assert len(slept) == 200 + 30  # looks until the last request, and three quiet seconds
    found.is_walk_asked = True
    found.wait_until_quiet(sleep=read)
    assert len(slept) == 230

    def ask_on(seconds: float) -> None:
        found.answers += 1
        slept.append(seconds)

    found.is_walk_asked = False
    found.wait_until_quiet(sleep=ask_on)
    assert sum(slept[230:]) == pytest.approx(60.0)
