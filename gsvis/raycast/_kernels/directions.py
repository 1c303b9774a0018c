"""Kernels of direction sets: the face of a direction, sets from viewpoints, sets traced outward.

Arrays are checked and contiguous; world frame.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel, njit
from gsvis._kernels.faces import face_of
from gsvis._kernels.shared import take_next
from gsvis._kernels.threads import in_parts, in_threads
from gsvis.raycast._kernels.trace import make_room, weight_of


@in_parts(lambda directions, *_: len(directions))
@kernel(error_model="numpy")
def faces_of(begin, end, directions, centers, planes, out):
    """Write faces of directions (D, 3) into out (D,)."""
    for i in range(begin, end):
        out[i] = face_of(directions[i, 0], directions[i, 1], directions[i, 2], centers, planes)


@in_parts(lambda means, *_: len(means))
@kernel(error_model="numpy")
def gather(begin, end, means, weights, viewpoints, tau, centers, planes, sets):
    """Set the bit of the face toward every viewpoint that sees the Gaussian."""
    for i in range(begin, end):
        for v in range(len(viewpoints)):
            if weights[v, i] >= tau:
                f = face_of(
                    viewpoints[v, 0] - means[i, 0],
                    viewpoints[v, 1] - means[i, 1],
                    viewpoints[v, 2] - means[i, 2],
                    centers,
                    planes,
                )
                sets[i, f >> 3] |= np.uint8(1 << (f & 7))


@njit(cache=True)
def first_free(mean, direction, free, origin, size, out):
    """Walk the grid from `mean`; write the middle of the ray's segment in the first free voxel into `out`.

    Returns False if the ray leaves the grid before it meets a free voxel.
    """
    enter = 0.0
    leave = np.inf
    for a in range(3):
        low = origin[a]
        high = origin[a] + size * free.shape[a]
        if direction[a] == 0.0:
            if mean[a] < low or mean[a] >= high:
                return False
            continue
        s = (low - mean[a]) / direction[a]
        t = (high - mean[a]) / direction[a]
        enter = max(enter, min(s, t))
        leave = min(leave, max(s, t))
    if enter >= leave:
        return False
    cell = np.empty(3, np.int64)
    step = np.empty(3, np.int64)
    to_next = np.empty(3, np.float64)
    for a in range(3):
        at = (mean[a] + enter * direction[a] - origin[a]) / size
        cell[a] = min(max(int(np.floor(at)), 0), free.shape[a] - 1)
        step[a] = 1 if direction[a] > 0.0 else -1
        wall = origin[a] + size * (cell[a] + (1 if direction[a] > 0.0 else 0))
        to_next[a] = (wall - mean[a]) / direction[a] if direction[a] != 0.0 else np.inf
    here = enter
    while True:
        axis = 0
        if to_next[1] < to_next[axis]:
            axis = 1
        if to_next[2] < to_next[axis]:
            axis = 2
        if free[cell[0], cell[1], cell[2]]:
            middle = 0.5 * (here + max(here, min(to_next[axis], leave)))
            for a in range(3):
                out[a] = mean[a] + middle * direction[a]
            return True
        here = to_next[axis]
        cell[axis] += step[axis]
        if cell[axis] < 0 or cell[axis] >= free.shape[axis]:
            return False
        to_next[axis] += size / abs(direction[axis])


@in_parts(lambda table, boxes, children, targets, *_: len(targets))
@kernel(error_model="numpy")
def trace_outward(begin, end, table, boxes, children, targets, rays, free, origin, size, limits, tau, sets):
    """Trace direction sets of targets (M,) hierarchy positions (-1: never visible) along rays (80, K, 3)."""
    for i in range(begin, end):
        g = targets[i]
        if g < 0:
            continue
        room = make_room()
        eye = np.empty(3, np.float64)
        mean = table[g, :3]
        for f in range(rays.shape[0]):
            for k in range(rays.shape[1]):
                outward = rays[f, k]
                if not first_free(mean, outward, free, origin, size, eye):
                    continue
                weight = weight_of(table, boxes, children, eye, -outward, g, limits, tau, room)
                if weight >= tau:
                    sets[i, f >> 3] |= np.uint8(1 << (f & 7))
                    break


@in_threads(lambda table, boxes, children, targets, *_: (len(targets) + 63) // 64)
@kernel(error_model="numpy")
def see_from_space(taken, table, boxes, children, targets, rays, free, origin, size, limits, tau, seen):
    """Write into seen (M,) whether an eye in a free voxel sees targets (M,) along one of rays (R, 3), tried in turn."""
    blocks = (len(targets) + 63) // 64
    room = make_room()
    eye = np.empty(3, np.float64)
    block = take_next(taken)
    while block < blocks:
        for i in range(64 * block, min(len(targets), 64 * block + 64)):
            g = targets[i]
            seen[i] = False
            if g < 0:
                continue
            for k in range(len(rays)):
                if not first_free(table[g, :3], rays[k], free, origin, size, eye):
                    continue
                weight = weight_of(table, boxes, children, eye, -rays[k], g, limits, tau, room)
                if weight >= tau:
                    seen[i] = True
                    break
        block = take_next(taken)
