"""The view in a link to a page of the viewer: `#eye=x,y,z&to=x,y,z&fov=60&up=0,0,1`, frame and units of the scene."""

from __future__ import annotations

from typing import NamedTuple
from urllib.parse import parse_qs

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.cameras import Cameras

__all__ = ["LinkedView", "parse_link"]

_FOV = (10.0, 120.0)  # as the page allows, degrees


class LinkedView(NamedTuple):
    """A view of a link.

    Attributes:
        eye: (3,) where the eye is.
        to: (3,) what it looks at.
        fov: Vertical field of view, degrees.
        up: (3,) up axis; None where the link names none.
    """

    eye: NDArray[np.float64]
    to: NDArray[np.float64]
    fov: float
    up: NDArray[np.float64] | None

    def camera(self, up: NDArray[np.float64], width: int, height: int) -> Cameras:
        """Return the camera of the view.

        Args:
            up: (3,) up axis where the link names none.
            width: Pixels across.
            height: Pixels down.
        """
        across = 2.0 * np.degrees(np.arctan(np.tan(np.radians(self.fov) / 2.0) * width / height))
        above = up if self.up is None else self.up
        return Cameras.look_at([self.eye], self.to, up=above, fov=float(across), width=width, height=height)


def parse_link(text: str) -> LinkedView:
    """Return the view in a link, or in the part of one behind `#`.

    Raises:
        ValueError: If it has no eye and place to look at, or they are the same.

    Examples:
        >>> parse_link("http://host/view/house#eye=1,2,1.6&to=4,2,1&fov=50&mode=walk").to.tolist()
        [4.0, 2.0, 1.0]
    """
    fields = parse_qs(text.rpartition("#")[2])
    eye, to, up = (_vector(fields.get(name, [""])[0]) for name in ("eye", "to", "up"))
    if eye is None or to is None or np.array_equal(eye, to):
        raise ValueError(f"--view: expected '#eye=x,y,z&to=x,y,z', two places, got {text[:200]!r}; copy it from a page")
    try:
        fov = float(fields.get("fov", ["60"])[0])
    except ValueError:
        fov = 60.0
    return LinkedView(eye, to, float(np.clip(fov if np.isfinite(fov) else 60.0, *_FOV)), up)


def _vector(text: str) -> NDArray[np.float64] | None:
    """Return the three numbers of a text such as "1,2,0.5"; None for any other text."""
    try:
        found = np.array([float(part) for part in text.split(",")])
    except ValueError:
        return None
    return found if found.shape == (3,) and np.isfinite(found).all() and np.abs(found).max() <= 1e6 else None
