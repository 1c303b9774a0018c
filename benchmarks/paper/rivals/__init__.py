"""Other ways to deliver a scene, behind `Delivery`, each by the rules of its source; docs/rivals.md says how exactly.

    measured = Measured(contents, files, 40.0, 28.0, 20.0)    # sizes, measured once for a scene
    delivery = rival("leaves, spark", measured, config.view)

Sizes come from the caller. No rival knows visible sets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from gsvis.abr.classes import FieldOfView
from gsvis.package.contents import Contents
from gsvis.simulate.delivery import Delivery
from paper.rivals.frustum import FrustumChunks
from paper.rivals.layers import LayerByLayer, Layers
from paper.rivals.leaves import LeafFiles, LeafStream
from paper.rivals.pieces import Pieces, Sender
from paper.rivals.segments import Segments

__all__ = [
    "RIVALS",
    "FrustumChunks",
    "LayerByLayer",
    "Layers",
    "LeafFiles",
    "LeafStream",
    "Measured",
    "Pieces",
    "Sender",
    "rival",
]

RIVALS = {
    "leaves, playcanvas": "streamed SOG by the rule of PlayCanvas' engine",
    "leaves, spark": "streamed SOG in Spark's fetch order",
    "leaves, octree-gs": "streamed SOG by the levels of Octree-GS",
    "frustum chunks": "full SH, in view first",
    "layers, L3GS, levels": "our levels as layers, by the utility of L3GS",
    "layers, L3GS, importance": "the highest level sorted by importance, by the utility of L3GS",
    "layers, LapisGS": "our levels, one whole layer after the other",
}
"""What each rival is, by name."""


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured of a scene for its rivals; several deliveries share it.

    Attributes:
        contents: The package.
        files: Files of its streamed SOG.
        chunk_bytes: Bytes of a Gaussian with full SH in a chunk of its own of `chunk` Gaussians.
        layer_bytes: The same in a file of a layer of a segment.
        whole_bytes: The same in a file of a whole layer of the scene.
        chunk: Gaussians of a chunk.
        how: How these bytes were measured, for reports.
    """

    contents: Contents
    files: LeafFiles
    chunk_bytes: float
    layer_bytes: float
    whole_bytes: float
    chunk: int = 1024
    how: str = ""

    @cached_property
    def segments(self) -> Segments:
        """The leaves as segments; what is far outside belongs to none."""
        return Segments.of_contents(self.contents, self.files.of)

    @cached_property
    def runs(self) -> Segments:
        """All Gaussians in segments along a curve."""
        return Segments.of_contents(self.contents)


def rival(name: str, measured: Measured, view: FieldOfView) -> Delivery:
    """Return a new delivery of a rival by name, one of `RIVALS`.

    Args:
        name: The name.
        measured: Sizes of the scene.
        view: Field of view of the client.
    """
    if name not in RIVALS:
        raise ValueError(f"name: expected one of {', '.join(map(repr, RIVALS))}, got {name!r}")
    m = measured
    contents = measured.contents
    if name.startswith("leaves, "):
        return LeafStream(contents, m.files, view, name.removeprefix("leaves, "), segments=m.segments)
    if name == "frustum chunks":
        return FrustumChunks(contents, view, m.chunk_bytes, count=m.chunk, measured=m.how)
    if name == "layers, LapisGS":
        return LayerByLayer(contents, m.whole_bytes, measured=m.how)
    source = name.removeprefix("layers, L3GS, ")
    return Layers(contents, view, m.layer_bytes, source, segments=m.runs, measured=m.how)


def __dir__() -> list[str]:
    return sorted(__all__)
