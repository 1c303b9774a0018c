"""Write scenes for players that need no server of gsvis: a site, one page, streamed SOG, glTF, 3D Tiles, USD.

write_static("site/scene", Package.open("scene.gsvis"))
write_site("site", Package.open("scene.gsvis"))
write_html("scene.html", Package.open("scene.gsvis"))

`write_streamed_sog` writes streamed SOG for PlayCanvas, with a sidecar of what each cell needs, `write_tiles` 3D Tiles
for CesiumJS, `write_glb` one glTF file, and `write_usd` one of OpenUSD.
"""

from gsvis.export.page import write_html, write_site
from gsvis.export.publish import PageOptions, check_page
from gsvis.export.static import StaticFile, StaticOptions, StaticScene, write_static
from gsvis.export.streamed import StreamedOptions, StreamedReport, write_streamed_sog
from gsvis.export.tiles import FileReport, TilesOptions, TilesReport, write_glb, write_tiles, write_usd

__all__ = [
    "FileReport",
    "PageOptions",
    "StaticFile",
    "StaticOptions",
    "StaticScene",
    "StreamedOptions",
    "StreamedReport",
    "TilesOptions",
    "TilesReport",
    "check_page",
    "write_glb",
    "write_html",
    "write_site",
    "write_static",
    "write_streamed_sog",
    "write_tiles",
    "write_usd",
]


def __dir__() -> list[str]:
    return sorted(__all__)
