"""A stand-in for the built files of the viewer."""

from __future__ import annotations

from pathlib import Path

PAGE = """<!doctype html>
<html lang="en">
  <head>
    <meta charset="utf-8">
    <title>Scene · gsvis</title>
    <link rel="icon" href="data:,">
    <link rel="stylesheet" href="../viewer/page.css">
    <script type="module" src="../viewer/page.js"></script>
  </head>
  <body>
    <main class="scene"></main>
  </body>
</html>
"""


def viewer_of(folder: Path) -> Path:
    folder.mkdir()
    (folder / "view.html").write_text(PAGE, encoding="utf-8")
    (folder / "page.css").write_text("body { margin: 0 }")
    for name in (
        "page",
        "sort",
        "static",
        "network",
        "tour",
        "author",
        "xr",
        "embed",
        "hotspots",
        "element",
        "words-de",
    ):
        (folder / f"{name}.js").write_text(f"console.log('{name}', '</script><!--');")
    return folder
