"""Why can this Gaussian not be seen? Trace the ray to it and list what takes its light.

Run it with `python examples/02_why_is_this_one_hidden.py`.
"""

import numpy as np

from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.procedural import builtin_scene

scene = builtin_scene("two_rooms")
g, eye = scene.gaussians, scene.viewpoints[0]
hidden = int(np.flatnonzero(scene.hidden[0])[0])  # the scene knows in closed form what this eye cannot see

tracer = Tracer(EllipsoidProxies.from_scene(g))
toward = g.means[hidden] - eye
found = tracer.contributions(eye[None], toward[None])  # all that contributes to the ray, front to back

print(f"Gaussian {hidden} lies {np.linalg.norm(toward):.2f} away. What takes more than 1% of the light on the way:")
for i, alpha, weight, depth in zip(found.gaussian_ids, found.alphas, found.weights, found.depths, strict=True):
    if weight > 0.01:
        print(f"  {i:6d} at {depth:.2f}: alpha {alpha:.3f}, weight {weight:.3f}")
print(f"The ray ends after {len(found.gaussian_ids)} Gaussians with {found.transmittance[0]:.1e} of the light left.")
