"""What a publisher sets of an exported page: title, pictures, colors, settings, and who may speak with it in a frame.

All of it goes into elements of the page's head and into files beside it; nothing of the scene changes.
"""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any

from gsvis.errors import FormatError
from gsvis.files.limits import read_whole
from gsvis.files.origins import parse_origins

__all__ = ["LANGUAGES", "PageOptions", "accents", "check_page", "contrast", "read_settings"]

_PICTURES = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}
_COLOR = re.compile(r"#[0-9a-fA-F]{6}")
_PANELS = {"dark": "#15181d", "light": "#ffffff"}  # of page.css
_INKS = ("#07152b", "#ffffff")  # of text on the accent
_CONTRAST = 4.5  # least of text, as in WCAG 2.2

LANGUAGES = ("en", "de")
"""Languages that the page speaks: files of `viewer/src/page/words`."""

Path_ = str | PathLike[str]
RGB = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """How an exported page presents a scene.

    Attributes:
        title: Title of the page and of its preview in other pages; None takes the name of the scene.
        settings: A `settings.json` of SuperSplat or of this page: views, hotspots, paths, background.
        poster: A picture that is shown until the scene is drawn.
        backdrop: Color behind the scene, such as "#20242c"; None takes that of the settings or of the theme.
        og_image: A picture for previews in other pages: a file, or the address of one.
        accent: Color of the controls, such as "#d4380d"; made lighter or darker until text in it can be read.
        visitor: Leave out what is for engineers: Inspect, counts, levels, cells.
        language: Language of the page, one of `LANGUAGES`; None takes that of each visitor's browser.
        embedders: Origins whose pages may read the picture in a frame, such as "https://blog.example"; "*" is all.
    """

    title: str | None = None
    settings: Path_ | None = None
    poster: Path_ | None = None
    backdrop: str | None = None
    og_image: Path_ | None = None
    accent: str | None = None
    visitor: bool = False
    language: str | None = None
    embedders: Sequence[str] = ()

    def metas(self) -> dict[str, str]:
        """Return what the page reads of this, by the names of `meta` elements."""
        found = {
            "gsvis-title": self.title,
            "gsvis-background": self.backdrop,
            "gsvis-accent": None if self.accent is None else " ".join(accents(self.accent)),
            "gsvis-visitor": "true" if self.visitor else None,
            "gsvis-language": self.language,
            "gsvis-embedders": " ".join(self.embedders),
        }
        return {name: text for name, text in found.items() if text}

    def pictures(self) -> Iterator[tuple[str, bytes]]:
        """Yield the names and bytes of the files that lie beside the page of a site."""
        for name, path in (("poster", self.poster), ("preview", self.og_image)):
            if path is not None and not _is_address(path):
                yield name + Path(path).suffix.lower(), read_whole(Path(path))

    def preview(self, name: str) -> list[str]:
        """Return elements that say to other pages how to show a link to this one; see https://ogp.me.

        Args:
            name: Name of the scene.
        """
        tags = {"og:type": "website", "og:title": self.title or name}
        if self.og_image is not None:
            is_address = _is_address(self.og_image)
            tags["og:image"] = str(self.og_image) if is_address else "preview" + Path(self.og_image).suffix.lower()
        lines = [f'<meta property="{key}" content="{escape(text)}">' for key, text in tags.items()]
        card = "summary_large_image" if self.og_image is not None else "summary"
        return [*lines, f'<meta name="twitter:card" content="{card}">']

    def poster_element(self, inside: bool) -> str:
        """Return the element of the poster, "" without one.

        Args:
            inside: Whether the page holds its picture itself, as a page in one file does.
        """
        if self.poster is None:
            return ""
        suffix = Path(self.poster).suffix.lower()
        source = "poster" + suffix
        if inside:
            source = f"data:{_PICTURES[suffix]};base64," + b64encode(read_whole(Path(self.poster))).decode()
        return f'<img class="poster" src="{source}" alt="">'


def check_page(page: PageOptions) -> None:
    """Raise unless the options of a page can be used: colors, pictures, settings, language and origins.

    Raises:
        ValueError: If a color, a picture, a language or an origin is none.
        FormatError: If the settings are none.
        OSError: If a file cannot be read.
    """
    for name, color in (("--backdrop", page.backdrop), ("--accent", page.accent)):
        if color is not None and not _COLOR.fullmatch(color):
            raise ValueError(f"{name}: expected a color such as #20242c, got {color[:100]!r}")
    for name, path in (("--poster", page.poster), ("--og-image", page.og_image)):
        if path is None or (name == "--og-image" and _is_address(path)):
            continue
        if Path(path).suffix.lower() not in _PICTURES:
            raise ValueError(f"{name}: expected a picture ({', '.join(_PICTURES)}), got {path}")
        read_whole(Path(path))
    if page.language is not None and page.language not in LANGUAGES:
        raise ValueError(f"--language: expected one of {', '.join(LANGUAGES)}, got {page.language[:100]!r}")
    if "*" not in page.embedders:
        parse_origins("--embedders", page.embedders)
    if page.settings is not None:
        read_settings(Path(page.settings))


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings in a file.

    Raises:
        FormatError: If it is no JSON object of version 1 or 2.
        OSError: If it cannot be read.
    """
    try:
        said = json.loads(read_whole(path))
    except (ValueError, RecursionError) as error:
        raise FormatError(path, "settings", "JSON", str(error)) from None
    if not isinstance(said, dict) or said.get("version", 1) not in (1, 2):
        got = f"version {said['version']!r}"[:100] if isinstance(said, dict) else type(said).__name__
        raise FormatError(path, "settings", "a JSON object of version 1 or 2", got)
    return said


def accents(color: str) -> tuple[str, str, str, str]:
    """Return the accent and the ink on it for the dark theme, and the same for the light one.

    The accent is mixed with white or black until it stands out of the panels of its theme.

    Args:
        color: Such as "#d4380d".

    Examples:
        >>> accents("#7db0ff")[:2]
        ('#7db0ff', '#07152b')
    """
    dark, light = (_readable(_rgb(color), theme) for theme in ("dark", "light"))
    return _hex(dark), _ink(dark), _hex(light), _ink(light)


def _readable(color: RGB, theme: str) -> RGB:
    """Return a color mixed with white (dark theme) or black until it stands out of the panel of a theme."""
    panel = _rgb(_PANELS[theme])
    goal = 1.0 if theme == "dark" else 0.0
    for step in range(21):
        share = step / 20
        red, green, blue = ((1 - share) * c + share * goal for c in color)
        if contrast((red, green, blue), panel) >= _CONTRAST:
            break
    return red, green, blue


def _ink(color: RGB) -> str:
    """Return the color of text that reads best on a color."""
    return max(_INKS, key=lambda ink: contrast(color, _rgb(ink)))


def contrast(a: RGB, b: RGB) -> float:
    """Return the contrast of two colors in sRGB, 1 to 21, as WCAG 2.2 defines it."""
    low, high = sorted((_luminance(a), _luminance(b)))
    return (high + 0.05) / (low + 0.05)


def _luminance(color: RGB) -> float:
    """Return the relative luminance of a color, 0 to 1."""
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in color)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _rgb(color: str) -> RGB:
    """Return the channels of a color such as "#20242c", 0 to 1."""
    red, green, blue = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue


def _hex(color: RGB) -> str:
    """Return a color such as "#20242c"."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in color)


def _is_address(path: Path_) -> bool:
    """Return whether a picture is named by an address."""
    return str(path).startswith(("https://", "http://"))
