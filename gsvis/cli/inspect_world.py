"""`gsvis inspect` of a world: what its tiles hold, and the overdraw that they state of their cells."""

from __future__ import annotations

from gsvis.cli.arguments import Inspect
from gsvis.cli.options import leaves, refuse
from gsvis.cli.overdraw import cell_overdraw, cell_overdraw_rows
from gsvis.cli.terminal import facts, print_json, show, size_of
from gsvis.world import World

__all__ = ["inspect_world"]

_TAKEN = ("scene", "json")  # the only arguments that make sense


def inspect_world(command: Inspect) -> None:
    """Print what the manifests of a world say. No Gaussian is read.

    Raises:
        ValueError: If an option is given that needs Gaussians.
        FormatError: If the world is damaged.
    """
    refuse(command, (leaf.name for leaf in leaves(Inspect) if leaf.name not in _TAKEN), "for a world")
    world = World.open(command.scene)
    manifest = world.manifest
    overdraw = cell_overdraw(command.scene)
    nodes = [manifest.node(node) for node in range(len(manifest))]
    nbytes = sum(node.nbytes for node in nodes)
    cells = sum(tile.cells for tile in manifest.tiles)
    if command.output.json:
        print_json(
            {
                "format": "gsvis-world-inspection",
                "version": 1,
                "world": command.scene,
                "gaussians": manifest.gaussians,
                "tiles": len(manifest.tiles),
                "districts": len(manifest.districts),
                "cells": cells,
                "bytes": nbytes,
                "up": list(manifest.up),
                "meters_per_unit": manifest.meters_per_unit,
                "cell_overdraw": overdraw,
            }
        )
        return
    meters = manifest.meters_per_unit
    rows = [
        ("Gaussians, all levels", f"{manifest.gaussians:,}"),
        ("tiles, districts", f"{len(manifest.tiles):,}, {len(manifest.districts):,}"),
        ("cells", f"{cells:,}"),
        ("packages", size_of(nbytes)),
        ("up", ", ".join(f"{value:g}" for value in manifest.up)),
        ("length of a unit", f"{meters:g} m" if meters else "not known"),
        *(cell_overdraw_rows(overdraw) if overdraw else [("splats over a pixel", "no tile states it")]),
    ]
    show(facts(command.scene, rows), " gsvis verify reads all of it and says whether it is whole.")
