"""Bring what a user gives in the coordinates of a file into the frame of a scene that has an origin."""

from __future__ import annotations

from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["cameras_in_scene"]


def cameras_in_scene(cameras: Cameras, path: str | None, g: Gaussians) -> Cameras:
    """Return the cameras of a file in the frame of a scene.

    Args:
        cameras: The cameras of the file, in the coordinates of the scene's source; those that gsvis wrote itself, into
            a report, are in the frame of the scene.
        path: The file; None if they are not of a file.
        g: The scene.
    """
    if not any(g.facts.origin):
        return cameras
    from gsvis.io.cameras import holds_repeated_views

    return cameras if path is None or holds_repeated_views(path) else cameras.with_origin(g.facts.origin)
