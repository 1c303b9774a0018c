"""Variants: ways to split a color into a base and functions of direction that SRBFs describe.

A variant names the space of its base color, its functions, and the number of intensities of a term. Terms add to the
base in that space; then the color is converted to RGB. Table 3 of the paper and our own, side by side.
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
        space: Space of the base color and of what terms add to it: "rgb", "hsl", "hsv" or "yuv".
        functions: Names of the functions that terms belong to.
        intensities: Number of intensities of a term: 1, or one for each axis or channel that shares it.
        components: For each function, the component of the space that it multiplies: f = ref * (1 + sum of terms);
            empty if terms add instead.
        num_axes: Color axes stored with each Gaussian, along which terms add.
    """

    name: str
    space: str
    functions: tuple[str, ...]
    intensities: int = 1
    components: tuple[int, ...] = ()
    num_axes: int = 0


VARIANTS: dict[str, Variant] = {
    v.name: v
    for v in (
        Variant("hsl", "hsl", ("saturation", "lightness"), components=(1, 2)),
        Variant("hsl-l", "hsl", ("lightness",), components=(2,)),
        Variant("hsv", "hsv", ("value",), components=(2,)),
        Variant("yuv", "yuv", ("luma",), components=(0,)),
        Variant("axis", "rgb", ("axis 1",), num_axes=1),
        Variant("axes", "rgb", ("axes",), intensities=2, num_axes=2),
        Variant("axes-split", "rgb", ("axis 1", "axis 2"), num_axes=2),
        Variant("rgb", "rgb", ("rgb",), intensities=3),
    )
}
"""All variants by name: first the paper's, then ours.

`hsl` fixes hue, `hsl-l` hue and saturation, `hsv` hue and saturation, `yuv` both chroma components (paper, table 3).
`axis` lets terms move the color along the first principal direction of its RGB values over the visible directions;
`axes` along the first two, with an intensity for each; `axes-split` has separate terms for the two; `rgb` gives each
term an RGB intensity and needs no axes.
"""

DEFAULT_VARIANT = "rgb"


def variant(name: str) -> Variant:
    """Return the variant with a name.

    Raises:
        ValueError: If there is none; the message lists the names.
    """
    return VARIANTS[_check.one_of("variant", name, tuple(VARIANTS))]
