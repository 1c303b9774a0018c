"""What the world is: Gaussians, cameras, navigable space and scenes with known visibility."""

_MODULES = (
    "cameras",
    "content",
    "gaussians",
    "icosphere",
    "inspection",
    "levels",
    "navigable",
    "paths",
    "points",
    "procedural",
    "retarget",
    "sh",
    "similarity",
)


def __dir__() -> list[str]:
    return list(_MODULES)
