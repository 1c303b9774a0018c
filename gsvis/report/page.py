"""The report as one self-contained HTML page: images inside, no script, no network, light and dark."""

from __future__ import annotations

from html import escape
from typing import Any

from gsvis.raycast.analysis import PAPER, Analysis, DirectionCdf
from gsvis.raycast.second_tracer import describe_check
from gsvis.report.html import Figure, describe_judged, figure, report_page, table, tiles, where_part

__all__ = ["page"]

_AGAIN = (
    "<p>All cameras are in <code>report.json</code>. To render the first of them again, identical in every pixel:"
    " <code>gsvis render SCENE --cameras report.json --index 0 -o view.png</code>. To compute all figures of all views"
    " again: <code>gsvis analyze SCENE --cameras report.json -o again</code>.</p>"
)
_ROLES = {"most": "most", "median": "the median share", "least": "least"}


def page(analysis: Analysis, document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the whole page.

    Args:
        analysis: The figures.
        document: The content of `report.json`.
        figures: Plots, maps and pictures by name.
    """
    differs = document["paper"]["differs"] or ""
    return report_page(
        f"Visibility of {document['scene']['name']}",
        document,
        lead=_lead(analysis, document),
        tiles=_tiles(analysis, differs),
        sections={
            "What a view needs": _visible(analysis, figures, differs, document["judged"]),
            "Three views": _views(analysis, figures),
            "From which directions Gaussians are seen": _directions(analysis, figures, differs),
            "Where people stand": where_part(figures.get("where")),
            "The scene": _scene(analysis, document["scene"]),
        },
        how=_AGAIN,
    )


def _lead(analysis: Analysis, document: dict[str, Any]) -> str:
    """Return the first paragraph: the mean visible share of a view."""
    mean = float(analysis.visible_fractions.mean())
    return (
        f"<p class='lead'>One view of this scene needs {mean:.1%} of its {analysis.gaussians:,} Gaussians on average."
        f" Found by ray casting from {len(analysis.cameras):,} cameras {escape(document['cameras_from'])},"
        f" {_rays(analysis)}.</p>"
    )


def _rays(analysis: Analysis) -> str:
    """Return the pixels and the field of view of a view in words."""
    low, high = analysis.field_of_view
    angle = f"{low:.0f}°" if high - low < 0.5 else f"{low:.0f}° to {high:.0f}°"
    return f"{analysis.cameras.width} x {analysis.cameras.height} pixel rays a view, horizontal field of view {angle}"


def _tiles(analysis: Analysis, differs: str) -> str:
    """Return the row of large figures."""
    fractions = analysis.visible_fractions
    beside = "" if differs else f"paper: {PAPER['mean_visible']:.2%}"
    shown = [
        (f"{fractions.mean():.1%}", "visible in a view, on average", beside),
        (f"{analysis.gathered.seen / analysis.gaussians:.1%}", "seen by at least one of the cameras", ""),
    ]
    for faces, limit, published in ((33, "41.25%", "below_33_faces"), (48, "60%", "below_48_faces")):
        more = [] if differs else [f"paper: {PAPER[published]:.1%}"]
        if analysis.traced is not None:
            value = analysis.below_solid_angle(faces / 80.0)
            text = f"seen from less than {limit} of the sphere"
            more.insert(0, f"by faces that a ray sees: {analysis.traced.below(faces):.1%}")
        elif analysis.has_settled:
            value = analysis.gathered.below(faces)
            text = f"seen from less than {limit} of the 80 directions, by {len(analysis.cameras):,} cameras"
        else:
            continue  # the number would be one of cameras
        shown.append((f"{value:.1%}", text, "; ".join(more)))
    return tiles(shown)


def _explain_paper(differs: str) -> str:
    """Return why the paper's figures are not shown beside these."""
    return (
        f"<p>The paper's figures ({PAPER['mean_visible']:.2%} visible in a view on average) are means over the training"
        f" views of Tanks &amp; Temples. They do not compare with these: {escape(differs)}.</p>"
    )


def _visible(analysis: Analysis, figures: dict[str, Figure], differs: str, judged: dict[str, Any] | None) -> str:
    """Return the section on the share that a view sees."""
    fractions = analysis.visible_fractions
    rows = [
        ("mean of the cameras", f"{fractions.mean():.2%}", f"{PAPER['mean_visible']:.2%}"),
        ("smallest", f"{fractions.min():.2%}", ""),
        ("largest", f"{fractions.max():.2%}", ""),
        ("one view, the paper's figure 1", "", f"{PAPER['one_view_visible']:.2%}"),
    ]
    shown = 2 if differs else 3  # columns; the paper's is the last
    listed_rows = [row[:shown] for row in (rows[:3] if differs else rows)]
    caption = f"Each camera's share of all {analysis.gaussians:,} Gaussians that is visible in it, highest first. " + (
        "The dashed line is the mean."
        if differs
        else "The dashed lines are the mean here and the paper's mean over the training views of Tanks &amp; Temples."
    )
    return (
        figure(figures["visible"], "Visible share of each camera, sorted", caption)
        + table(("visible share", "here", "paper")[:shown], listed_rows)
        + describe_judged(judged)
        + f"<p>A Gaussian is visible in a view when its largest weight on a pixel ray (alpha times the light left in"
        f" front of it) is at least {analysis.config.tau:.4g}. Gaussians that fall between the rays do not count, so"
        f" these shares belong to {_rays(analysis)}; more pixels or a wider view find more.</p>"
        + (_explain_paper(differs) if differs else "")
    )


def _views(analysis: Analysis, figures: dict[str, Figure]) -> str:
    """Return the section with pictures of views."""
    parts = []
    order = sorted(range(len(analysis.cameras)), key=lambda i: -int(analysis.visible[i]))
    places = {"most": order[0], "median": order[len(order) // 2], "least": order[-1]}
    for role, index in places.items():
        if f"view_{role}" not in figures:
            continue
        name = escape(analysis.cameras.names[index])
        share = f"{analysis.visible_fractions[index]:.2%}"
        seen = (
            f"Camera {name} needs {_ROLES[role]} of the scene: {analysis.visible[index]:,} Gaussians, {share}."
            " Every pixel is the sum of what its ray meets."
        )
        above = (
            "The same from above: the wedge is the camera's field of view, colored is what it sees, gray what is"
            " hidden from it or outside its view."
        )
        parts.append(
            "<div class='pair'>"
            + figure(figures[f"view_{role}"], f"What camera {name} sees", seen)
            + figure(figures[f"map_{role}"], f"Map of what camera {name} sees", above)
            + "</div>"
        )
    return "".join(parts)


def _directions(analysis: Analysis, figures: dict[str, Figure], differs: str) -> str:
    """Return the section on the directions from which Gaussians are seen."""
    gathered = analysis.gathered
    traced = analysis.traced
    count = f"{len(analysis.cameras):,} cameras"
    header = ["Gaussians seen from less than"]
    header += ["by solid angle", "faces that a ray sees", "the same, of seen"] if traced else []
    header += [f"faces that {count} saw", "the same, of seen"] if analysis.has_settled else []
    header += [] if differs else ["paper"]
    rows = []
    for faces, limit, published in ((33, "41.25%", "below_33_faces"), (48, "60%", "below_48_faces")):
        row = [f"{limit} of directions (fewer than {faces} of 80 faces)"]
        if traced:
            row += [f"{analysis.below_solid_angle(faces / 80.0):.1%}", *_both(traced, faces)]
        row += _both(gathered, faces) if analysis.has_settled else []
        rows.append(row if differs else [*row, f"{PAPER[published]:.1%}"])
    caption = (
        "For every share of the 80 directions, how many Gaussians are seen from less than that. Solid lines count all"
        " Gaussians, dashed ones those that are seen at all."
    )
    if traced:
        caption += (
            " A face counts as soon as anything in it sees the Gaussian, so more cameras or rays only ever add faces."
            " The dotted line weighs each ray by the solid angle it stands for; that one settles."
        )
    if not differs:
        caption += " Diamonds are the two points that the paper states."
    text = figure(figures["cdf"], "Cumulative distribution of the directions from which Gaussians are seen", caption)
    if traced or analysis.has_settled:
        text += table(header, rows)
    text += _explain_settling(analysis, figures)
    if traced is None:
        return text + f"<p>Directions were not traced outward: {escape(analysis.untraced_because)}.</p>"
    caption = (
        f"The {len(analysis.sample):,} traced Gaussians from above. Dark ones can be seen from few directions: they lie"
        " on walls, floors and behind things. Bright ones stand free."
    )
    return text + figure(figures["map_directions"], "Map of directions", caption) + _explain_agreement(analysis)


def _both(cdf: DirectionCdf, faces: int) -> list[str]:
    return [f"{cdf.below(faces):.1%}", f"{cdf.below(faces, of_seen=True):.1%}"]


def _explain_settling(analysis: Analysis, figures: dict[str, Figure]) -> str:
    """Return a paragraph on whether more cameras would change the curve of directions."""
    count = len(analysis.cameras)
    change = analysis.settling[-1].change
    if analysis.has_settled:
        verdict = "What the cameras saw has settled"
        detail = f"twice the cameras moved no point of the curve by more than {change:.1%}."
    else:
        verdict = "What the cameras saw has not settled"
        detail = "" if change is None else f"The second half of the cameras moved the curve by up to {change:.1%}. "
        detail += (
            "Each camera adds at most one of the 80 faces to what a Gaussian is seen from. The curve counts as settled"
            " when, with at least 160 cameras, the second half of them moves no point by 2%. Until then it lies too"
            f" high, and {count:,} cameras are too few. Many small views settle it sooner than a few large ones"
        )
        detail += "; tracing outward needs none." if analysis.traced else "."
    rows = [
        (
            f"{step.cameras:,}",
            f"{step.seen / analysis.gaussians:.1%}",
            f"{step.below_33_of_all:.1%}",
            f"{step.below_48_of_all:.1%}",
            f"{step.below_33_of_seen:.1%}",
            f"{step.below_48_of_seen:.1%}",
            "" if step.change is None else f"{step.change:.1%}",
        )
        for step in analysis.settling
    ]
    header = ("cameras", "seen at all", "&lt; 41.25%", "&lt; 60%", "&lt; 41.25%, of seen", "&lt; 60%, of seen", "moved")
    caption = (
        "The gathered shares after the first 1/8, 1/4, 1/2 and all of the cameras, taken in random order."
        " In the table, moved is the largest change of the curve since the step before."
    )
    drawn = "settling" in figures
    return (
        f"<h3>Has it settled?</h3><p><strong>{verdict}.</strong> {detail[:1].upper()}{detail[1:]}</p>"
        + (figure(figures["settling"], "Gathered shares by number of cameras", caption) if drawn else "")
        + table(header, rows)
    )


def _explain_agreement(analysis: Analysis) -> str:
    """Return a paragraph that compares gathered with traced direction sets."""
    found = analysis.agreement
    if found is None:
        return ""
    rows = [
        ("mean Jaccard index over the sample", f"{found.mean_jaccard:.3f}"),
        ("the same over Gaussians seen either way", f"{found.mean_jaccard_of_seen:.3f}"),
        ("faces gathered from cameras that tracing found too", f"{found.gathered_confirmed:.1%}"),
        ("faces traced outward that the cameras had seen too", f"{found.traced_confirmed:.1%}"),
    ]
    return (
        "<h3>Two ways, one answer?</h3><p>Cameras see a Gaussian from where they happen to stand. Tracing outward asks,"
        f" for {len(analysis.sample):,} Gaussians drawn at random, whether an eye anywhere in navigable space would see"
        f" it, on {analysis.config.rays_per_face} rays over each of the 80 faces. A face counts when one of them finds"
        " an eye, so more rays find more faces and the shares fall. The two agree where cameras are dense.</p>"
        + table(("agreement", "here"), rows)
    )


def _scene(analysis: Analysis, scene: dict[str, Any]) -> str:
    """Return the section on the scene and its origin."""
    rows = [("Gaussians", f"{analysis.gaussians:,}"), ("opacity of at least 1/255", f"{analysis.opaque_enough:,}")]
    if analysis.config.checked_rays:
        rows.append(("two tracers, gsvis and Open3D's Embree, agree", describe_check(analysis.check)))
    if "sh_degree" in scene:
        low, high = scene["robust_bounds"]
        size = " x ".join(f"{b - a:.3g}" for a, b in zip(low, high, strict=True))
        rows += [
            ("SH degree", str(scene["sh_degree"])),
            ("size of the middle 98%", f"{size} scene units"),
            ("likely up axis", f"{scene['up']}, confidence {scene['up_confidence']:.0%}"),
        ]
    problems = scene.get("problems", [])
    listed = "".join(f"<li>{escape(problem)}</li>" for problem in problems)
    return table(("scene", ""), rows) + (f"<p>Possible problems:</p><ul>{listed}</ul>" if listed else "")
