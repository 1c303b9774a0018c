"""Hooks of mkdocs: links that leave docs/ become file names, and two pages of the repository join the site."""

from __future__ import annotations

import os
import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
}  # page of the site: file of the repository
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Return the text of a page as the site shows it.

    Args:
        markdown: Text of the file.
        page: The page; `page.file.src_uri` is its path below docs/.
        config: Not used.
        files: Not used.
    """
    source = page.file.src_uri
    folder = posixpath.join("docs", posixpath.dirname(source))
    if source in PAGES:
        markdown, folder = (ROOT / PAGES[source]).read_text(encoding="utf-8"), ""
    if source == "design/index.md":
        markdown += list_new_notes(markdown)
    return _LINK.sub(lambda found: shown_link(found, folder, posixpath.dirname(source)), markdown)


def list_new_notes(index: str) -> str:
    """Return a table of the design notes that the index does not list yet, or nothing."""
    rows = []
    for path in sorted((ROOT / "docs" / "design").glob("[0-9]*.md")):
        if f"({path.name})" not in index:
            title = path.read_text(encoding="utf-8").splitlines()[0].partition(":")[2].strip()
            rows.append(f"| [{path.name[:3]}]({path.name}) | {title[:1].upper()}{title[1:]} |")
    return "\n".join(["", "## What is new?", "", "| note | decision |", "|---|---|", *rows, ""]) if rows else ""


def shown_link(found: re.Match[str], folder: str, place: str) -> str:
    """Return a link as the site shows it: pages of the site stay links, other files of the repository become names.

    Args:
        found: A match of a Markdown link.
        folder: Folder that the target is relative to, from the root of the repository.
        place: Folder of the page in docs/.
    """
    image, text, target = found.groups()
    path, hash_sign, anchor = target.partition("#")
    if "://" in target or not path:
        return found[0]
    whole = posixpath.normpath(posixpath.join(folder, path))
    inside = next((page for page, name in PAGES.items() if name == whole), None)
    if inside is None and whole.startswith("docs/") and (ROOT / whole).is_file() and not whole.endswith(".json"):
        inside = whole.removeprefix("docs/")
    if whole == "docs/design":
        inside = "design/index.md"
    if inside is not None:
        return f"{image}[{text}]({os.path.relpath(inside, place or '.')}{hash_sign}{anchor})"
    name = text.strip("`")
    return f"`{whole}`" if whole.endswith(name) else f"{text} (`{whole}`)"
