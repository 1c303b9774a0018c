"""Build the parts of a report page: its style, pictures with captions, tables.

Text from outside is escaped here or by the caller, as each function states.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from gsvis._extras import remedy_of
from gsvis._text import as_json, as_text

__all__ = [
    "Figure",
    "describe_judged",
    "figure",
    "plain",
    "report_page",
    "table",
    "tiles",
    "where_figure",
    "where_part",
]


@dataclass(frozen=True, eq=False)
class Figure:
    """A picture of a report.

    Attributes:
        file: File name.
        light: PNG bytes, for light pages and on disk.
        dark: PNG bytes for dark pages; None if one serves both.
    """

    file: str
    light: bytes
    dark: bytes | None = None


def report_page(
    title: str, document: Mapping[str, Any], *, lead: str, tiles: str, sections: Mapping[str, str], how: str = ""
) -> str:
    """Return the page of a report: a title, the main finding, its largest figures, sections, and how it was made.

    Args:
        title: Title; text.
        document: The content of `report.json`.
        lead: The finding; HTML.
        tiles: Items of the list of large figures; HTML.
        sections: Content of each section by its heading; HTML. Empty ones are left out.
        how: More on how the report was made; HTML.
    """
    here = files("gsvis.report")
    parts = {**sections, "How this was made": _describe_run(document) + how}
    page = Template((here / "page.html").read_text(encoding="utf-8")).substitute(
        style=(here / "page.css").read_text(encoding="utf-8"),
        title=escape(title),
        version=escape(document["gsvis"]),
        lead=lead,
        tiles=tiles,
        sections="\n".join(f"<section><h2>{name}</h2>{part}</section>" for name, part in parts.items() if part),
    )
    return as_text(page)  # names of files may hold characters that no page may hold


def figure(figure: Figure | None, alternative: str, caption: str) -> str:
    """Return a picture with its caption, or the reason why it is missing.

    Args:
        figure: The picture; None where matplotlib is missing, which draws plots.
        alternative: What is shown instead of the picture; text.
        caption: HTML.
    """
    if figure is None:
        text = f"Not drawn: {alternative}. Plots need matplotlib: {remedy_of('matplotlib')}."
        return f"<figure><p>{escape(text)}</p><figcaption>{caption}</figcaption></figure>"
    image = f"<img src='{_data(figure.light)}' alt='{escape(alternative, quote=True)}'>"
    if figure.dark is not None:
        source = f"<source srcset='{_data(figure.dark)}' media='(prefers-color-scheme: dark)'>"
        image = f"<picture>{source}{image}</picture>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def where_figure(png: bytes | None) -> Figure | None:
    """Return the figure of where people stand, of PNG bytes; None without them."""
    return None if png is None else Figure("where.png", png)


def where_part(shown: Figure | None) -> str:
    """Return the picture of where people stand with its caption; empty without a picture."""
    if shown is None:
        return ""
    caption = "What was taken for what, the first view, and a plan with some of the eyes."
    return figure(shown, "The first view and a plan with eyes", caption)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table; its cells are HTML. The first column names the row."""
    head = "".join(f"<th scope='col'>{cell}</th>" for cell in header)
    body = "".join(
        f"<tr><th scope='row'>{row[0]}</th>" + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>" for row in rows
    )
    return f"<div class='wide'><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def tiles(found: Sequence[tuple[str, str, str]]) -> str:
    """Return the list of large figures: value, meaning, comparison; all text."""
    return "".join(
        f"<li><strong>{escape(value)}</strong><span>{escape(label)}</span><small>{escape(comparison)}</small></li>"
        for value, label, comparison in found
    )


def describe_judged(judged: dict[str, Any] | None) -> str:
    """Return what eyes see that navigable space did not choose, with the warning; empty where it was not checked.

    Args:
        judged: Entry "judged" of a document.
    """
    if judged is None:
        return ""
    warning = f"<p><strong>{escape(judged['warning'])}</strong></p>" if judged["warning"] else ""
    return f"{warning}<p>Checked by eyes that navigable space did not choose: {escape(judged['line'])}.</p>"


def _describe_run(document: Mapping[str, Any]) -> str:
    """Return how a report was made: its command and parameters."""
    shown = [(name, plain(value)) for name, value in document["parameters"].items()]
    return (
        f"<pre><code>{escape(document['command'])}</code></pre>"
        + table(("parameter", "value"), [(escape(name), escape(value)) for name, value in shown])
        + f"<p>gsvis {escape(document['gsvis'])}. All figures are in <code>report.json</code> beside this page,"
        + " the time that each stage took in <code>timings.json</code>.</p>"
    )


def plain(value: Any) -> str:
    """Return the value of a parameter as text."""
    return value if isinstance(value, str) else as_json(value)


def _data(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
