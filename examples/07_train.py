"""Can a scene be had from photographs of it? Two rooms are photographed, and trained anew from a few colored points.

Photographs of your own, with a COLMAP model: `gsvis train FOLDER -o scene.ply`, or `load_photos(FOLDER)` in place of
what is made up here. Run it with `python examples/07_train.py`; the name of a PLY to write may follow.
"""

import sys

import numpy as np

from gsvis import rasterize, save_scene
from gsvis.scene.points import PointCloud
from gsvis.scene.procedural import two_rooms
from gsvis.train import DensifyConfig, PosedImages, TrainConfig, gaussians_from_points, measure_views, train

rng = np.random.default_rng(0)
rooms = two_rooms(4000, sh_degree=0)
cameras = rooms.navigable.sample_cameras(40, rng, width=80, height=60)
images = rasterize(rooms.gaussians, cameras).images.clip(0, 1)
views, held_out = PosedImages(cameras, (255 * images).round().astype(np.uint8)).split(every=8)

some = rng.choice(len(rooms.gaussians), 1500, replace=False)  # what COLMAP would have found
colors = (0.5 + 0.28209 * rooms.gaussians.sh0[some, 0]).clip(0, 1)
start = gaussians_from_points(PointCloud(rooms.gaussians.means[some], colors))
before = measure_views(start, held_out)
print(f"{len(start):,} points, as balls: {before.psnr.mean():.1f} dB in {len(held_out)} views that are held out.")

rules = DensifyConfig(start=50, stop=150, every=50, reset_every=0)
result = train(views, start, TrainConfig(iterations=200, sh_degree=1, sh_every=100, densify=rules), held_out=held_out)
after = measure_views(result.gaussians, held_out)
print(
    f"After 200 steps, {len(result.gaussians):,} Gaussians: {after.psnr.mean():.1f} dB, SSIM {after.ssim.mean():.3f}."
)

if len(sys.argv) > 1:
    save_scene(result.gaussians, sys.argv[1])
