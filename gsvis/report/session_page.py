"""The report on simulated sessions as one self-contained HTML page: images inside, no script, no network."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any

from gsvis.abr.qoe import FIRST_FRAME_DB
from gsvis.report.html import Figure, figure, plain, report_page, table, tiles
from gsvis.report.session_document import Simulation
from gsvis.simulate.frames import CONTENT_DB
from gsvis.simulate.viewing import GOOD_DB
from gsvis.simulate.visits import WALKED, Visit

__all__ = ["PAPER_SENT", "content_remarks", "describe_eyes", "format_figures", "session_page"]

PAPER_SENT = {"gaussians": 0.8685, "terms_first": 0.0358, "terms": 0.2239}
"""SRBF-Gaussian, figure 13: shares sent after 30 s, and of the SRBFs at the start."""

Rows = list[tuple[str, ...]]
Format = Callable[[float], str]


def _megabytes(nbytes: float) -> str:
    return f"{nbytes / 1e6:.2f} MB"


_SECONDS = "{:.1f} s".format
_SHARE = "{:.1%}".format
_FIGURES: tuple[tuple[str, str, Format], ...] = (
    ("score", "QoE of a step", "{:.3f}".format),
    ("quality", "quality part", "{:.3f}".format),
    ("delay", "delay part", "{:.3f}".format),
    ("psnr", "PSNR, mean", "{:.1f} dB".format),
    ("latency", "latency, mean", "{:.3f} s".format),
    ("seconds_to_first_image", f"first image of {FIRST_FRAME_DB:g} dB", _SECONDS),
    ("seconds_to_good_image", f"first image of {GOOD_DB:g} dB", _SECONDS),
    ("stall", "stalled", _SECONDS),
    ("bytes", "arrived", _megabytes),
    ("filling_bytes", "of them on an idle link", _megabytes),
    ("records_twice", "records sent twice", "{:,}".format),
    ("gaussian_share", "Gaussians sent", _SHARE),
    ("replaced_share", "of them replaced since", _SHARE),
    ("unseen_share", "chosen, never seen", _SHARE),
    ("term_share", "SRBFs sent", _SHARE),
)
"""Rows of the table of figures: key in the document, label, and how to write the value."""
_LARGE_FIGURES: tuple[tuple[str, str, Format], ...] = (
    ("seconds_to_first_image", f"to a first image of {FIRST_FRAME_DB:g} dB", _SECONDS),
    ("seconds_to_good_image", f"to an image of {GOOD_DB:g} dB", _SECONDS),
    ("latency", "from a pose to its image, on average", "{:.3f} s".format),
    ("score", "quality of experience of a step", "{:.2f}".format),
)
"""The same for the large figures at the top of the page."""


def session_page(simulation: Simulation, document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the whole page.

    Args:
        simulation: The simulation.
        document: The content of `report.json`.
        figures: Plots and pictures by name.
    """
    return report_page(
        document["title"],
        document,
        lead=_lead(document),
        tiles=_tiles(document),
        sections={
            "The first seconds": _start(simulation, document, figures),
            "The whole session": _session(document, figures),
            "What was sent": _explain_sent(document, figures),
            "All figures": _tables(document),
            "What was assumed": _explain_assumptions(document),
        },
    )


def format_figures(systems: list[dict[str, Any]]) -> tuple[tuple[str, ...], Rows]:
    """Return header and rows of the table of a visit: one figure per row, one system per column; all text.

    Args:
        systems: Systems, as in the document.
    """
    figures = [system["figures"] for system in systems]
    missing = "nothing to see" if figures[0]["score"] is None else "never"
    rows: Rows = []
    for key, label, to_text in _FIGURES:
        if key == "term_share" and not any(each["terms"] for each in figures):
            continue
        values = (each[key] for each in figures)
        rows.append((label, *(missing if value is None else to_text(value) for value in values)))
    return ("", *(system["system"] for system in systems)), rows


def content_remarks(document: dict[str, Any]) -> list[str]:
    """Return warnings for visits whose figures say little, and remarks on their reference scenes; text."""
    return [remark for visit in document["visits"] for remark in _remarks_on(visit)]


