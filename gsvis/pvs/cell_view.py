"""Find the visible set of a cell: join the sets of its viewpoints, certify it by rays, and repair it.

Shared viewpoints see most. Fresh rays from free points of the cell then say how much light the set misses. What they
find missing is added, and where the worst ray began is looked from, until the bound is low enough. Levels of a scene
are looked at and certified one by one: Gaussians of one level must not hide those of another. `build.py` does this for
all cells. Scene frame and units; ids are those of the union of levels.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs._kernels import cell as kernels
from gsvis.pvs.aim import Aim, share_of_centers
from gsvis.pvs.certificate import Certificate, CertificateConfig
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.look import LookOptions
from gsvis.pvs.prepared import PreparedLevels
from gsvis.pvs.probes import Tips, farthest_points
from gsvis.pvs.sightings import FaintOnes, Sighting
from gsvis.pvs.tiles import probe_tiles
from gsvis.pvs.viewpoints import FreeVoxels
from gsvis.pvs.weight_classes import UNSEEN, WeightClasses
from gsvis.raycast import Tracer
from gsvis.raycast.directions import NUM_FACES, face_planes
from gsvis.scene.levels import Levels

__all__ = ["CellView", "Figures", "Finder"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
I8 = NDArray[np.int8]
U8 = NDArray[np.uint8]

_FAINT = -2  # class down to which a repair takes what its look finds, at least
_AIM_SIZE = 32  # pixels along a side of the faces on which a viewpoint marks where something may lie
_FILLED = 0.25  # share of its directions below which its faces are finer, so that as many pixels meet something
_FINEST = 4.0  # times
_SMALLER = 2.0 / 3.0  # of that for fine looks, which are finer where all directions show something
_TILES = 8  # worst rays whose tiles are traced
_LOOKED = 0.1  # part of the limit that the estimate must exceed for a look; below, more rays prove more than looks find
_SPARSE = 16  # largest factor by which rays are more where few meet something
_TURNS = 4  # most probes of these tiles in one stage
_COARSE = 0.5  # size of faces over that of fine looks, for up to half of the shared viewpoints of a cell
_PROBE_SIZE = 128  # pixels along a side of the faces of a probe
_PROBE_FLOOR = 0.05  # least weight of a missing Gaussian that a probe counts
_PROBE_LOSS = 0.1  # sum of these weights from which the eye looks finely
_FINE_FLOOR = 4.0  # least weight, over tau, of what a fine look after a probe adds: a set should stay small
_MOST_FLOOR = 0.9  # of that weight, where tau is large
_CLEAN = 4  # probes in a row that find nothing, after which there are no more
_CHECKED = 8  # rays of a cell that a second tracer may trace again


@dataclass(frozen=True)
class Figures:
    """Figures about the set of a cell and the light that it misses; for levels, the worst values.

    Attributes:
        viewpoints: Viewpoints that the set was found from; 0 if all lie inside something solid.
        inner: Number of these viewpoints that were added at the origin of a certificate's worst ray.
        rays: Rays that certified it.
        missed: Estimated share of light that it misses, by the last rays; NaN without a certificate.
        bound: Upper 95% confidence bound of this share; NaN without a certificate.
        tile: Most light missed in a tile of 16 x 16 pixels, before the last addition; NaN without a certificate.
    """

    viewpoints: int
    inner: int
    rays: int
    missed: float
    bound: float
    tile: float


@dataclass(frozen=True, eq=False)
class CellView:
    """The visible set of one cell, with its direction sets.

    Attributes:
        ids: (V,) int32, visible Gaussians, ascending.
        classes: (V,) uint8, class of the largest weight found.
        directions: (V, 10) uint8, direction set of each Gaussian: toward the viewpoints that saw it.
        figures: Figures about the set.
        checked: (K, 6) origins and directions of some rays of the highest level's certificate.
    """

    ids: I32
    classes: U8
    directions: U8
    figures: Figures
    checked: F64


class Finder:
    """Finds the sets of cells of levels.

    Args:
        levels: The levels, N Gaussians in all.
        config: How visible sets are found.
        prepared: Looks and tracers of the levels; None makes them in memory.
    """

    def __init__(self, levels: Levels, config: PvsConfig, prepared: PreparedLevels | None = None) -> None:
        self.levels = levels
        self.config = config
        self._prepared = prepared or PreparedLevels(levels, config)
        self._classes = WeightClasses(config.class_edges)
        self._planes = face_planes()

    @property
    def tracer(self) -> Tracer:
        """The tracer of the highest level."""
        return self._prepared[len(self.levels) - 1].certifier.tracer

    def warm(self) -> None:
        """Make looks and tracers, and load their kernels, so that the first task takes as long as others."""
        eye = self.levels.union.means[0].astype(np.float64)
        for level in range(len(self.levels)):
            self._see(level, eye)
            self._prepared[level].certifier.tracer.contributions(eye[None], [[1.0, 0.0, 0.0]])

    def look(self, viewpoint: F64, *, fine: bool = True) -> Sighting:
        """Return what a viewpoint (3,) sees in each level drawn alone; unless `fine`, coarsely in the highest only."""
        best = np.full(len(self.levels.union), UNSEEN, np.int8)
        looks = 0
        top = len(self.levels) - 1
        for level in range(0 if fine else top, top + 1):
            if not self._prepared[level].certifier.solid.buries(viewpoint[None])[0]:
                ids, classes = self._see(level, viewpoint, fine=fine)
                best[ids] = np.maximum(best[ids], classes)
                looks += 1
        found = np.flatnonzero(best > UNSEEN)
        return Sighting(viewpoint, looks, found.astype(np.int32), best[found])

    def find_cell(self, voxels: FreeVoxels, sightings: Sequence[Sighting]) -> CellView:
        """Return the view of a cell.

        Args:
            voxels: Free voxels of the cell.
            sightings: Sightings of its shared viewpoints.
        """
        view = _Growing(self)
        for sighting in sightings:
            view.add(sighting.ids[sighting.seen], sighting.classes[sighting.seen], sighting.viewpoint[None])
        shared = sum(sighting.looks > 0 for sighting in sightings)
        inner = self._probe(voxels, sightings, view)
        for level in range(len(self.levels) - 1):
            self._prepared.rest(level)
        rays = 0
        checked = np.zeros((0, 6))
        missed, bound, tile = (np.full(len(self.levels), np.nan) for _ in range(3))
        certified = range(len(self.levels)) if self.config.rays else range(0)
        for level in reversed(certified):
            found = self._mend(level, voxels, sightings, view)
            self._prepared.rest(level)
            if not found.certificates:
                continue
            last = found.certificates[-1]
            if any(each.weights.any() for each in found.certificates):  # else there is no light to miss
                missed[level], bound[level], tile[level] = last.missed, last.bound, found.tile
            inner += found.inner
            rays += sum(map(len, found.certificates))
            if level == len(self.levels) - 1:
                checked = np.concatenate([last.checked_o, last.checked_d], axis=1)
        worst = (float(np.nanmax(each)) if not np.isnan(each).all() else np.nan for each in (missed, bound, tile))
        ids = np.flatnonzero(view.best >= 0)
        figures = Figures(shared + inner, inner, rays, *worst)
        return CellView(ids.astype(np.int32), view.best[ids].astype(np.uint8), view.sets[ids], figures, checked)

    def look_again(self, level: int, viewpoint: F64) -> tuple[I64, I8]:
        """Return the union ids that a viewpoint (3,) sees in a level, and their classes."""
        return self._see(level, viewpoint)

    def _see(self, level: int, viewpoint: F64, *, fine: bool = True) -> tuple[I64, I8]:
        """Return the union ids that a viewpoint sees in a level, and their classes."""
        finer = self._finer(level, viewpoint)
        options = LookOptions(
            size=self._pixels(level, finer, fine=fine),
            floor=self.config.tau,
            faint=self._classes.faintest,
            hull=finer == 1.0,  # its z-buffer takes memory
        )
        prepared = self._prepared[level]
        ids, weights = prepared.look(viewpoint, options)
        return prepared.ids[ids], self._classes.of(weights)

    def _pixels(self, level: int, finer: float, *, fine: bool = True) -> int:
        """Return the pixels along a side of the faces of a look."""
        size = self.config.size
        if level < len(self.levels) - 1:
            return round(finer * min(size, self.config.lower_size))
        return round(max(1.0, _SMALLER * finer) * size if fine else max(4.0, _COARSE * finer * size))

    def _finer(self, level: int, viewpoint: F64) -> float:
        """Return the factor by which the faces around a viewpoint are finer, if most directions show the void.

        A shell of outliers, which fills all directions, is ignored.
        """
        if self.config.method != "hybrid":
            return 1.0  # there pixels of the void cost time
        prepared = self._prepared[level]
        share = Aim.of_box(prepared.certifier.tracer, viewpoint, viewpoint, _AIM_SIZE, enough=_FILLED).share
        if len(prepared.core):
            share = min(share, share_of_centers(prepared.core, viewpoint, _AIM_SIZE, enough=_FILLED))
        return 1.0 if share == 0.0 else float(np.clip(np.sqrt(_FILLED / share), 1.0, _FINEST))

    def _probe(self, voxels: FreeVoxels, sightings: Sequence[Sighting], view: _Growing) -> int:
        """Add missing Gaussians that are seen from the tips of the cell and from points far from all eyes.

        Probes are coarse looks at the highest level. If one finds missing light, its eye looks finely
        there, at all levels.

        Returns:
            Number of fine looks.
        """
        certifier = self._prepared[len(self.levels) - 1].certifier

        def buries(some: F64) -> NDArray[np.bool_]:
            return certifier.buries(voxels, some)

        eyes = [each.viewpoint for each in sightings if each.looks]
        tips = Tips(voxels, _points(eyes), buries)
        shared = len(eyes)
        looks = 0
        clean = 0
        while len(eyes) < shared + self.config.probes and (eye := tips.farthest()) is not None:
            found = self._look_closer(eye, view)
            tips.stand(eye, found=found)
            eyes.append(eye)
            looks += found
        left = max(0, shared + self.config.probes - len(eyes))
        for eye in itertools.islice(farthest_points(voxels, _points(eyes), buries), left):
            found = self._look_closer(eye, view)
            looks += found
            clean = 0 if found else clean + 1
            if clean == _CLEAN:
                break
        return looks

    def _look_closer(self, eye: F64, view: _Growing) -> bool:
        """Add missing Gaussians that an eye sees; return whether there were enough for fine looks.

        Fine looks are only where a coarse look at the highest level found something missing.
        """
        missing = self._glance(eye, view)
        if missing is None:
            return False
        top = len(self.levels) - 1
        squares_of: dict[int, NDArray[np.bool_] | None] = {}
        for level in range(top + 1):
            prepared = self._prepared[level]
            if level < top and prepared.certifier.solid.buries(eye[None])[0]:
                continue
            size = self._pixels(level, self._finer(level, eye))
            if size not in squares_of:
                squares_of[size] = self._prepared[top].look.squares(eye, missing, size)
            squares = squares_of[size]
            options = LookOptions(size=size, floor=self._fine_floor, hull=squares is None, squares=squares)
            ids, weights = prepared.look(eye, options)
            view.add(prepared.ids[ids], self._classes.of(weights), eye[None])
        return True

    @property
    def _fine_floor(self) -> float:
        """Least weight of what a fine look after a probe adds."""
        return min(_FINE_FLOOR * self.config.tau, _MOST_FLOOR)

    def _glance(self, eye: F64, view: _Growing) -> I64 | None:
        """Add missing Gaussians that an eye sees coarsely in the highest level.

        Returns:
            Numbers (K,) in the level of all missing Gaussians, the faint ones too; None if they have little weight.
        """
        prepared = self._prepared[len(self.levels) - 1]
        faint = self._fine_floor
        known = view.best[prepared.ids] >= 0
        options = LookOptions(
            size=min(_PROBE_SIZE, self.config.size),
            floor=max(_PROBE_FLOOR, faint),
            faint=faint,
            hull=False,  # what it rejects is looked at finely
            known=known,
        )
        ids, weights = prepared.look(eye, options)
        missing = ~known[ids]
        much = missing & (weights >= _PROBE_FLOOR)
        places = prepared.ids[ids]
        view.add(places[much], self._classes.of(weights[much]), eye[None])
        return ids[missing] if weights[much].sum() >= _PROBE_LOSS else None

    def _mend(self, level: int, voxels: FreeVoxels, sightings: Sequence[Sighting], view: _Growing) -> _Mended:
        """Certify a level of a cell and add missing Gaussians, stage by stage."""
        config = self.config
        certifier = self._prepared[level].certifier
        places = self._prepared[level].ids
        options = CertificateConfig(
            limit=config.limit, rays=config.rays, sparse=_SPARSE, checked=_CHECKED, worst=_TILES, tau=config.tau
        )
        certificates: list[Certificate] = []
        inner = 0
        tile = 0.0
        faint = FaintOnes(sightings, self.levels.member(level), config.limit)
        looks = _Looks(self, level)
        while True:
            held = view.best[places] >= 0
            stage = 1 + len(certificates) + (level << 16)
            found = certifier.certify(voxels, np.flatnonzero(held), options, stage=stage, earlier=certificates)
            if found is None:
                break
            certificates.append(found)
            view.add(places[found.ids], self._classes.of(found.id_weights), found.id_origins)
            looks.begin_repair()
            count, tile = self._mend_tiles(level, found, view, looks)
            inner += count
            ends = len(certificates) > config.max_inner or not found.weights.any()
            if ends or (found.bound <= config.limit and tile <= config.tile_limit):
                break
            if found.bound <= config.limit or found.missed <= _LOOKED * config.limit:
                continue
            if faint.pay(found.missed):
                missing = view.best < 0  # before any is added: it may be faint from more than one viewpoint
                for some, eye in faint.take(found.missed):
                    view.add_faint(some[missing[some]], eye)
            else:
                ids, classes = looks.see(found.worst_o[0])
                kept = classes >= min(faint.taken, _FAINT)
                view.add(ids[kept], np.maximum(classes[kept], 0), found.worst_o[:1])
                inner += 1
        return _Mended(certificates, inner, tile)

    def _mend_tiles(self, level: int, found: Certificate, view: _Growing, looks: _Looks) -> tuple[int, float]:
        """Add missing Gaussians in tiles around the worst rays; return the number of looks and the worst tile left.

        Rays find missing Gaussians. If rays at other places of the tiles find more, the eye of the worst tile looks.
        """
        config = self.config
        tracer = self._prepared[level].certifier.tracer
        places = self._prepared[level].ids
        count = 0
        for turn in range(_TURNS):
            held = view.best[places] >= 0
            tiles = probe_tiles(tracer, held, found.worst_o, found.worst_d, config.tau, turn=turn)
            view.add(places[tiles.ids], self._classes.of(tiles.id_weights), tiles.id_origins)
            tile = float(tiles.missed.max(initial=0.0))
            if tile <= config.tile_limit or turn == _TURNS - 1:
                break
            if turn:
                eye = found.worst_o[int(tiles.missed.argmax())]
                ids, classes = looks.see(eye)
                view.add(ids[classes >= 0], classes[classes >= 0], eye[None])
                count += 1
        return count, tile


class _Looks:
    """The looks that repair a level of a cell. An eye that looked in this repair does not look again.

    Args:
        finder: Its levels.
        level: The level.
    """

    def __init__(self, finder: Finder, level: int) -> None:
        self._finder = finder
        self._level = level
        self._seen: dict[bytes, tuple[I64, I8]] = {}  # what each eye saw in this repair

    def begin_repair(self) -> None:
        """Forget the looks of the last repair."""
        self._seen.clear()

    def see(self, eye: F64) -> tuple[I64, I8]:
        """Return the union ids that an eye (3,) sees in the level, and their classes."""
        name = eye.tobytes()
        if name not in self._seen:
            self._seen[name] = self._finder.look_again(self._level, eye)
        return self._seen[name]


@dataclass(frozen=True, eq=False)
class _Mended:
    """The certificates of a level of a cell, oldest first, its inner viewpoints, and its worst tile."""

    certificates: list[Certificate]
    inner: int
    tile: float


def _points(eyes: Sequence[F64]) -> F64:
    """Return eyes as an array (E, 3)."""
    return np.array(eyes, np.float64).reshape(-1, 3)


class _Growing:
    """A visible set that is being extended.

    Attributes:
        best: (N,) int8, class of the largest weight so far; -1 if not in the set.
        sets: (N, 10) uint8, direction sets.
    """

    def __init__(self, finder: Finder) -> None:
        self._means = finder.levels.union.means
        self._planes = finder._planes
        self.best = np.full(len(self._means), -1, np.int8)
        self.sets = np.zeros((len(self._means), NUM_FACES // 8), np.uint8)

    def add(self, ids: I32 | I64, classes: I8, viewpoints: F64) -> None:
        """Add Gaussians (V,) with the classes of their weights, seen from viewpoints (V, 3), or all from one (1, 3)."""
        eyes = np.ascontiguousarray(viewpoints)
        kernels.add_seen(ids.astype(np.int64), classes, eyes, self._means, *self._planes, self.best, self.sets)

    def add_faint(self, ids: I32, viewpoint: F64) -> None:
        """Add different Gaussians (V,) with the lowest class, seen from one viewpoint (3,)."""
        self.add(ids, np.zeros(len(ids), np.int8), viewpoint[None])
