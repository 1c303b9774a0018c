"""What the world is: Gaussians, cameras, navigable space and scenes with known visibility."""

_MODULES = (
    "cameras",
    "content",
    "corridor",
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
    "solid",
    "view_sampling",
)


def __dir__() -> list[str]:
    return list(_MODULES)
