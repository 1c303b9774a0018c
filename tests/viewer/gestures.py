"""What hands do on the page of a scene, and how a test waits for what comes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

HASTE = """{
    const draw = window.requestAnimationFrame.bind(window), now = performance.now.bind(performance);
    window.requestAnimationFrame = (frame) => draw((time) => frame(4 * time));
    performance.now = () => 4 * now();
}"""
"""Lets the time of a page pass four times as fast: a view comes to rest after a quarter of the frames."""


def eye(page: Any) -> list[float]:
    """Position of the camera that the viewer got last."""
    return [float(x) for x in page.evaluate("fake.camera.position")]


def turned(page: Any) -> list[float]:
    return [float(x) for x in page.evaluate("fake.camera.rotation")]


@contextmanager
def motion(page: Any, of: Callable[[Any], Any] = turned) -> Iterator[Callable[[], None]]:
    """Expect the view to change, and wait until it rests.

    Yields:
        Waits for the change: what is held until a frame has seen it is let go after that.
    """
    before, name = of(page), "position" if of is eye else "rotation"

    def changed() -> None:
        page.wait_for_function(f"before => JSON.stringify(fake.camera.{name}) !== JSON.stringify(before)", arg=before)

    yield changed
    changed()
    rest(page)


def hold(page: Any, key: str, of: Callable[[Any], Any] = turned) -> None:
    """Hold a key until the view changes."""
    with motion(page, of) as changed:
        page.keyboard.down(key)
        changed()
        page.keyboard.up(key)


def rest(page: Any) -> None:
    """Wait until the camera has not changed for four frames."""
    page.evaluate("window.rested = {last: '', same: 0}")
    page.wait_for_function("""() => {
        const now = JSON.stringify(fake.camera);
        rested.same = now === rested.last ? rested.same + 1 : 0;
        rested.last = now;
        return rested.same > 3;
    }""")


def mode(page: Any) -> str:
    return str(page.evaluate("document.documentElement.dataset.mode"))


def drag(page: Any, dx: float, dy: float, button: str = "left") -> None:
    page.mouse.move(640, 420)
    page.mouse.down(button=button)
    page.mouse.move(640 + dx / 2, 420 + dy / 2)
    page.mouse.move(640 + dx, 420 + dy)
    page.mouse.up(button=button)


@contextmanager
def motion_of_tour(page: Any) -> Iterator[None]:
    """Expect the eye to move by itself."""
    yield
    before = eye(page)
    page.wait_for_function("before => JSON.stringify(fake.camera.position) !== JSON.stringify(before)", arg=before)
