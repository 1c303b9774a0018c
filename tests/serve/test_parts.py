"""Files of packages: every range is the bytes it names, nothing else can be named, nothing damaged goes out."""

from __future__ import annotations

import errno
import json
import logging
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import FormatError
from gsvis.serve import Server
from gsvis.serve.parts import byte_range, read_part
from tests.serve.servers import ask, close_code, patient, raw, serving

OUTSIDE = [
    "/packages/plain/parts/../manifest.json",
    "/packages/plain/../../../../../../etc/passwd",
    "/packages/plain/parts/..%2f..%2f..%2f..%2f..%2fetc%2fpasswd",
    "/packages/plain/parts/%2e%2e/%2e%2e/secret",
    "/packages/plain/parts/....//secret",
    "/packages/plain/parts/..\\..\\secret",
    "/packages/plain/parts/%00",
    "/packages/plain/parts//etc/passwd",
    "/packages/plain/parts/" + "a" * 64,
    "/packages/plain/parts/" + "A" * 64 + ".arrow",
    "/packages/plain/parts/" + "0" * 64 + ".arrow%0a",
    "/packages/plain/secret",
    "/packages/..%2fsecret/manifest.json",
    "/packages/../secret",
    "//etc/passwd",
    "/../../../../../../etc/passwd",
]


@given(st.integers(0, 50), st.integers(0, 60), st.integers(0, 60))
def test_a_range_is_a_slice(size: int, first: int, last: int) -> None:
    data = bytes(range(size))
    found = byte_range(f"bytes={first}-{last}", size)
    assert (found is None) == (last < first)
    if found is not None:
        assert data[slice(*found)] == data[first : last + 1]
    tail = byte_range(f"bytes=-{last}", size)
    assert tail is not None
    assert data[slice(*tail)] == (data[-last:] if last else b"")
    rest = byte_range(f"bytes={first}-", size)
    assert rest is not None
    assert data[slice(*rest)] == data[first:]


@given(st.text(max_size=30))
def test_any_header_is_read_or_passed_over(header: str) -> None:
    found = byte_range(header, 100)
    assert found is None or 0 <= found[0] <= found[1] <= 100


def test_parts_go_out_whole_and_in_ranges(plain: Path) -> None:
    part = max((plain / "parts").iterdir(), key=lambda path: path.stat().st_size)
    data, where = part.read_bytes(), f"/packages/plain/parts/{part.name}"
    with serving(plain) as server:
        status, fields, body = ask(server, where)
        assert (status, body) == (200, data)
        assert "immutable" in fields["cache-control"]
        status, fields, body = ask(server, where, Range="bytes=100-199")
        assert (status, body, fields["content-range"]) == (206, data[100:200], f"bytes 100-199/{len(data)}")
        assert ask(server, where, Range="bytes=-7")[2] == data[-7:]
        assert ask(server, where, Range="bytes=0-0,5-6")[2] == data  # several ranges may be answered by the whole
        assert ask(server, where, Range=f"bytes={len(data)}-")[0] == 416
        assert ask(server, where, Range="bytes=1-2", If_Range='"another"')[2] == data
        status, head, body = ask(server, where, "HEAD")
        assert (status, head["content-length"], body) == (200, str(len(data)), b"")
        assert ask(server, where, If_None_Match=fields["etag"])[0] == 304
        status, fields, body = ask(server, "/packages/plain/manifest.json")
        assert (status, body, fields["cache-control"]) == (200, (plain / "manifest.json").read_bytes(), "no-cache")
        (row,) = json.loads(ask(server, "/")[2])["scenes"]
        assert (row["name"], row["state"], row["gaussians"]) == ("plain", "ready", 6000)
        assert ask(server, where, "POST")[0] == 405
        assert server.metrics.parts.value("206") == 2


def test_nothing_but_the_package_can_be_named(plain: Path, tmp_path: Path) -> None:
    folder = tmp_path / "plain.gsvis"
    shutil.copytree(plain, folder)
    for place in (tmp_path, folder, folder / "parts"):
        (place / "secret").write_text("root:secret")
    with serving(folder) as server:
        for path in OUTSIDE:
            status, _, body = ask(server, path)
            assert status in (400, 404), path
            assert b"root:" not in body, path
        assert ask(server, "/healthz")[0] == 200