def _remarks_on(visit: dict[str, Any]) -> list[str]:
    """Return the remarks on one visit: its reference, the path outside of cells, views that show nothing; text."""
    name = visit["scene"]["name"]
    remarks = []
    if visit["remark"]:
        remarks.append(f"{name}: {visit['remark']}.")
    share = visit["path"].get("in_cells")
    if share is not None and share < WALKED:
        remarks.append(
            f"Warning: only {share:.0%} of the path lies in cells of {name}; elsewhere what is sent first is a guess."
            " Prepare it with --path, --cameras or --box if people stand there."
        )
    judged = visit["scene"].get("judged")
    if judged and judged["warning"]:
        remarks.append(f"{name} was prepared with a warning. {judged['warning']}")
    count = visit["views"]["compared"]
    with_content = visit["views"]["with_content"]
    if with_content == 0:
        remarks.append(
            f"The path sees nothing of {name} in any of {count:,} views: there is nothing to compare."
            " Is the path in the frame of the scene?"
        )
    elif with_content < count:
        remarks.append(f"{count - with_content:,} of {count:,} views show nothing of {name} and count in no figure.")
    return remarks


def describe_eyes(visit: dict[str, Any]) -> str:
    """Return which share of a path lies in cells, and which share of the judge's eyes; text, empty if unknown."""
    share = visit["path"].get("in_cells")
    if share is None:
        return ""
    judged = visit["scene"].get("judged")
    of_judges = None if judged is None else judged["eyes_in_cells"]
    also = "" if of_judges is None else f", and {of_judges:.0%} of the eyes that judged it"
    return f"{share:.0%} of the path lies in cells of {visit['scene']['name']}{also}."


def _lead(document: dict[str, Any]) -> str:
    """Return the first paragraph: scene, link, systems and remarks."""
    remarks = "".join(f"<p class='lead'><strong>{escape(remark)}</strong></p>" for remark in content_remarks(document))
    link = document["link"]
    config = document["config"]
    visits = document["visits"]
    first = visits[0]["systems"]
    others = " and ".join(escape(s["system"]) for s in first[1:])
    versus = f", beside {others}" if others else ""
    seconds = f"{config['seconds']:g} s"
    many = f" for {seconds}," if len(visits) == 1 else f" through {len(visits)} scenes, {seconds} in each,"
    return (
        f"<p class='lead'>A viewer follows {escape(document['walk'])}{many} while {escape(first[0]['system'])} sends"
        f" the scene over {escape(link['kind'])} of {link['mean_mbit_per_s']:.1f} Mbit/s on average{versus}. What each"
        f" client holds is drawn and compared with {_reference_of(visits)}.</p>{remarks}"
    )


def _reference_of(visits: list[dict[str, Any]]) -> str:
    """Return what clients are compared with, in a few words."""
    named = " or ".join(sorted({visit["against"] for visit in visits if visit["against"]}))
    if not named:
        return "the scene from which the package was made"
    if all(visit["against"] for visit in visits):
        return f"<strong>{escape(named)}</strong>, which hides what its making cost"
    return f"the scene, or <strong>with {escape(named)}</strong> where the title says so"


def _tiles(document: dict[str, Any]) -> str:
    """Return the row of large figures; empty if no view shows anything."""
    systems = next((v["systems"] for v in document["visits"] if v["views"]["with_content"]), None)
    if systems is None:
        return ""
    shown = []
    for key, label, to_text in _LARGE_FIGURES:
        ours, *others = (_or_never(system["figures"][key], to_text) for system in systems)
        names = (system["system"] for system in systems[1:])
        comparison = "; ".join(f"{name}: {value}" for name, value in zip(names, others, strict=True))
        shown.append((ours, label, comparison))
    return tiles(shown)


def _or_never(value: float | None, to_text: Format) -> str:
    return "never" if value is None else to_text(value)


