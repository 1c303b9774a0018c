"""The first table of docs/results.md: where gsvis is better than the best other tool; see results_rows.py."""

from __future__ import annotations

from results_pages import Row, Section

__all__ = ["BEHIND", "WINS"]

BEHIND = (
    "Another tool is ahead in reading compressed PLY as it is (gsply), in hidden point removal from outside a shell"
    " (Open3D), at a quarter of showroom's Gaussians (splat-transform), and where a link carries the whole file within"
    " a second. These rows stand below."
)
"""What a reader should know beside the table of wins."""

WINS = Section(
    "What does gsvis do better than other tools?",
    "",
    (
        Row(
            "How soon are a first (20 dB) and a sharp image (35 dB) there at 10 Mbit/s, nika; showroom?",
            (
                "streaming_rivals: 20 dB after, median, 10 Mbit/s, nika",
                "streaming_rivals: 35 dB after, median, 10 Mbit/s, nika",
                "streaming_rivals_showroom: 20 dB after, median, 10 Mbit/s, showroom",
                "streaming_rivals_showroom: 35 dB after, median, 10 Mbit/s, showroom",
            ),
            ours="{0:.2g}, {1:.2g} s; {2:.2g}, {3:.2g} s",
            peer="layers (LapisGS): 0.2, 1.8 s; layers 0.6 s, blocks in view 1.9 s",
            target="≤ 0.1, 0.5 s",
            page="streaming",
        ),
        Row(
            "How many bytes does it take until a sharp image at 10 Mbit/s (nika, showroom)?",
            (
                "streaming_rivals: bytes until 35 dB, 10 Mbit/s, nika, of those of the best rival",
                "streaming_rivals_showroom: bytes until 35 dB, 10 Mbit/s, showroom, of those of the best rival",
            ),
            ours="{0:.0%}, {1:.0%}",
            peer="layers (LapisGS), blocks in view: 100%",
            target="≤ 50%",
            page="streaming",
        ),
        Row(
            "How much does our sidecar save PlayCanvas until 35 dB: bytes, splats drawn (showroom, nika)?",
            (
                "streamed_sog: showroom: bytes until 35 dB, fewer than in the engine's order",
                "streamed_sog_nika: nika: bytes until 35 dB, fewer than in the engine's order",
                "streamed_sog: showroom: splats drawn, fewer than without the sidecar",
                "streamed_sog_nika: nika: splats drawn, fewer than without the sidecar",
            ),
            ours="{0:.0%}, {1:.0%}; {2:.0%}, {3:.0%}",
            peer="PlayCanvas 2.23's own order: 0",
            target="≥ 40%",
            page="viewer",
        ),
        Row(
            "Levels by light and error: how much better than by distance, 1M splats, mean, worst of 40 (showroom)?",
            (
                "level_choice: showroom, walks: 1,000,000 splats: mean dB above the engine's choice",
                "level_choice: showroom, random: 1,000,000 splats: mean dB above the engine's choice",
                "level_choice: showroom, walks: 1,000,000 splats: worst eye, dB above the engine's choice",
                "level_choice: showroom, random: 1,000,000 splats: worst eye, dB above the engine's choice",
            ),
            ours="walks {0:.0f}, {2:.1f} dB; random eyes {1:.0f}, {3:.1f}",
            peer="PlayCanvas 2.23's choice by distance: 0",
            target="≥ 2, -0.3 dB",
            page="viewer",
        ),
        Row(
            "How true is the page's picture, and how many frames does it draw, without a GPU (showroom, nika)?",
            (
                "viewer_draw: showroom: PSNR",
                "viewer_draw: nika: PSNR",
                "viewer_draw: showroom: frames a second over PlayCanvas'",
                "viewer_draw: nika: frames a second over PlayCanvas'",
            ),
            ours="{0:.1f}, {1:.1f} dB; {2:.1f}, {3:.1f} times",
            peer="PlayCanvas 2.23: 33.4, 23.1 dB; 1",
            target="≥ 50, 42 dB; 2 times",
            page="viewer",
        ),
        Row(
            "How good is an image from a visible set, mean and worst of 40, at 480 x 360; at 1920 x 1080?",
            (
                "pvs_images: image of 480 x 360 from the set, mean",
                "pvs_images: image of 480 x 360 from the set, worst image",
                "pvs_images: image of 1920 x 1080 from the set, mean",
                "pvs_images: image of 1920 x 1080 from the set, worst image",
            ),
            ours="{0:.1f}, {1:.1f} dB; {2:.1f}, {3:.1f}",
            peer="union of 27 viewpoints, 480 x 360: 54.8, 28.7 dB",
            target="≥ 45 dB, 40",
            page="sets",
        ),
        Row(
            "How good is the worst frame of a new walk, with 34% of showroom?",
            ("cut_unseen: around: worst frame", "cut_unseen: around: share of the Gaussians kept"),
            ours="{0:.1f} dB",
            peer="as many Gaussians nearest to the walk: 13.0 dB",
            target="≥ 45 dB with 40%",
            page="edit",
        ),
        Row(
            "How many bits does a store take for a visible Gaussian, and how long does `visible(cell)` take, cold?",
            (
                "visibility_store: bits for each (cell, visible Gaussian), without classes",
                "visibility_store: visible, cold",
            ),
            ours="{0:.2f} bits; {1:.2f} ms",
            peer="a roaring bitmap a cell: 4 times as many bits",
            page="sets",
        ),
        Row(
            "How long does it take to list all contributions of a ray?",
            ("raycast_contributions: contributions over list_intersections, showroom LOD 3 from inside",),
            ours="{0:.2f} times (0.37 by others, median of four eyes)",
            peer="Open3D's bare list of hits: 1",
            page="visibility",
        ),
        Row(
            "How long does a CPU frame of garden take, 648 x 420, forward, and with backward?",
            ("render_garden: garden, forward with projection", "render_garden: garden, forward plus backward"),
            ours="{0:.3f}, {1:.3f} s quiet; 0.084, 0.17 s busy",
            peer="OpenSplat: 0.71, 1.06 s (measured earlier)",
            target="≤ 0.071, 0.106 s",
            verdict="missed when busy",
            page="rasterizer",
        ),
        Row(
            "How fast is matching pursuit, and how long does a color fit of 1 M Gaussians take?",
            (
                "omp: signals per second over scikit-learn's",
                "color_fit: fit of 1M Gaussians, masked, two functions, 4 terms, refined",
            ),
            ours="{0:.0f} times; {1:.0f} s",
            peer="scikit-learn: 1",
            target="≥ 50; ≤ 120 s",
            page="color",
        ),
        Row(
            "How long do all colors for a new eye take?",
            ("color_evaluate: rgb, 4 terms: time for a new eye, over SH degree 3",),
            ours="{0:.2f} times",
            peer="SH of degree 3: 1",
            page="color",
        ),
    ),
)