def test_what_is_damaged_or_a_link_does_not_go_out_and_the_rest_does(plain: Path, tmp_path: Path) -> None:
    folder = tmp_path / "plain.gsvis"
    shutil.copytree(plain, folder)
    first, second, third, *_ = sorted((folder / "parts").iterdir())
    first.write_bytes(first.read_bytes()[:-1] + b"!")
    kept = tmp_path / "kept"
    second.rename(kept)
    second.symlink_to(kept)
    with pytest.raises(FormatError, match="content that fits its name"):
        read_part(folder, first.name)
    with pytest.raises(FormatError, match="links are not followed"):
        read_part(folder, second.name)
    shutil.copytree(plain, tmp_path / "well.gsvis")
    with serving(tmp_path / "well.gsvis", folder) as server:  # one is refused as a whole, the other is served
        assert ask(server, f"/packages/plain/parts/{first.name}")[0] == 500
        assert ask(server, f"/packages/plain/parts/{third.name}")[0] == 200
        assert ask(server, f"/packages/well/parts/{first.name}")[0] == 200
        assert [row["state"] for row in json.loads(ask(server, "/")[2])["scenes"]] == ["ready", "refused"]
        assert json.loads(ask(server, "/healthz")[2])["refused"] == 1
        assert patient(server.url, plain)[0].connections == 1


@pytest.mark.parametrize(("number", "status"), [(errno.EMFILE, 503), (errno.ENOMEM, 503), (errno.EIO, 500)])
def test_a_file_that_cannot_be_read_costs_one_line(
    plain: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, number: int, status: int
) -> None:
    part = next((plain / "parts").iterdir()).name

    def unread(*_: object) -> bytes:
        raise OSError(number, "no luck", str(plain))

    with caplog.at_level(logging.INFO), serving(plain) as server:
        monkeypatch.setattr("gsvis.serve.parts.read_whole", unread)
        for path in (f"/packages/plain/parts/{part}", "/packages/plain/manifest.json"):
            caplog.clear()
            found, _, body = ask(server, path)
            assert (found, str(plain).encode() in body) == (status, False)
            lines = [record for record in caplog.records if record.levelno >= logging.WARNING]
            assert [("no luck" in record.getMessage(), record.exc_info) for record in lines] == [(True, None)]
        assert server.metrics.parts.value(str(status)) == 2
        assert server.metrics.scenes.faults.value("plain") == (0 if status == 503 else 2)
        monkeypatch.undo()
        assert ask(server, f"/packages/plain/parts/{part}")[0] == 200


def test_a_request_that_fails_costs_one_line(
    plain: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("the inside of it")

    monkeypatch.setattr("gsvis.serve.app.Entry.admits", broken)

    def fails_over_http(server: Server) -> bool:
        status, _, body = ask(server, "/metrics")
        return status == 500 and b"inside" not in body

    def fails_over_a_socket(server: Server) -> bool:
        with raw(server, b"") as ws:
            return close_code(ws) == 1011 and "inside" not in (ws.close_reason or "")

    with caplog.at_level(logging.INFO), serving(plain) as server:
        for fails in (fails_over_http, fails_over_a_socket):
            caplog.clear()
            assert fails(server)
            lines = [record for record in caplog.records if record.levelno >= logging.WARNING]
            assert [("the inside" in record.getMessage(), record.exc_info) for record in lines] == [(True, None)]


def test_with_a_token_all_but_health_wants_it(plain: Path) -> None:
    with serving(plain, token="s3cret") as server:
        for path in ("/", "/metrics", "/packages/plain/manifest.json"):
            assert ask(server, path)[0] == 401
            assert ask(server, path, Authorization="Bearer s3cre")[0] == 401
            assert ask(server, path + "?token=s3crets")[0] == 401
            status, fields, _ = ask(server, path, Authorization="Bearer s3cret")
            assert status == 200
            assert "public" not in fields.get("cache-control", "")
            assert ask(server, path + "?token=s3cret")[0] == 200
        assert ask(server, "/healthz")[0] == 200
    with pytest.raises(ValueError, match="token"), serving(plain, token=""):
        pass
