"""What `gsvis cut --from-outside` checks, does and says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gsvis.cli.arguments import Cut
from gsvis.cli.terminal import Status
from gsvis.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsvis.edit import CutConfig, Eyes, OutsideCut

__all__ = ["check_outside", "open_up", "spell_outside"]


def check_outside(command: Cut) -> None:
    """Check what --from-outside and --open-to go with.

    Raises:
        ValueError: If they contradict other options.
    """
    if command.open_to is not None and not command.from_outside:
        raise ValueError("--open-to: expected --from-outside with it, got none; add it or leave this out")
    if command.open_to is not None and not any(command.open_to):
        raise ValueError("--open-to: expected a direction that is not 0 0 0, got 0 0 0; give one such as 0 0 1")
    if not command.from_outside:
        return
    where = command.where
    for name, value in (("--cameras", where.cameras), ("--around", where.around), ("--fov", command.fov)):
        if value is not None:
            raise ValueError(f"--from-outside: expected eyes inside, of --path or --box, got {name}; leave one out")


def open_up(command: Cut, g: Gaussians, eyes: Eyes, config: CutConfig, status: Status) -> OutsideCut:
    """Return what is kept of a scene for eyes outside."""
    from gsvis.edit import EyesInSpace, cut_from_outside

    assert isinstance(eyes, EyesInSpace)
    return cut_from_outside(g, eyes, command.open_to, config, progress=status)


def spell_outside(found: OutsideCut, words: str) -> list[str]:
    """Return what is said of a cut for eyes outside, in lines."""
    direction = " ".join(f"{value:.3g}" for value in found.opening.axes[2] + 0.0)
    before = float(found.light_before.mean())
    after = float(found.light_after.mean())
    lines = [
        f"Opened to {direction}: {np.count_nonzero(found.blocking):,} Gaussians stood between eyes there and what"
        f" {words.removesuffix(', all around')} see.",
        f"Other eyes outside get {after:.1%} of their light from inside, {found.light_after.min():.1%} at least;"
        f" {before:.1%} before.",
    ]
    views = found.outside.held_out
    if views is not None:
        lines.append(
            f"{len(views.psnr)} of their views: {views.psnr.min():.1f} dB in the worst against all that is left."
        )
    return lines
