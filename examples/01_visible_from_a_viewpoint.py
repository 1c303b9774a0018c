"""Which Gaussians does an eye see? Two rooms joined by a door, an eye in the first one.

Run it with `python examples/01_visible_from_a_viewpoint.py`; a path to a scene may follow.
"""

import sys

import numpy as np

from gsvis.io import load_scene
from gsvis.raycast import TAU, EllipsoidProxies, Tracer, visible_from
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import builtin_scene

if len(sys.argv) > 1:
    g = load_scene(sys.argv[1])
    eye = NavigableSpace.from_scene(g).sample_viewpoints(1, np.random.default_rng(0))[0]
else:
    scene = builtin_scene("two_rooms")
    g, eye = scene.gaussians, scene.viewpoints[0]

tracer = Tracer(EllipsoidProxies.from_scene(g))
weights = visible_from(tracer, eye[None], sampling="gaussians")[0]  # (N,) a ray to every Gaussian
visible = weights >= TAU

print(f"From {np.round(eye, 2)} {visible.sum():,} of {len(g):,} Gaussians can be seen: {visible.mean():.1%}.")

pixels = visible_from(tracer, eye[None], size=64)[0] >= TAU  # the rays of a cubemap of 6 x 64 x 64 pixels
print(f"Pixel rays of a small cubemap find {pixels.sum():,}: the rest falls between the rays.")

strongest = np.argsort(-weights)[:3]
print(
    "The three that weigh most:", ", ".join(f"{i} ({weights[i]:.3f} at {np.round(g.means[i], 2)})" for i in strongest)
)
