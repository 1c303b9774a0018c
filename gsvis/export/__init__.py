"""Write scenes for players that need no server of gsvis: a static site, and one page that holds everything.

write_static("site/scene", Package.open("scene.gsvis"))
write_site("site", Package.open("scene.gsvis"))
write_html("scene.html", Package.open("scene.gsvis"))
"""

from gsvis.export.page import write_html, write_site
from gsvis.export.static import StaticFile, StaticOptions, StaticScene, write_static

__all__ = ["StaticFile", "StaticOptions", "StaticScene", "write_html", "write_site", "write_static"]


def __dir__() -> list[str]:
    return sorted(__all__)
