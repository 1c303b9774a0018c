"""The files of tests that take longest, in their order: workers begin with them, so that none is left alone with one.

Seconds of the processor, processes and browsers included, as `tools/suite_time.py` measures them.
"""

from __future__ import annotations

__all__ = ["LONGEST"]

LONGEST = (
    "cli/test_extras.py",
    "cli/test_color.py",
    "cli/test_levels.py",
    "cli/test_pvs.py",
    "cli/test_clean.py",
    "test_tutorials.py",
    "viewer/test_page.py",
    "cli/test_full_disk.py",
    "cli/test_twice.py",
    "benchmarks/test_rasterize_before.py",
    "serve/test_processes.py",
    "cli/test_where.py",
    "viewer/test_stream_client.py",
    "raycast/test_known_scenes.py",
    "abr/test_filling.py",
    "benchmarks/test_honest.py",
    "prepare/test_prepare.py",
    "viewer/test_picture.py",
    "pvs/test_build.py",
    "cli/test_serve.py",
    "serve/test_shaped.py",
    "viewer/test_shipped_page.py",
    "fuzz/test_fuzz.py",
    "pvs/test_store.py",
    "hpr/test_gaussians.py",
    "cli/test_process.py",
    "color/test_omp.py",
    "color/test_fit.py",
    "viewer/test_bad_input.py",
    "pvs/test_cell_view.py",
    "edit/test_cleaning.py",
    "cli/test_commands.py",
    "cli/test_world.py",
    "render/test_reference.py",
    "io/test_eyenav.py",
    "edit/test_large.py",
    "scene/test_kinds.py",
    "render/test_real.py",
    "cli/test_view.py",
    "pvs/test_levels.py",
    "pvs/test_cluster.py",
    "cli/test_prepare.py",
    "scene/test_navigable.py",
    "pvs/test_estimate.py",
    "cli/test_targets.py",
    "report/test_pvs_report.py",
)
"""Names below tests/; of files that take more than five seconds."""
