"""What does a viewer get, and what when it comes back? A server and a client over a real WebSocket, on this machine.

Run it with `python examples/09_stream.py`; it needs the extra `serve`.
"""

import tempfile
from pathlib import Path

import numpy as np

from gsvis.abr import FieldOfView
from gsvis.color.fit import FitConfig, fit_srbf
from gsvis.color.records import quantize
from gsvis.package import in_package_order, write_package
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import two_rooms
from gsvis.serve import Address, Server, fetch, open_scenes

rooms = two_rooms(5000, sh_degree=1)
scene, eye = rooms.gaussians, rooms.viewpoints[0]
once = np.zeros(len(scene), np.uint8)
levels = in_package_order(Levels(scene, once, once, ("high",)))
colors = fit_srbf(levels.union, config=FitConfig(max_terms=2)).colors


def look(t):
    """Stands in one room and turns about."""
    return eye, (np.cos(t / 2), 0.0, 0.0, np.sin(t / 2))


with tempfile.TemporaryDirectory() as folder:
    write_package(Path(folder) / "rooms.gsvis", levels, quantize(colors)).close()
    with (
        open_scenes([Path(folder) / "rooms.gsvis"]) as scenes,
        Server(scenes, address=Address(port=0)).running() as url,
    ):
        first = fetch(url, FieldOfView.from_degrees(90, 70), look, 2.0)
        second = fetch(url, FieldOfView.from_degrees(90, 70), look, 0.5, receiver=first.receiver)  # comes back
        gaussians, colors = second.receiver.scene()

print(f"{first.nbytes / 1e3:.0f} kB in two seconds; {second.nbytes / 1e3:.0f} kB more after coming back.")
print(f"Ready to draw: {len(gaussians):,} of {len(scene):,} Gaussians, {colors.num_terms:,} terms.")
