"""Describe a scene: Gaussians, cameras, navigable space, and procedural scenes with known visibility."""

_MODULES = (
    "axes",
    "cameras",
    "content",
    "core",
    "corridor",
    "density",
    "facts",
    "flyaways",
    "gaussians",
    "histograms",
    "icosphere",
    "in_sight",
    "inspection",
    "judged",
    "judging",
    "kinds",
    "lengths",
    "levels",
    "navigable",
    "paths",
    "points",
    "poses",
    "procedural",
    "repeats",
    "retarget",
    "sh",
    "sight",
    "similarity",
    "solid",
    "source_frame",
    "stated",
    "symlog",
    "thinned",
    "upright",
    "view_sampling",
    "witnesses",
)


def __dir__() -> list[str]:
    return list(_MODULES)
