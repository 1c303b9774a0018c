"""From how many directions can Gaussians be seen? Traced outward, without cameras, and compared with an eye's view.

Run it with `python examples/03_directions.py`.
"""

import numpy as np

from gsvis.raycast import EllipsoidProxies, Tracer, directions
from gsvis.scene.procedural import builtin_scene

scene = builtin_scene("two_rooms")
tracer = Tracer(EllipsoidProxies.from_scene(scene.gaussians))
sample = np.random.default_rng(0).choice(len(scene.gaussians), 500, replace=False)

sets = directions.trace_directions(
    tracer, scene.navigable, ids=sample, rays_per_face=4
)  # (500, 10) bytes, 80 bits each
fractions = directions.direction_fractions(sets)
cdf = directions.direction_cdf(fractions)

print(f"A Gaussian of this scene can be seen from {fractions.mean():.1%} of all directions on average.")
for faces in (33, 48):
    print(f"{cdf[faces - 1]:.1%} can be seen from less than {faces / 80:.2%} of them.")  # cdf[k]: from at most k faces

most = int(sample[fractions.argmax()])
print(f"The freest stands at {np.round(scene.gaussians.means[most], 2)}: {fractions.max():.0%} of the directions.")
