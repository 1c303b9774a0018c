"""Build a furnished flat that looks like a trained capture: five rooms and a hall, in meters, z up.

Surfaces are painted (`materials`, `pictures`), laid into the rooms as charts (`shell`, `furniture`, `furnish`,
`plants`, `outside`), lit (`light`), cut into pieces of one color (`pieces`) and made Gaussians (`dress`).
"""

from gsvis.scene.flat.scene import EYES, UP, furnished_flat, navigable_space

__all__ = ["EYES", "UP", "furnished_flat", "navigable_space"]
