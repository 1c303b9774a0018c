"""Reduce the tile lists of a view to the Gaussians that a client holds. Takes checked arrays."""

from __future__ import annotations

from gsvis._kernels.compiled import kernel


@kernel
def keep_shown(offsets, members, shown, out_offsets, out_members):
    """Write lists of tiles (`offsets` (tiles + 1,), `members` (P,)), keeping only splats m with shown[m]."""
    count = 0
    for tile in range(len(offsets) - 1):
        out_offsets[tile] = count
        for k in range(offsets[tile], offsets[tile + 1]):
            if shown[members[k]]:
                out_members[count] = members[k]
                count += 1
    out_offsets[len(offsets) - 1] = count
    return count
