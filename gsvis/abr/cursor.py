"""Where a planner is in the order of a view, and what the order was made for."""

from __future__ import annotations

import enum
from typing import NamedTuple

from gsvis.abr._kernels.plan import Cell, View
from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.predict import Pose

__all__ = ["Cursor", "Outlook", "Stage"]


class Stage(enum.IntEnum):
    """What is sent for a view, in this order."""

    NEEDS = 0
    """What the view needs: its Gaussians, and its terms that change the image much."""
    DETAILS = 1
    """Terms that change the image less."""
    AROUND = 2
    """Terms of what is out of view."""
    SHELLS = 3
    """The rest of the scene, shell by shell around the cell."""


class Cursor(NamedTuple):
    """Where a planner is in the order of a view.

    Attributes:
        regime: Bandwidth regime of the view.
        stage: What is sent.
        shell: Number of the shell that is sent; -1 before the stage `SHELLS`.
        here: The candidates that are ranked.
        cell: The same candidates for the kernels, with what the client lacks.
        view: What the client looks at; without frusta in the stage `SHELLS`.
        is_full: Whether the client's memory is full of records that are worth as much as the next one.
    """

    regime: str
    stage: Stage
    shell: int
    here: Candidates
    cell: Cell
    view: View
    is_full: bool = False

    @property
    def is_filling(self) -> bool:
        """Whether the records of this stage only fill an idle link."""
        return self.stage > Stage.DETAILS


class Outlook(NamedTuple):
    """The poses for which records were ranked, now and predicted, and the cells and regime that follow from them.

    Attributes:
        now: The pose of the client.
        then: Its predicted pose.
        cell: Its cell.
        cell_ahead: The cell that it is about to enter; often `cell`.
        regime: Bandwidth regime.
    """

    now: Pose
    then: Pose
    cell: int
    cell_ahead: int
    regime: str

    def is_like(self, other: Outlook, *, move: float, turn: float) -> bool:
        """Return whether two outlooks are so near that one order does for both.

        Args:
            other: The other outlook.
            move: Most distance between their poses, scene units.
            turn: Most angle between their poses, radians.
        """
        if (self.cell, self.cell_ahead, self.regime) != (other.cell, other.cell_ahead, other.regime):
            return False
        pairs = ((self.now, other.now), (self.then, other.then))
        return all(a.distance_to(b) <= move and a.turn_to(b) <= turn for a, b in pairs)
