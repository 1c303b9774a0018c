"""Choose the records that a client receives next: rank them for its pose, and keep the order until the view changes.

A plan covers the bytes of the near future; when it is used up, ranking continues behind it. Between two changes of the
view, all batches together follow one order, whatever their sizes. Terms are sent when they are active for the eye,
now or at one of the predicted poses, and of Gaussians in view. When a view has all that it needs, batches fill the
link: with the terms of what is out of view, then with the rest of the scene, shell by shell. The planner knows no link
and no message: time and rate are arguments.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._kernels.blank import blank
from gsvis.abr._kernels import plan as kernels
from gsvis.abr._kernels.evict import owe_again
from gsvis.abr._kernels.take import is_left, take
from gsvis.abr._kernels.units import EDGE, INSIDE, OUTSIDE
from gsvis.abr.batches import Batch
from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FieldOfView
from gsvis.abr.client_cells import ClientCells
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.abr.memory import ClientMemory
from gsvis.abr.outside import step_of
from gsvis.abr.policies import edge_offset, filling_table, regime_of, table
from gsvis.abr.predict import Pose, PosePredictor, predictor
from gsvis.abr.ranking import Ranking
from gsvis.abr.replaced import Replaced
from gsvis.abr.viewer import Viewer
from gsvis.pvs.codec import pack

__all__ = ["Planner"]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
Words = NDArray[np.uint64]

_REACH = 0.4  # seconds of data to rank at a time: most views last no longer
_FOOTPRINT = 3.6e-5  # steradians, of a square of 6 mrad
# Stages: what the view needs, smaller changes by terms, terms of what is out of view, the first shell.
_NEEDS, _DETAILS, _AROUND, _SHELLS = range(4)
_NO_PLANES = np.zeros((0, 5, 4), np.float32)


class Planner:
    """Chooses the records of one client.

    Args:
        candidates: Candidates of the scene, shared by all clients.
        view: The client's field of view; its margin should be a few degrees.
        config: Settings; None means `AbrConfig()`.
        holdings: What the client holds; None means nothing. `take` changes it.
        poses: Predictor of poses; None means the one that the config names.
        memory: Bytes that the client can hold, see `CandidateIndex.stored`; None means no limit.

    Attributes:
        candidates: Candidates of the scene.
        view: The client's field of view.
        config: The settings.
        holdings: What the client holds.
        reach: Least bytes to rank at a time.
        regime: Bandwidth regime, one of `REGIMES`; None before the first batch.
        cell: The cell of the viewer; -1 before the first pose.
        cell_ahead: The cell that the viewer is about to enter; often `cell`.
        plans: Number of views for which records were ranked.
        memory: The memory of the client; None if it can hold the whole scene.

    Raises:
        ValueError: If the holdings are those of another scene, or the memory is not above 0.
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
        self._picture = index.highest_within(self.config.picture)
        by_change = index.cones is not None and index.num_terms > 0 and self.config.policy == "utility"
        self._strong = tuple(self.config.strong) if by_change else ()
        self._kinds = 1 + len(self._strong)
        has_edge = edge_offset(self.config.policy, self.config.utility)
        self._middle = replace(self.view, margin=0.0) if has_edge else None
        self._is_full = False  # nothing fits that is worth more than what the client holds
        self._given_up: Words | None = None  # what was evicted for this view, and is not sent again for it
        self.regime: str | None = None
        self.cell = -1
        self.cell_ahead = -1
        self.plans = 0
        self._viewer = Viewer(poses or predictor(self.config.predictor))
        self._planned: tuple[int, int, Pose, Pose, str] | None = None
        self._here: Candidates | None = None
        self._near: tuple[Candidates, int, kernels.Cell, kernels.Cell] | None = None  # to return to after filling
        self._cell = kernels.Cell(*(np.zeros(0, np.int32),) * 15)
        self._seen: Words = np.zeros(0, np.uint64)  # candidates of the cell and of the shells so far
        self._is_wide = False  # whether `_seen` is that of this cell
        self._view = kernels.View(*(np.zeros(0, np.float32),) * 9)
        self._travelled = 0.0
        self._aimed = "high"
        self._fresh = False
        self._stage = _NEEDS
        self._stages = _AROUND
        self._filled = _SHELLS
        self._complete = False
        shares = np.full(index.num_levels, self.config.replaced)
        shares[: self._picture + 1] = self.config.covered
        self._replaced = Replaced(candidates, shares)
        self._cells = ClientCells(
            candidates, self.holdings, self._replaced, self._kinds, has_terms=holdings is not None
        )
        self._ranking = Ranking(candidates, self.holdings, self._kinds)
        if holdings is not None:
            self._replaced.doubt(holdings.received)
            self._replaced.doubt(holdings.replaced)

    @property
    def done(self) -> bool:
        """Whether nothing is left to send: all that the view needs, and with `fill` every record.

        Also if the memory of the client is full of what is worth as much.
        """
        return self._is_full or (self._ranking.is_used_up and self._next_stage >= self._stages)

    @property
    def filling(self) -> bool:
        """Whether the next batch only fills an idle link; False if a pose came after the last batch."""
        if self._here is None or self._fresh:
            return False
        return (self._stage > _DETAILS or (self._ranking.is_used_up and self._next_stage > _DETAILS)) and not self.done

    @property
    def has_to_prepare(self) -> bool:
        """Whether the candidates of the viewer's cell are to be made first."""
        near = None if self._near is None else (self._near[0].cell, self._near[0].step)
        return self.cell >= 0 and near != (self.cell, self._step) and not self.candidates.has(self.cell, self._step)

    def prepare(self) -> None:
        """Make the candidates of the viewer's cell, and keep them for all viewers."""
        self.candidates.in_cell(self.cell, self._step)

    @property
    def _step(self) -> int:
        """How far the viewer is outside of all cells, see `gsvis.abr.outside`."""
        pose = self._viewer.pose
        return 0 if pose is None else step_of(self.candidates.index, self.cell, pose.position)

    @property
    def _next_stage(self) -> int:
        if self._stage < _AROUND and self.candidates.index.num_terms:
            return self._stage + 1
        return max(self._filled, self._stage + 1)

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
            self._fresh = True
            self.cell = self.candidates.index.cell_of(self._viewer.pose.position)

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
            middle: (G, 5, 4) frusta inside of the others: what is in view but in none of them is at the edge of the
                view, see `UtilityConfig.edge`. None means that nothing is.
            step: How far outside of the cell the eye is, see `gsvis.abr.outside`.
        """
        view = _check.floats("eye", eye, (3,)), _check.floats("planes", planes, ("F", 5, 4))
        others = np.zeros((0, 3)) if eyes is None else _check.floats("eyes", eyes, ("P", 3))
        every = np.concatenate([view[0][None], others]).astype(np.float32)
        inner = _NO_PLANES if middle is None else _check.floats("middle", middle, ("G", 5, 4))
        self._aim(self._find(cell, step), *view, inner, regime, every, cell if cell_ahead is None else cell_ahead)

    def take(self, budget: float, *, spare: float | None = None) -> Batch:
        """Return the next records of the view, of at most `budget` bytes. They count as held from now on.

        The batch is empty when the next record exceeds the budget, or all have been taken. If the records only fill the
        link, `spare` limits them, too. Where the memory of the client is full, the batch evicts what is farthest from
        use for what the view needs.
        """
        if not budget >= 0:
            raise ValueError(f"budget: expected bytes >= 0, got {budget!r}")
        self._fresh = False
        spare = budget if spare is None else min(budget, spare)
        if self._here is None or self.done:
            return Batch.empty()
        shared = self.candidates
        counts = (self.holdings.gaussians, self.holdings.terms)
        most = [min(n, int(min(budget, 1e12) / size) + 1) for n, size in zip(counts, shared.least_sizes, strict=True)]
        out = np.empty(most[0], np.int32), np.empty(most[1], np.uint32), *shared.scratch.taken()
        taken = [0, 0, 0, 0]
        total = 0.0
        evicted = None
        while True:
            limit = self._limit(budget if self._stage <= _DETAILS else spare)
            if self._ranking.is_used_up:
                if (sum(taken[:2]) and self._stage <= _DETAILS < self._next_stage) or not self._go_on():
                    break  # what fills the link has batches of its own
                continue
            if self._ranking.is_at_end:
                self._ranking.rank_more(self._here, self._cell, self._view, max(self.reach, budget - total))
            rest = kernels.Taken(*(array[count:] for array, count in zip(out, taken, strict=True)))
            self._ranking.place, *found, size = take(
                self._ranking.plan,
                self._ranking.place,
                self._cell,
                self.holdings.words,
                self._view,
                shared.records,
                shared.links,
                limit - total,
                rest,
            )
            taken = [a + b for a, b in zip(taken, found, strict=True)]
            total += size
            if self._ranking.is_at_end:
                continue
            blocked = not sum(taken[:2]) and limit < (budget if self._stage <= _DETAILS else spare)
            if not blocked or self._stage > _DETAILS or evicted is not None:
                self._is_full = blocked
                break
            evicted = self._evict((budget - limit) / self.candidates.sent_per_stored)
        gaussians, terms, dropped, gone = (a[:count].copy() for a, count in zip(out, taken, strict=True))
        self._cells.has_terms |= taken[1] > 0
        if self.memory is not None:
            self.memory.add(taken[0], taken[1], dropped)
        filling = self._stage > _DETAILS and sum(taken[:2]) > 0
        return Batch(gaussians, terms, dropped, total, filling, dropped[:0] if evicted is None else evicted, gone)

    def _limit(self, budget: float) -> float:
        """Return the bytes that fit into the memory of the client, at most a budget."""
        if self.memory is None:
            return budget
        if self._stage > _DETAILS and self.memory.is_full:
            return 0.0
        return min(budget, self.memory.free * self.candidates.sent_per_stored)

    def _evict(self, needed: float) -> I32:
        """Make room for the next record of the plan, and return what is evicted."""
        assert self.memory is not None
        assert self._near is not None
        shared = self.candidates
        near = self._near
        entry = self._ranking.plan.entries[self._ranking.place]
        word = shared.spheres[near[0].words[entry >> kernels.KIND_BITS]]
        sides = np.zeros(1, np.uint8)
        for frustum in self._view.planes:
            kernels.test_words(*word[:, None], frustum, sides)
        found = self.memory.make_room(needed, near[0].union, self._view.eye, self._view.planes, for_view=bool(sides[0]))
        words = pack(found, len(shared.index))
        for cell in (near[2], near[3]):
            owe_again(cell.words, words, cell.owed, cell.checked)
        self._replaced.doubt(found)
        self._filled = _SHELLS
        self._complete = False
        if self._given_up is None:
            self._given_up = words
        else:
            np.bitwise_or.at(self._given_up, found >> 6, np.uint64(1) << (found & 63).astype(np.uint64))
        self._cell = self._without_evicted(self._cell)
        return found

    def _without_evicted(self, cell: kernels.Cell) -> kernels.Cell:
        """Return a cell that allows nothing that was evicted for this view."""
        if self._given_up is None:
            return cell
        return cell._replace(allowed=cell.allowed & ~self._given_up[cell.words])

    def _go_on(self) -> bool:
        """Go on to the next stage; return False if there is none."""
        if self._near is None:
            return False
        config = self.config
        levels = self.candidates.index.num_levels
        if self._next_stage >= self._stages:
            return False
        if self._next_stage <= _AROUND:
            self._stage = self._next_stage
            parts = (INSIDE, OUTSIDE, EDGE) if self._stage == _AROUND else (INSIDE,)
            self._restart(self._aimed, terms_in=parts)
            self._cell = self._without_evicted(self._near[3])
            self._view = self._view._replace(gains=_gains(config.epsilon, *self._strong))
        elif self._enter_shell(self._near[0]):
            self._ranking.restart(*filling_table(config.policy, levels, config.utility, kinds=self._kinds))
        else:
            self._complete = self._given_up is None  # every record is held
            return False
        return True

    def _restart(self, regime: str, **more: tuple[Any, ...]) -> None:
        """Rank anew, by a regime; see `gsvis.abr.policies.table` for more."""
        config = self.config
        levels = self.candidates.index.num_levels
        self._ranking.restart(
            *table(config.policy, regime, levels, config.utility, picture=self._picture, kinds=self._kinds, **more)
        )

    def _enter_shell(self, near: Candidates) -> bool:
        """Go on to the next shell around a cell of which something is left to send; return False if there is none."""
        shared = self.candidates
        held = self.holdings.words
        if not self._is_wide:
            self._begin_wide(near)
        while self._next_stage < self._stages:
            self._stage = self._filled = self._next_stage
            shell = shared.shell(near, self._stage - _SHELLS)
            cell = self._cells.of_shell(shell.candidates, self._seen)
            if is_left(shell.seen, shared.highest, held, cell.owed, cell.allowed):
                break
        else:
            self._filled = self._stages
            return False
        self._replaced.widen(self._seen, shell.seen, held)
        self._here = shell.candidates
        self._cell = self._without_evicted(cell)
        self._view = self._view._replace(planes=_NO_PLANES, middle=_NO_PLANES, eyes=np.zeros((0, 3), np.float32))
        return True

    def _begin_wide(self, near: Candidates) -> None:
        """Begin to widen the candidates of a cell."""
        self._is_wide = True
        self._replaced.begin_far()
        if self.candidates.is_small:
            self._seen = near.union.copy()
            return
        self._seen = blank(len(near.union), np.uint64)
        self._seen[near.words] = near.union[near.words]

    def _follow(self, now: Pose, t: float, rate: float) -> None:
        """Rank for a pose and the pose predicted from it, if these, the cell or the regime have changed enough."""
        config = self.config
        then = self._viewer.ahead(now, t, config.lead)
        here = self._find(self.cell, self._step)
        self.regime = regime_of(rate, here.level_bytes, config.horizon, self.regime)
        self.cell_ahead = self.candidates.index.cell_of(self._viewer.ahead(now, t, config.ahead).position)
        if self._planned is not None:
            *cells, was, was_then, regime = self._planned
            near = self._near is not None and self._near[0] is here
            near = near and self._is_near(now, was) and self._is_near(then, was_then)
            if cells == [self.cell, self.cell_ahead] and regime == self.regime and near:
                return
        poses = (now,) if config.lead <= 0 else (now, then)
        planes = self.view.frusta(poses)
        middle = _NO_PLANES if self._middle is None else self._middle.frusta(poses)
        self.reach = _REACH * rate
        eyes = np.array([pose.position for pose in poses], np.float32)
        self._aim(here, eyes[0], planes, middle, self.regime, eyes, self.cell_ahead)
        self._planned = self.cell, self.cell_ahead, now, then, self.regime
        self.plans += 1

    def _find(self, cell: int, step: int) -> Candidates:
        """Return the candidates of a cell at a step outside of it; the last ones need no cache."""
        near = self._near
        if near is not None and (near[0].cell, near[0].step) == (cell, step):
            return near[0]
        return self.candidates.in_cell(cell, step)

    def _aim(
        self, here: Candidates, eye: F32, planes: F32, middle: F32, regime: str, eyes: F32, cell_ahead: int
    ) -> None:
        config = self.config
        shared = self.candidates
        self._enter(here, cell_ahead)
        self._aimed = regime
        self._is_full = False
        self._given_up = None
        if len(self._view.eye):
            self._travelled += float(np.linalg.norm(eye - self._view.eye))
        self._view = kernels.View(
            eye=eye,
            eyes=eyes if shared.index.cones is not None else eyes[:0],
            travelled=self._travelled,
            gains=_gains(config.first_epsilon, *self._strong),
            pixel=shared.pixel_area,
            parallax=config.parallax,
            planes=planes,
            middle=middle,
            bodies=shared.bodies,
        )
        self._restart(regime, strong=self._strong)

    def _is_near(self, a: Pose, b: Pose) -> bool:
        still = a.distance_to(b) <= self.config.move * self.candidates.index.grid.cell_size
        return still and a.turn_to(b) <= self.config.turn

    def _enter(self, here: Candidates, cell_ahead: int) -> None:
        """Switch to the units of a cell, from another cell or from filling."""
        before = self._near
        self._here = here
        is_new = before is None or before[0] is not here
        if is_new:
            self._filled = _SHELLS
            self._is_wide = False
            self._replaced.leave_cell()
        self._replaced.bound(here, make=not is_new)
        shells = 0 if self._complete else self.candidates.count_shells(here.cell)
        self._stages = _SHELLS + shells if self.config.fill else _AROUND
        if before is not None and before[0] is here and before[1] == cell_ahead:
            self._cell = before[2]
            self._stage = _NEEDS
            return
        if cell_ahead == here.cell:
            self._cell = self._cells.of(here, here.owing, here.active)
        else:
            ahead, owing, active = self.candidates.ahead_of(here, cell_ahead)
            self._cell = self._cells.of(here, owing, active)._replace(ahead=ahead)
        checked = np.zeros_like(self._cell.checked)
        again = self._cell._replace(checked=checked, checked_at=np.zeros_like(self._cell.checked_at))
        self._near = here, cell_ahead, self._cell, again
        self._stage = _NEEDS


def _gains(*epsilons: float) -> NDArray[np.float64]:
    """Return the logarithms of what a change is multiplied by, so that the term is sent where the result is above 1."""
    return np.asarray(-np.log(epsilons) - 0.5 * np.log(_FOOTPRINT))
