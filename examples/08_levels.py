"""How much of a scene do a quarter and a half of its Gaussians show, most of them unchanged and a few trained anew?

Run it with `python examples/08_levels.py`; the name of a folder for the levels may follow.
"""

import sys

from gsvis.io.levels import save_levels
from gsvis.scene.procedural import two_rooms
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.images import render_views
from gsvis.train.level_quality import measure_levels
from gsvis.train.levels import LevelsConfig, train_levels

rooms = two_rooms(5000, sh_degree=1)
scene, space = rooms.gaussians, rooms.navigable


def drawn(count, stream):
    """Images of the scene from where eyes may be; there are no photographs of it."""
    return render_views(scene, ViewSampling(count, width=96, height=72, stream=stream).cameras(scene, space))


levels = train_levels(scene, drawn(16, stream=0), LevelsConfig(iterations=60)).levels
quality = measure_levels(levels, drawn(4, stream=1))  # training has not seen these

for k, name in enumerate(levels.names[:-1]):
    seen = f"{quality.scene_psnr[k].mean():.1f} dB, brightness {quality.brightness[k]:.3f}"
    print(f"{name}: {levels.counts[k]:,} of {len(scene):,} Gaussians, {levels.reuse[k]:.0%} reused: {seen}.")
print(f"The scene: brightness {quality.brightness[-1]:.3f}. Going up step by step sends {levels.overhead:.1%} more.")

if len(sys.argv) > 1:
    save_levels(levels, sys.argv[1])
