"""What does a camera see, and which Gaussians make one pixel of it? Two rooms, drawn on the CPU.

Run it with `python examples/04_render.py`; the name of a PNG to write may follow.
"""

import sys

import numpy as np
from PIL import Image

from gsvis.raycast import TAU
from gsvis.render import contributors, rasterize, view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.procedural import builtin_scene

scene = builtin_scene("two_rooms")
camera = Cameras.look_at(scene.viewpoints[:1], (5.0, 2.0, 1.0), up=scene.up, width=320, height=240)

seen = rasterize(scene.gaussians, camera)  # images (1, 240, 320, 3), alphas and depths (1, 240, 320)
if len(sys.argv) > 1:
    Image.fromarray((seen.images[0].clip(0, 1) * 255).round().astype(np.uint8)).save(sys.argv[1])

found = contributors(scene.gaussians, camera, (160, 120))  # front to back
print(f"{len(found)} Gaussians make the middle pixel, at a depth of {seen.depths[0, 120, 160]:.2f}.")
print(f"Their weights sum to {found.weights.sum():.4f}; its alpha is {seen.alphas[0, 120, 160]:.4f}.")

strongest = np.argsort(-found.weights)[:3]
print("The three that weigh most:", ", ".join(f"{found.gaussian_ids[i]} ({found.weights[i]:.3f})" for i in strongest))

visible = view_weights(scene.gaussians, camera).largest[0] >= TAU
print(f"The view needs {visible.sum():,} of {len(scene.gaussians):,} Gaussians: {visible.mean():.1%}.")
