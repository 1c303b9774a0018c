"""The file format of a scene for streaming: records in parts of bounded size, each named by the hash of its content.

levels = in_package_order(levels)          # before visible sets and colors are built for its union
write_package("scene.gsvis", levels, quantize(colors), info=PackageInfo(epsilon=0.02), visibility="scene.pvs")
with Package.open("scene.gsvis") as package:
    some = package.contents.gaussians([4, 8, 15])

`measure_cost` and `measure_fidelity` are imported on first use, because they draw. So a server reads packages without
torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gsvis.package.codec import ChunkTable, Geometry, build_chunks, chunk_starts, decode_records, encode_records
from gsvis.package.contents import Contents, base_rgb
from gsvis.package.fidelity import Fidelity, Spread
from gsvis.package.layout import RECORD_BYTES, RecordLayout, TermLayout
from gsvis.package.manifest import Cost, Manifest, PackageInfo
from gsvis.package.order import PackageOrder, in_package_order
from gsvis.package.package import Package, Verified
from gsvis.package.terms import Terms, decode_terms, encode_terms
from gsvis.package.unpack import unpack_levels, unpack_package
from gsvis.package.writer import write_package

if TYPE_CHECKING:
    from gsvis.package.compare import ExactLevel, measure_fidelity
    from gsvis.package.cost import measure_cost

__all__ = [
    "RECORD_BYTES",
    "ChunkTable",
    "Contents",
    "Cost",
    "ExactLevel",
    "Fidelity",
    "Geometry",
    "Manifest",
    "Package",
    "PackageInfo",
    "PackageOrder",
    "RecordLayout",
    "Spread",
    "TermLayout",
    "Terms",
    "Verified",
    "base_rgb",
    "build_chunks",
    "chunk_starts",
    "decode_records",
    "decode_terms",
    "encode_records",
    "encode_terms",
    "in_package_order",
    "measure_cost",
    "measure_fidelity",
    "unpack_levels",
    "unpack_package",
    "write_package",
]


_HOMES = {"ExactLevel": "compare", "measure_cost": "cost", "measure_fidelity": "compare"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
