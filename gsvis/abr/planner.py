"""Choose the records that a client receives next: rank them for its pose, and keep the order until the view changes.

A plan covers the bytes of the near future; when it is used up, ranking continues behind it. Between two changes of the
view, all batches together follow one order, whatever their sizes. Terms are sent when they are active for the eye,
now or at one of the predicted poses, and of Gaussians in view. When a view has all that it needs, batches fill the
link: with the terms of what is out of view, then with the rest of the scene, shell by shell. The planner knows no link
and no message: time and rate are arguments.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr._kernels import plan as kernels
from gsvis.abr._kernels.units import EDGE, INSIDE, OUTSIDE
from gsvis.abr.batches import Batch
from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FieldOfView
from gsvis.abr.client_cells import ClientCells
from gsvis.abr.config import AbrConfig
from gsvis.abr.cursor import Cursor, Outlook, Stage
from gsvis.abr.holdings import Holdings
from gsvis.abr.memory import ClientMemory
from gsvis.abr.outside import distance_step
from gsvis.abr.policies import edge_offset, regime_of
from gsvis.abr.predict import Pose, PosePredictor, predictor
from gsvis.abr.ranking import Ranking
from gsvis.abr.replacements import Replacements
from gsvis.abr.taking import Taking
from gsvis.abr.viewer import Viewer

__all__ = ["Planner"]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]

_REACH = 0.4  # seconds of data to rank at a time: most views last no longer
_NO_PLANES = np.zeros((0, 5, 4), np.float32)


class Planner:
    """Chooses the records of one client.

    Args:
        candidates: Candidates of the scene, shared by all clients.
        view: The client's field of view; its margin should be a few degrees.
        config: Settings; None means `AbrConfig()`.
        holdings: What the client holds; None means nothing. `take` changes it.
        poses: Predictor of poses; None means the one that the config names.
        memory: Bytes that the client can hold, see `TableNumbers.stored`; None means no limit.

    Attributes:
        candidates: Candidates of the scene.
        view: The client's field of view.
        config: The settings.
        holdings: What the client holds.
        reach: Least bytes to rank at a time.
        cell: The cell of the viewer; -1 before the first pose.
        plans: Number of times that records were ranked for a new view.
        memory: The memory of the client; None if it can hold the whole scene.

    Raises:
        ValueError: If the holdings have other numbers of Gaussians or terms than the scene, or the memory is not above
            0.
    """

    def __init__(
        self,
        candidates: CandidateIndex,
        view: FieldOfView,
        config: AbrConfig | None = None,
        *,
        holdings: Holdings | None = None,
        poses: PosePredictor | None = None,
        memory: float | None = None,
    ) -> None:
        index = candidates.index
        self.config = config or AbrConfig()
        self.candidates = candidates
        self.view = view.in_cells(index.grid.cell_size)
        self.reach = 1e6
        self.holdings = Holdings(len(index), index.num_terms) if holdings is None else holdings
        if (self.holdings.gaussians, self.holdings.terms) != (len(index), index.num_terms):
            raise ValueError(f"holdings: expected those of {index!r}, got {self.holdings!r}")
        self.memory = None if memory is None else ClientMemory(candidates, self.holdings, memory)
        has_edge = edge_offset(self.config.policy, self.config.utility)
        self._middle = replace(self.view, margin=0.0) if has_edge else None
        self.cell = -1
        self.plans = 0
        self._viewer = Viewer(poses or predictor(self.config.predictor))
        self._outlook: Outlook | None = None
        self._cursor: Cursor | None = None
        self._ranking = Ranking(candidates, self.holdings, self.config)
        shares = np.full(index.num_levels, self.config.replaced)
        shares[: self._ranking.picture + 1] = self.config.covered
        replacements = Replacements(candidates, shares)
        self._cells = ClientCells(
            candidates, self.holdings, replacements, self._ranking.kinds, has_terms=holdings is not None
        )
        if holdings is not None:
            replacements.doubt(holdings.received)
            replacements.doubt(holdings.replaced)

    @property
    def regime(self) -> str | None:
        """Bandwidth regime, one of `REGIMES`; None before the first batch."""
        return None if self._outlook is None else self._outlook.regime

    @property
    def cell_ahead(self) -> int:
        """The cell that the viewer is about to enter; often `cell`. -1 before the first batch."""
        return -1 if self._outlook is None else self._outlook.cell_ahead

    @property
    def done(self) -> bool:
        """Whether nothing is left to send: all that the view needs is sent, and with `fill` every record.

        True too if the client's memory is full of records that are worth as much as the next one.
        """
        is_full = self._cursor is not None and self._cursor.is_full
        return is_full or (self._ranking.is_used_up and self._is_last_stage)

    @property
    def filling(self) -> bool:
        """Whether the next batch only fills an idle link; False if there is a pose later than the last batch."""
        if self._cursor is None or self._viewer.has_moved:
            return False
        is_next = self._ranking.is_used_up and self._next_stage > Stage.DETAILS
        return (self._cursor.is_filling or is_next) and not self.done

    @property
    def has_to_prepare(self) -> bool:
        """Whether the candidates of the viewer's cell have yet to be computed."""
        step = self._step
        return self.cell >= 0 and not self._is_in(self.cell, step) and not self.candidates.has(self.cell, step)

    def prepare(self) -> None:
        """Compute the candidates of the viewer's cell, and cache them for all viewers."""
        self.candidates.in_cell(self.cell, self._step)

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Update the pose of the client at time t; ignore one that is older than the last.

        Args:
            t: Seconds.
            position: (3,) scene frame.
            quat: (4,) wxyz, world from camera, any length but 0.

        Raises:
            ValueError: If a value is not finite, or the quaternion is 0. Nothing changes then.
        """
        if self._viewer.observe(t, position, quat) and self._viewer.pose is not None:
            self.cell = self.candidates.index.grid.nearest(self._viewer.pose.position)

    def position_in(self, seconds: float) -> NDArray[np.float64] | None:
        """Extrapolate the position of the client; see `Viewer.position_in`."""
        return self._viewer.position_in(seconds)

    def next_batch(self, t: float, budget: float, rate: float, *, spare: float | None = None) -> Batch:
        """Return the next records, an empty batch before the first pose. They count as held from now on.

        Args:
            t: Seconds.
            budget: Bytes of records.
            rate: Estimated throughput, bytes of records a second.
            spare: Bytes of records if they only fill the link; None means the budget.
        """
        if self._viewer.pose is not None:
            self._follow(self._viewer.pose, t, rate)
        return self.take(budget, spare=spare)

    def aim(
        self,
        cell: int,
        eye: ArrayLike,
        planes: ArrayLike,
        regime: str = "high",
        *,
        eyes: ArrayLike | None = None,
        cell_ahead: int | None = None,
        middle: ArrayLike | None = None,
        step: int = 0,
    ) -> None:
        """Rank the next records for a view.

        Args:
            cell: The cell of the eye.
            eye: (3,) position.
            planes: (F, 5, 4) frusta; a Gaussian in any of them is in view.
            regime: One of `REGIMES`.
            eyes: (P, 3) predicted positions; terms are sent that are active for one of them or for the eye.
            cell_ahead: The cell that the viewer is about to enter; None means the same cell.
            middle: (G, 5, 4) smaller frusta inside `planes`. What is in view but in none of them is at the edge of the
                view, see `UtilityConfig.edge`. None means that nothing is at the edge.
            step: Distance of the eye from the cell, see `gsvis.abr.outside`.
        """
        at = _check.floats("eye", eye, (3,))
        frusta = _check.floats("planes", planes, ("F", 5, 4))
        others = np.zeros((0, 3)) if eyes is None else _check.floats("eyes", eyes, ("P", 3))
        every = np.concatenate([at[None], others]).astype(np.float32)
        inner = _NO_PLANES if middle is None else _check.floats("middle", middle, ("G", 5, 4))
        self._aim(self._find(cell, step), at, every, frusta, inner, regime, cell if cell_ahead is None else cell_ahead)

    def take(self, budget: float, *, spare: float | None = None) -> Batch:
        """Return the next records of the view, of at most `budget` bytes. They count as held from now on.

        The batch is empty if the next record exceeds the budget, or all have been taken. If the records only fill the
        link, they are limited by `spare` too. If the memory of the client is full, the batch evicts Gaussians that are
        far or out of view for records that the view needs.
        """
        if not budget >= 0:
            raise ValueError(f"budget: expected bytes >= 0, got {budget!r}")
        self._viewer.has_moved = False
        spare = budget if spare is None else min(budget, spare)
        if self._cursor is None or self.done:
            return Batch.empty()
        taking = Taking(self.candidates, self.holdings, budget)
        evicted = None
        cursor = self._cursor
        while True:
            wanted = spare if cursor.is_filling else budget
            limit = self._fitting_bytes(wanted, cursor)
            if self._ranking.is_used_up:
                begins_to_fill = not cursor.is_filling and self._next_stage > Stage.DETAILS
                if (taking.has_records and begins_to_fill) or not self._go_on(cursor):
                    break  # what fills the link has batches of its own
                cursor = self._cursor
                continue
            if self._ranking.is_at_end:
                self._ranking.rank_more(cursor.here, cursor.cell, cursor.view, max(self.reach, budget - taking.total))
            taking.take_ranked(self._ranking, cursor, limit)
            if self._ranking.is_at_end:
                continue
            is_blocked = not taking.has_records and limit < wanted
            if not is_blocked or cursor.is_filling or evicted is not None:
                if is_blocked:
                    self._cursor = cursor._replace(is_full=True)
                break
            evicted = self._evict((budget - limit) / self.candidates.tables.numbers.sent_per_stored, cursor)
            cursor = self._cursor = cursor._replace(cell=self._cells.replacements.allow(cursor.cell))
        batch = taking.batch(filling=cursor.is_filling, evicted=evicted)
        self._cells.has_terms |= len(batch.terms) > 0
        if self.memory is not None:
            self.memory.add(len(batch.gaussians), len(batch.terms), batch.dropped)
        return batch

    def _fitting_bytes(self, budget: float, cursor: Cursor) -> float:
        """Return how many bytes of records fit into the memory of the client, at most `budget`."""
        if self.memory is None:
            return budget
        if cursor.is_filling and self.memory.is_full:
            return 0.0
        return min(budget, self.memory.free * self.candidates.tables.numbers.sent_per_stored)

    def _evict(self, needed: float, cursor: Cursor) -> I32:
        """Evict Gaussians to free `needed` bytes for the next record of the plan; return their ids."""
        assert self.memory is not None
        assert self._cells.near is not None
        near = self._cells.near.here
        entry = self._ranking.plan.entries[self._ranking.place]
        word = self.candidates.tables.spheres[near.words[entry >> kernels.KIND_BITS]]
        sides = np.zeros(1, np.uint8)
        view = cursor.view
        for frustum in view.planes:
            kernels.test_words(*word[:, None], frustum, sides)
        found = self.memory.make_room(needed, near.union, view.eye, view.planes, for_view=bool(sides[0]))
        self._cells.evict(found)
        return found

    # the stages

    @property
    def _next_stage(self) -> Stage:
        """The stage after this one, `SHELLS` at the end; stages with terms are skipped in a scene without terms."""
        stage = Stage.NEEDS if self._cursor is None else self._cursor.stage
        if stage < Stage.AROUND and self.candidates.index.num_terms:
            return Stage(stage + 1)
        return Stage.SHELLS

    @property
    def _next_shell(self) -> int:
        """The first shell after this stage of which something may be left."""
        shell = -1 if self._cursor is None else self._cursor.shell
        return max(self._cells.shell, shell + 1)

    @property
    def _is_last_stage(self) -> bool:
        """Whether no stage follows."""
        if not self.config.fill:
            return self._next_stage >= Stage.AROUND
        return self._next_stage is Stage.SHELLS and self._next_shell >= self._cells.shells

    def _go_on(self, cursor: Cursor) -> bool:
        """Go on to the next stage; return False if there is none."""
        near = self._cells.near
        if near is None or self._is_last_stage:
            return False
        stage = self._next_stage
        if stage is Stage.SHELLS:
            return self._go_to_shell(cursor, self._next_shell)
        self._ranking.begin_terms(cursor.regime, (INSIDE, OUTSIDE, EDGE) if stage is Stage.AROUND else (INSIDE,))
        view = cursor.view._replace(gains=self._ranking.gains)
        self._cursor = cursor._replace(stage=stage, cell=self._cells.replacements.allow(near.again), view=view)
        return True

    def _go_to_shell(self, cursor: Cursor, number: int) -> bool:
        """Go on to the first shell, from a number on, of which something is left; return False if there is none."""
        found = self._cells.next_shell(number)
        if found is None:
            return False
        here, cell = found
        view = cursor.view._replace(planes=_NO_PLANES, middle=_NO_PLANES, eyes=np.zeros((0, 3), np.float32))
        self._cursor = Cursor(cursor.regime, Stage.SHELLS, self._cells.shell, here, cell, view, cursor.is_full)
        self._ranking.begin_shell()
        return True

    # the view

    @property
    def _step(self) -> int:
        """Distance of the viewer from its cell as a step, see `gsvis.abr.outside`."""
        pose = self._viewer.pose
        return 0 if pose is None else distance_step(self.candidates.index, self.cell, pose.position)

    def _is_in(self, cell: int, step: int) -> bool:
        """Whether records are ranked for this cell at this step."""
        near = self._cells.near
        return near is not None and (near.here.cell, near.here.step) == (cell, step)

    def _find(self, cell: int, step: int) -> Candidates:
        """Return the candidates of a cell at a step; those in use are found without the cache."""
        near = self._cells.near
        return near.here if near is not None and self._is_in(cell, step) else self.candidates.in_cell(cell, step)

    def _follow(self, now: Pose, t: float, rate: float) -> None:
        """Rank for the pose `now` and the pose predicted from it, if poses, cell or regime have changed enough."""
        config = self.config
        then = self._viewer.predict_pose(now, t, config.lead)
        here = self._find(self.cell, self._step)
        regime = regime_of(rate, here.level_bytes, config.horizon, self.regime)
        cell_ahead = self.candidates.index.grid.nearest(self._viewer.predict_pose(now, t, config.ahead).position)
        outlook = Outlook(now, then, self.cell, cell_ahead, regime)
        if self._is_ranked(here, outlook):
            return
        poses = (now,) if config.lead <= 0 else (now, then)
        planes = self.view.frusta(poses)
        middle = _NO_PLANES if self._middle is None else self._middle.frusta(poses)
        self.reach = _REACH * rate
        eyes = np.array([pose.position for pose in poses], np.float32)
        self._aim(here, eyes[0], eyes, planes, middle, regime, cell_ahead)
        self._outlook = outlook
        self.plans += 1

    def _is_ranked(self, here: Candidates, outlook: Outlook) -> bool:
        """Whether records are ranked for a view like this one."""
        near = self._cells.near
        if self._outlook is None or near is None or near.here is not here:
            return False
        move = self.config.move * self.candidates.index.grid.cell_size
        return outlook.is_like(self._outlook, move=move, turn=self.config.turn)

    def _aim(
        self, here: Candidates, eye: F32, eyes: F32, planes: F32, middle: F32, regime: str, cell_ahead: int
    ) -> None:
        """Rank for a view; arguments as for `aim`, but checked and without None."""
        shared = self.candidates
        cell = self._cells.enter(here, cell_ahead)
        self._cells.replacements.given_up = None
        travelled = 0.0
        if self._cursor is not None:
            before = self._cursor.view
            travelled = before.travelled + float(np.linalg.norm(eye - before.eye))
        view = kernels.View(
            eye=eye,
            eyes=eyes if shared.index.cones is not None else eyes[:0],
            travelled=travelled,
            gains=self._ranking.first_gains,
            pixel=shared.tables.numbers.pixel_area,
            parallax=self.config.parallax,
            planes=planes,
            middle=middle,
            bodies=shared.tables.bodies,
        )
        self._cursor = Cursor(regime, Stage.NEEDS, -1, here, cell, view)
        self._ranking.begin_view(regime)
