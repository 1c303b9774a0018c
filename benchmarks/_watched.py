"""A page of the viewer whose network Worker reports what it sends and receives, and when."""

from __future__ import annotations

from typing import Any

from gsvis.stream.wire import Ack, Bye, Hello, PoseAt, Token, parse_client

# A Worker whose script is watched counts as one of unknown origin, which may not ask addresses of a local network.
LOCAL = "LocalNetworkAccessChecks,LocalNetworkAccessChecksWebSockets"
FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", f"--disable-features={LOCAL}")

_WATCH = """
const Socket = WebSocket, said = new BroadcastChannel("said");
self.WebSocket = class extends Socket {
  constructor(url) {
    super(url);
    this.addEventListener("message", (event) => said.postMessage(["down", Date.now(), event.data.byteLength]));
  }
  send(data) {
    super.send(data);
    if (data.length < 4000) said.postMessage(["up", Date.now(), [...data]]);
  }
};
"""
_HEAR = """
window.said = [];
new BroadcastChannel("said").onmessage = (event) => window.said.push(event.data);
"""


def watch(page: Any) -> None:
    """Have the network Worker of a page of Playwright report; call it before the page is opened."""

    def watched(route: Any) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, body=_WATCH + answer.text())

    page.route("**/viewer/network.js", watched)
    page.add_init_script(_HEAR)


def heard(page: Any) -> tuple[list[tuple[float, Hello | PoseAt | Ack | Bye | Token]], list[tuple[float, int]]]:
    """Return what has been sent, and the sizes of what has arrived, each with its time in seconds since 1970."""
    said = page.evaluate("window.said")
    sent = [(at / 1000, parse_client(bytes(data))) for kind, at, data in said if kind == "up"]
    return sent, [(at / 1000, size) for kind, at, size in said if kind == "down"]
