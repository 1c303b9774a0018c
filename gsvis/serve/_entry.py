"""Who may enter: tokens in headers, in addresses, in a cookie; origins of pages, and what other origins may read.

A cookie never holds the token, but a hash of it, so another server of the same host that gets the cookie (cookies know
no ports) does not learn the token. It counts only for requests that a page of this server makes, or a person.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["Cors", "Entry"]

_OPEN = ("/packages/", "/scenes/", "/viewer/")  # what pages of allowed origins may read, besides the index
_READ = "GET, HEAD"
_SENT = "authorization, range, if-range, if-none-match, accept"
_SHOWN = "content-range, accept-ranges, content-length, etag, retry-after"
_KEEP_S = "600"  # seconds for which a browser remembers what another origin may do


@dataclass(frozen=True)
class Entry:
    """The rules of who may enter.

    Attributes:
        token: Token that clients must show; None admits every client.
        origins: Origins of pages that may enter besides those of this server; "*" means every origin.
    """

    token: str | None = field(default=None, repr=False)
    origins: tuple[str, ...] = ()

    def is_right(self, shown: str) -> bool:
        """Return whether a token is the right one, in constant time."""
        return self.token is None or _same(shown.strip(), self.token)

    def token_in(self, asked: HTTPConnection) -> str | None:
        """Return the token that the header or the address of a request shows; None if it shows none."""
        kind, _, shown = asked.headers.get("authorization", "").partition(" ")
        return shown if kind.lower() == "bearer" else asked.query_params.get("token")

    def admits(self, asked: HTTPConnection) -> bool:
        """Return whether a request shows the token or a cookie for it; true if no token is needed."""
        if self.token is None:
            return True
        shown = self.token_in(asked)
        return self._has_cookie(asked) if shown is None else self.is_right(shown)

    def _has_cookie(self, asked: HTTPConnection) -> bool:
        """Return whether a request shows the cookie, and was made by a page of this server or by a person."""
        name, value = self._cookie()
        given = asked.cookies.get(name)
        if given is None or not _same(given, value):
            return False
        site, mode = (asked.headers.get(f"sec-fetch-{key}") for key in ("site", "mode"))
        is_own = site in (None, "none", "same-origin") or (mode == "navigate" and asked.scope["type"] == "http")
        return is_own and (asked.headers.get("origin") is None or is_same_origin(asked))

    def _cookie(self) -> tuple[str, str]:
        """Return name and value of the cookie; the same after a restart, so that pages reconnect."""
        key = (self.token or "").encode()
        name, value = (hmac.new(key, text, hashlib.sha256).hexdigest() for text in (b"gsvis name", b"gsvis cookie"))
        return f"gsvis-{name[:8]}", value

    def set_cookie(self, response: Response, *, is_secure: bool) -> None:
        """Add the cookie to the answer for an address in the first folder; it lasts as long as the browser runs.

        The cookie has no path of its own, so it counts for that folder, whatever prefix a proxy has put before it.
        """
        name, value = self._cookie()
        secure = "; Secure" if is_secure else ""
        response.headers.append("set-cookie", f"{name}={value}; HttpOnly; SameSite=Strict{secure}")

    def allows(self, asked: HTTPConnection) -> bool:
        """Return whether a page of this origin may open streams. Programs send no Origin; a page sends its own."""
        origin = asked.headers.get("origin")
        return origin is None or "*" in self.origins or origin in self.origins or is_same_origin(asked)


def is_same_origin(asked: HTTPConnection) -> bool:
    """Return whether the Origin of a request is the host that it asks."""
    try:
        origin = urlsplit(asked.headers.get("origin", "")).netloc.lower()
    except ValueError:  # such as "http://["
        return False
    return origin == asked.headers.get("host", "").lower() != ""


def _same(one: str, other: str) -> bool:
    """Return whether two texts are equal, in constant time."""
    return hmac.compare_digest(one.encode("utf-8", "replace"), other.encode())


class Cors:
    """Let pages of allowed origins read scenes, packages and the files of the viewer.

    Such pages show the token in a header. Their cookies never count: no answer allows credentials.
    """

    def __init__(self, inner: ASGIApp, entry: Entry) -> None:
        self._inner = inner
        self._entry = entry

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path", "")
        if scope["type"] != "http" or not (path == "/" or path.startswith(_OPEN)):
            await self._inner(scope, receive, send)
            return
        request = Request(scope)
        origins = self._entry.origins
        origin = request.headers.get("origin")
        is_open = origin is not None and ("*" in origins or origin in origins)
        if request.method == "OPTIONS" and "access-control-request-method" in request.headers:
            await self._answer(request, is_open)(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start" and origins:
                headers = MutableHeaders(scope=message)
                if "*" not in origins:
                    headers.add_vary_header("Origin")
                if is_open or "*" in origins:  # a cache may keep the answer to a program for pages
                    headers["access-control-allow-origin"] = "*" if "*" in origins else str(origin)
                    headers["access-control-expose-headers"] = _SHOWN
            await send(message)

        await self._inner(scope, receive, with_headers)

    def _answer(self, request: Request, is_open: bool) -> Response:
        """Answer the preflight request of a browser, which shows no token."""
        vary = {"vary": "Origin"}
        if not is_open:
            return PlainTextResponse("pages of this origin may not read from here\n", 403, vary)
        headers = vary | {
            "access-control-allow-origin": "*" if "*" in self._entry.origins else request.headers["origin"],
            "access-control-allow-methods": _READ,
            "access-control-allow-headers": _SENT,
            "access-control-max-age": _KEEP_S,
        }
        if request.headers.get("access-control-request-private-network") == "true":
            headers["access-control-allow-private-network"] = "true"
        return Response(status_code=204, headers=headers)
