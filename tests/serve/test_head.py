"""One judge of requests: whatever passes the guard passes both parsers behind it, with the same meaning."""

from __future__ import annotations

import h11
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from websockets.http11 import Request
from websockets.streams import StreamReader

from gsvis.serve._head import MOST_BYTES, Head, Refusal, check_head, find_end

FIRST = st.sampled_from([
    *[b"GET / HTTP/1.1", b"GET /a?b%20c HTTP/1.0", b"GET /\\..\\~{}| HTTP/1.1", b"HEAD http://a/ HTTP/1.1"] * 3,
    b"POST * HTTP/1.1", b"GET  / HTTP/1.1", b"GET / HTTP/2", b"GET /\x80 HTTP/1.1", b"GET / HTTP/1.1 ", b"",
])  # fmt: skip
HEADER = st.one_of(
    st.sampled_from([
        b"X-A:\tb ", b"X: \xff", b"X:", b"x!#$%&'*+-.^_`|~9: y", b"Content-Length: 0", b"Connection: Upgrade, close",
        b"Upgrade: websocket", b"X: " + b"a" * 7990, b"Expect: 100-continue", b"X: a:b\t c", b"Connection: ,",
    ]),
    st.sampled_from([
        b"Host : c", b"X: \x00", b"X: \x7f", b"X: \x0b", b" X: folded", b": y", b"X", b"Content-Length: 3", b"",
        b"Content-Length: +0", b"Content-Length: 0, 0", b"Transfer-Encoding: chunked", b"Transfer-Encoding: identity",
        b"X: " + b"a" * 8100, b"X\xc3\xa9: y", b"X: a\rb", b"X: a\nb", b"Host: b",
    ]),
    st.binary(max_size=12).map(lambda value: b"X: " + value),
)  # fmt: skip
LINES = st.tuples(FIRST, st.sampled_from([b"Host: a", b"host:a:80", b"Host:"]), st.lists(HEADER, max_size=4))


def parsed_by_websockets(head: bytes) -> Request:
    reader = StreamReader()
    reader.feed_data(head)
    reader.feed_eof()
    steps = Request.parse(reader.read_line)
    with pytest.raises(StopIteration) as ended:
        next(steps)
    return ended.value.value


def as_uvicorn_writes(event: h11.Request) -> bytes:
    lines = [event.method + b" " + event.target + b" HTTP/1.1", *(k.lower() + b": " + v for k, v in event.headers)]
    return b"\r\n".join([*lines, b"", b""])


@settings(max_examples=500)
@given(LINES)
@example((b"GET / HTTP/1.1", b"Host: a", [b"A: b"] * 99))
@example((b"GET /" + b"a" * 7980 + b" HTTP/1.1", b"Host: a", []))
def test_what_passes_is_understood_by_both_parsers(lines: tuple[bytes, bytes, list[bytes]]) -> None:
    data = b"\r\n".join([*lines[:2], *lines[2]]) + b"\r\n\r\n"
    end = find_end(data)
    if isinstance(end, Refusal):
        return
    assert end is not None
    head = check_head(data[:end])
    if isinstance(head, Refusal):
        return
    parser = h11.Connection(h11.SERVER, 2 * MOST_BYTES)
    parser.receive_data(data[:end])
    event = parser.next_event()
    assert isinstance(event, h11.Request)
    assert isinstance(parser.next_event(), h11.EndOfMessage)
    assert (event.method.decode(), event.target.decode()) == (head.method, head.target)
    assert [(k.decode(), v.decode("latin-1")) for k, v in event.headers] == head.headers
    if head.method == "GET":
        found = parsed_by_websockets(as_uvicorn_writes(event))
        assert found.path == head.target
        assert len(list(found.headers.raw_items())) == len(head.headers)


@given(st.binary(max_size=60), st.data())
def test_the_end_is_found_however_the_bytes_come(tail: bytes, data: st.DataObject) -> None:
    whole = b"GET / HTTP/1.1\r\nHost: a\r\n\r\n" + tail
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=8)))
    seen, found = 0, None
    for cut in [*cuts, len(whole)]:
        found = find_end(whole[:cut], seen)
        if found is not None:
            break
        seen = cut
    assert found == 27


@pytest.mark.parametrize(
    ("bad", "status"),
    [
        (b"GET / HTTP/1.1\nHost: a\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: a\n\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: a\r\rX: y\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: \0\r\n\r\n", 400),
        (b"a" * (MOST_BYTES + 1), 431),
    ],
)
def test_broken_lines_are_refused_at_once(bad: bytes, status: int) -> None:
    found = find_end(bad)
    assert isinstance(found, Refusal)
    assert found.status == status


@pytest.mark.parametrize(
    ("lines", "status"),
    [
        ([b"GET / HTTP/1.1"], 400),
        ([b"GET / HTTP/1.1", b"Host: a", b"Host: a"], 400),
        ([b"GET / HTTP/1.1", b"Host: a", b"Content-Length: 0", b"Transfer-Encoding: chunked"], 400),
        ([b"GET / HTTP/1.1", b"Host: a", b"Content-Length: 0", b"Content-Length: 0"], 400),
        ([b"GET / HTTP/1.1", b"Host: a", b"Content-Length: -1"], 400),
        ([b"GET / HTTP/1.1", b"Host: a", b"Content-Length: 1"], 413),
        ([b"GET / HTTP/1.1", b"Host: a", b"Transfer-Encoding: chunked"], 413),
        ([b"GET /" + b"a" * 9000 + b" HTTP/1.1", b"Host: a"], 414),
        ([b"GET / HTTP/1.1", b"Host: a", b"X: " + b"a" * 9000], 431),
        ([b"GET / HTTP/1.1", b"Host: a", *[b"X: a"] * 100], 431),
    ],
)
def test_each_refusal_has_its_status(lines: list[bytes], status: int) -> None:
    found = check_head(b"\r\n".join([*lines, b"", b""]))
    assert isinstance(found, Refusal)
    assert found.status == status


def test_a_request_without_a_body_passes() -> None:
    found = check_head(b"GET /x HTTP/1.1\r\nHost: a\r\nContent-Length: 0\r\n\r\n")
    assert found == Head("GET", "/x", [("host", "a"), ("content-length", "0")])
    assert isinstance(check_head(b"GET / HTTP/1.0\r\n\r\n"), Head)
