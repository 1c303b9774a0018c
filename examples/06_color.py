"""Can a few terms a Gaussian stand in for spherical harmonics, and how many of them does one eye need?

Run it with `python examples/06_color.py`; the name of an Arrow file to write may follow.
"""

import sys

from gsvis.color import FitConfig, active, record_bytes, save_srbf, sh_bytes
from gsvis.prepare import ColorConfig, ColorQualityConfig, measure_colors, prepare_colors
from gsvis.scene.procedural import two_rooms
from gsvis.scene.view_sampling import ViewSampling

rooms = two_rooms(5000, sh_degree=3)
scene, space = rooms.gaussians, rooms.navigable

config = ColorConfig(FitConfig(mean_terms=3.0), ViewSampling(count=24, width=160, height=120))
colors = prepare_colors(scene, space, config).fit.colors  # base colors and terms, the most useful first
each = record_bytes(colors) / len(scene)
print(f"{colors.num_terms / len(scene):.1f} terms a Gaussian: {each:.0f} bytes of color instead of {sh_bytes(3):.0f}.")

others = ViewSampling(count=4, width=160, height=120, stream=1).cameras(scene, space)  # the fit has not seen these
found = measure_colors(scene, colors, others, ColorQualityConfig(counts=(), epsilons=(0.02,), flip=False))
print(f"Against SH: {found.all_terms.psnr.mean():.1f} dB; base colors alone: {found.base_only.psnr.mean():.1f} dB.")

needed = active(colors, scene.means, rooms.viewpoints[0], epsilon=0.02)
print(f"One eye needs {needed.mean():.0%} of the terms; without the others: {found.active_psnr.mean():.1f} dB.")

if len(sys.argv) > 1:
    save_srbf(sys.argv[1], scene, colors, precision="wire")
