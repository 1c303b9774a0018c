"""Variants: ways to split a color into a base and functions of direction that SRBFs describe.

A variant names the space of its base color, its functions, and the number of intensities of a term. Terms add to the
base in that space; then the color is converted to RGB. `hsl` is the paper's, `rgb` ours. Other rows of the paper's
table 3 are in `benchmarks/paper/held.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

from gsvis import _check

__all__ = ["DEFAULT_VARIANT", "VARIANTS", "Variant", "variant"]


@dataclass(frozen=True)
class Variant:
    """A way to make a color from a base and terms.

    Attributes:
        name: Name for `fit_srbf`.
        space: Space of the base color and of what terms add to it: "rgb" or "hsl".
        functions: Names of the functions that terms belong to.
        intensities: Number of intensities of a term: 1, or one for each channel that shares it.
        components: For each function, the component of the space that it multiplies: f = ref * (1 + sum of terms);
            empty if terms add instead.
    """

    name: str
    space: str
    functions: tuple[str, ...]
    intensities: int = 1
    components: tuple[int, ...] = ()


VARIANTS: dict[str, Variant] = {
    v.name: v
    for v in (
        Variant("rgb", "rgb", ("rgb",), intensities=3),
        Variant("hsl", "hsl", ("saturation", "lightness"), components=(1, 2)),
    )
}
"""All variants by name. `rgb` gives each term an RGB intensity; `hsl` fixes the hue (paper, section 5.2)."""

DEFAULT_VARIANT = "rgb"


def variant(name: str) -> Variant:
    """Return the variant with a name.

    Raises:
        ValueError: If there is none; the message lists the names.
    """
    return VARIANTS[_check.one_of("variant", name, tuple(VARIANTS))]
