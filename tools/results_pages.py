"""What a page of results consists of, and which benchmarks each page of details shows."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["PAGES", "Page", "Row", "Section"]


@dataclass(frozen=True)
class Row:
    """One line of the summary.

    Attributes:
        question: What a reader asks.
        figures: "FILE: NAME" of the figures that answer, FILE without `.json`. Their targets and verdicts are used.
        ours: Template of our answer: {0} is the value of the first figure. Default: the value and its unit.
        peer: The best other answer, and whose it is.
        target: Overrides the target of the first figure.
        verdict: Overrides "reached" (every figure is) and "missed" (one figure is).
        page: The page with the details, for a row of the first table; below, the section names it.
    """

    question: str
    figures: tuple[str, ...] = ()
    ours: str = ""
    peer: str = ""
    target: str = ""
    verdict: str = ""
    page: str = ""


@dataclass(frozen=True)
class Section:
    """A table of the summary: a question, its rows, and the page with the details."""

    title: str
    page: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Page:
    """A page of details: its title and the benchmarks it shows, by the name of their JSON."""

    title: str
    benchmarks: tuple[str, ...]


PAGES = {
    "trust": Page(
        "Trust",
        (
            "fuzz",
            "fuzz_coverage",
            "kill",
            "server_soak",
            "stress",
            "check_repeated",
            "suite",
            "mutation",
            "lowest",
            "compare",
            "compare_planning",
            "chosen_eyes",
            "chosen_images",
            "upright",
            "judge_eyes",
            "same_anywhere",
        ),
    ),
    "install": Page("Installing and starting", ("install", "startup")),
    "formats": Page("Files", ("load_ply", "load_packed", "ksplat")),
    "visibility": Page(
        "What a view needs",
        (
            "visibility_cdf",
            "visibility_walk",
            "analyze_time",
            "raycast_build",
            "raycast_contributions",
            "raycast_scaling",
            "hpr_open3d",
        ),
    ),
    "rasterizer": Page("Rasterizer", ("render_garden", "render_large", "render_against_rays")),
    "sets": Page(
        "Visible sets",
        (
            "pvs_whole",
            "prepare",
            "pvs_build",
            "real_sizes",
            "look",
            "occlusion",
            "pvs_memory",
            "set_repairs",
            "large_units",
            "real_prepare",
            "pvs_quality",
            "pvs_images",
            "pvs_images_two_rooms",
            "pvs_images_box_in_room",
            "pvs_images_nika",
            "pvs_quality_nika",
            "certificate",
            "certificate_200",
            "flyaways",
            "shared_viewpoints",
            "visibility_store",
            "joined_sets",
            "one_cell",
            "hpr_hybrid",
        ),
    ),
    "color": Page(
        "Color in pieces",
        (
            "color_quality_flowers",
            "color_quality_nika",
            "color_held_out",
            "term_width",
            "term_width_loss",
            "record_parts",
            "rounded_records",
            "rounded_two_terms",
            "rounded_packages",
            "rounded_bonsai",
            "ten_bytes_nika",
            "ten_bytes_flowers",
            "color_fit",
            "omp",
            "color_evaluate",
            "color_epsilon",
            "color_activation",
            "color_figure15",
            "train_srbf",
            "learned_colors",
            "learned_colors_hsl",
            "learned_renders",
            "learned_worst",
            "train_srbf_spaces",
        ),
    ),
    "levels": Page(
        "Training and levels",
        (
            "train_photos",
            "train_resume",
            "levels_showroom",
            "levels_unseen",
            "levels_time",
            "levels_bonsai",
            "levels_bonsai_photos",
            "importance",
        ),
    ),
    "paper": Page(
        "What each departure from the paper is worth",
        ("paper_pieces", "paper_pieces_nika", "paper_pieces_bonsai", "paper_pieces_flowers", "paper_tables_bonsai"),
    ),
    "arena": Page("Systems that are trained on the same photographs", ("arena",)),
    "streaming": Page(
        "Streaming",
        (
            "streaming",
            "streaming_rivals",
            "streaming_rivals_recorded",
            "streaming_rivals_showroom",
            "abr_planning",
            "server_load",
            "server_processes",
            "opening",
            "world_walk",
            "world_walk_real",
            "stream_codec",
            "client_memory",
            "group_codec",
            "group_codec_flowers",
            "package_codec_showroom",
            "package_codec_nika",
            "disk_size",
            "client_ends",
            "nothing_withheld",
            "arriving",
            "package_edit_showroom",
            "package_edit_nika",
            "shaped_link",
            "first_second",
            "scaling",
        ),
    ),
    "world": Page(
        "Worlds",
        (
            "world_large",
            "world_large_one_copy",
            "world_large_sample",
            "world_district",
            "world_district_one_copy",
            "world_borders",
            "world_borders_far",
            "world",
            "world_whole",
            "world_estimate",
            "world_opening",
            "world_serving",
            "world_kills",
            "world_kills_large",
            "max_memory",
            "out_of_core",
            "clean_nine_copies",
            "clean_one_copy",
            "world_cluster",
        ),
    ),
    "edit": Page("Editing scenes", ("cut", "cut_unseen", "from_outside", "budget", "cell_overdraw", "clean")),
    "viewer": Page(
        "The viewer",
        (
            "viewer_load",
            "viewer_load_nika",
            "viewer_bytes",
            "viewer_draw",
            "splat_budget",
            "view_large",
            "static_seconds",
            "static_seconds_quiet",
            "static_seconds_glances",
            "static_rivals",
            "walls",
            "first_views",
            "static_site",
            "static_site_nika",
            "static_site_bonsai",
            "supersplat_settings",
            "static_order",
            "bare_site",
            "bare_order",
            "streamed_sog",
            "streamed_sog_nika",
            "level_choice",
            "level_choice_nika",
            "level_fill",
            "level_errors",
            "level_quality",
            "tiles",
            "tiles_valid",
        ),
    ),
}
