"""Write scenes for players that need no server of gsvis: a static site, one page that holds everything, streamed SOG.

write_static("site/scene", Package.open("scene.gsvis"))
write_site("site", Package.open("scene.gsvis"))
write_html("scene.html", Package.open("scene.gsvis"))

`write_streamed_sog` writes streamed SOG for PlayCanvas, with a sidecar of what each cell needs.
"""

from gsvis.export.page import write_html, write_site
from gsvis.export.static import StaticFile, StaticOptions, StaticScene, write_static
from gsvis.export.streamed import StreamedOptions, StreamedReport, write_streamed_sog

__all__ = [
    "StaticFile",
    "StaticOptions",
    "StaticScene",
    "StreamedOptions",
    "StreamedReport",
    "write_html",
    "write_site",
    "write_static",
    "write_streamed_sog",
]


def __dir__() -> list[str]:
    return sorted(__all__)