def _start(simulation: Simulation, document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section on the first seconds."""
    step = document["config"]["tick"]
    caption = f"PSNR of what is shown against the full scene, measured every {1000 * step:.0f} ms."
    text = figure(figures.get("start"), "PSNR in the first seconds", caption)
    for v, visit in enumerate(simulation.visits):
        text += _pictures(v, visit, figures)
    return text


def _pictures(v: int, visit: Visit, figures: dict[str, Figure]) -> str:
    """Return what each system shows at a few moments of a visit."""
    names = ["", *(session.playback.name for session in visit.sessions)]
    text = ""
    for t in sorted({t for t, _, _ in visit.pictures}):
        drawn = ""
        for k, name in enumerate(names):
            found = figures.get(f"shown_{v}_{round(1000 * t)}_{k}")
            if found is None:
                continue
            label = "The full scene." if not name else f"{name}: {_quality_at(visit, k - 1, t)}."
            drawn += figure(found, label, escape(label))
        text += f"<h3>{escape(visit.title)} after {t:g} s</h3><div class='pair'>{drawn}</div>"
    return text


def _quality_at(visit: Visit, which: int, t: float) -> str:
    """Return the PSNR of a session at time `t` in words."""
    session = visit.sessions[which]
    k = int((session.times <= t + 1e-9).sum()) - 1
    if not session.content[k]:
        return "nothing to see here"
    if session.psnr[k] <= 0.0:
        return "no image yet"
    best = session.config.qoe.psnr_scale
    return f"at least {best:g} dB" if session.psnr[k] >= best else f"{session.psnr[k]:.1f} dB"


def _session(document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section with the paper's figures 9 to 12 over time."""
    qoe = document["config"]["qoe"]
    score = (
        f"QoE of each step (figure 9 of the paper): PSNR / {qoe['psnr_scale']:g} dB less {qoe['delay_weight']:g} times"
        f" latency / {qoe['latency_scale']:g} s, both at most 1."
    )
    psnr = f"PSNR of what is shown (figure 10), at most {qoe['psnr_scale']:g} dB; 0 where there is no image yet."
    latency = f"Time from a pose until it is shown at {qoe['shown_db']:g} dB (figure 11)."
    link = f"Rate of the link (figure 12): {escape(document['link']['trace'])}."
    return (
        figure(figures.get("qoe"), "QoE over time", score)
        + figure(figures.get("psnr"), "PSNR over time", psnr)
        + figure(figures.get("latency"), "Latency over time", latency)
        + figure(figures.get("bandwidth"), "Bandwidth over time", link)
    )


def _explain_sent(document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section on shares and bytes that have arrived, figures 13 and 14."""
    ours = document["visits"][0]["systems"][0]["system"]
    shares = (
        f"Shares of the Gaussians, of all levels together, and of the SRBFs that {escape(ours)} has sent (figure 13)."
        f" The paper's are {PAPER_SENT['gaussians']:.2%} and {PAPER_SENT['terms']:.2%} after 30 s."
    )
    nbytes = "Megabytes that have arrived (figure 14)."
    return (
        "<div class='pair'>"
        + figure(figures.get("shares"), "Shares sent over time", shares)
        + figure(figures.get("bytes"), "Megabytes over time", nbytes)
        + "</div>"
    )


def _explain_world(name: str, scene: dict[str, Any]) -> str:
    """Return what the systems mean for a world; nothing for a package."""
    if "tiles" not in scene:
        return ""
    tiles = scene["tiles"]
    districts = scene["districts"]
    text = f"{name} is a world of {tiles:,} tile{'s' * (tiles != 1)}. The other systems send the highest level of all"
    text += " tiles, as one file or along one curve."
    if districts:
        text += f" gsvis alone sends districts, which stand for tiles from afar: cells see {districts:,}."
    return f"<li>{text}</li>"


def _tables(document: dict[str, Any]) -> str:
    """Return a table of figures for each visit."""
    text = ""
    for visit in document["visits"]:
        header, rows = format_figures(visit["systems"])
        text += f"<h3>{escape(visit['title'])}</h3>"
        text += table([escape(cell) for cell in header], [[escape(cell) for cell in row] for row in rows])
    return text


def _explain_assumptions(document: dict[str, Any]) -> str:
    """Return the list of what the simulation assumes."""
    config = document["config"]
    link = document["link"]
    text = (
        "<ul>"
        f"<li>The link has a round trip of {1000 * link['round_trip']:g} ms and loses nothing; time begins when the"
        " client requests the scene, on an open connection.</li>"
        f"<li>The client sends its pose every {1000 * config['tick']:g} ms and confirms what arrives. Arrived data is"
        " drawn at once: time to decode and to draw is not counted.</li>"
        f"<li>Images have {config['width']} x {config['height']} pixels and a field of view of {config['fov']:g}°, and"
        f" are compared every {1000 * config['tick']:g} ms for {config['fine']:g} s, then every {config['every']:g} s;"
        " each stands for the time until the next.</li>"
        f"<li>A view counts if it shows something: if black is worse than {CONTENT_DB:g} dB against the full scene."
        " Otherwise black would pass for an image; curves have a gap there.</li>"
    )
    for visit in document["visits"]:
        name = escape(visit["scene"]["name"])
        text += f"<li>{name}: the full scene is {escape(visit['compared_with'])}."
        text += f" {escape(describe_eyes(visit))}"
        if "rule" in visit["path"]:
            text += f" Its path: {escape(str(visit['path']['rule']))}."
        text += f"</li>{_explain_world(name, visit['scene'])}"
    rows = []
    for system in document["visits"][0]["systems"]:
        for key, value in system["about"].items():
            rows.append((escape(system["system"]), escape(key), escape(plain(value))))
    return text + "</ul>" + table(("system", "", ""), rows)
