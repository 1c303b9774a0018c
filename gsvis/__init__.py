"""gsvis: geometry-first visibility and streaming for trained 3D Gaussian Splatting scenes.

    scene = gsvis.load_scene("scene.ply")
    tracer = gsvis.Tracer(gsvis.EllipsoidProxies.from_scene(scene))
    weights = gsvis.visible_in(tracer, gsvis.load_cameras("sparse/0"))

Only the most common names are here; each room (`gsvis.raycast`, `gsvis.render`, ...) has its own. Names are imported on
first use, so that `import gsvis` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.edit import clean
    from gsvis.errors import BackendError, FormatError, GsvisError, SceneError
    from gsvis.io import from_gsplat, load_cameras, load_scene, save_scene
    from gsvis.raycast import EllipsoidProxies, Tracer, visible_from, visible_in
    from gsvis.render import rasterize
    from gsvis.scene.cameras import Cameras
    from gsvis.scene.gaussians import Gaussians

__version__ = "0.3.0"

__all__ = [
    "BackendError",
    "Cameras",
    "EllipsoidProxies",
    "FormatError",
    "Gaussians",
    "GsvisError",
    "SceneError",
    "Tracer",
    "clean",
    "from_gsplat",
    "load_cameras",
    "load_scene",
    "rasterize",
    "save_scene",
    "visible_from",
    "visible_in",
]

_HOMES = {
    "gsvis.edit": ("clean",),
    "gsvis.errors": ("BackendError", "FormatError", "GsvisError", "SceneError"),
    "gsvis.io": ("from_gsplat", "load_cameras", "load_scene", "save_scene"),
    "gsvis.raycast": ("EllipsoidProxies", "Tracer", "visible_from", "visible_in"),
    "gsvis.render": ("rasterize",),
    "gsvis.scene.cameras": ("Cameras",),
    "gsvis.scene.gaussians": ("Gaussians",),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(home), name)
            return value
    raise AttributeError(f"module 'gsvis' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
