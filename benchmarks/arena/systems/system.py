"""What the arena knows of a system: how it is trained, how it is opened, and what its authors report.

A training writes files into a folder, with a note of what it was trained on and what it spent. It runs once; systems
that send the same scene share one.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from arena.budget import Allowance
from arena.course import Course
from arena.stages import Playable
from gsvis.errors import FormatError, SceneError
from gsvis.files.limits import read_whole
from gsvis.progress import Progress, silent

__all__ = ["System", "Training", "processor_seconds", "trained"]

_NOTE = "trained.json"


@dataclass(frozen=True)
class Training:
    """One training.

    Attributes:
        name: Name of its folder.
        run: Trains on a course and writes to a folder. It finds the folder of `after` beside its own.
        after: A training that it continues, whose seconds count too; None for none.
    """

    name: str
    run: Callable[[Course, Allowance, Path, Progress], None]
    after: Training | None = None


@dataclass(frozen=True)
class System:
    """One system.

    Attributes:
        name: Its name in tables.
        training: How it is trained.
        open: Returns what can be sent, from the course and the folder of its training.
        source: Who described it, and where.
        simplified: What this copy leaves out; "" for nothing.
        published: The authors' figures for bonsai; "" where there are none.
    """

    name: str
    training: Training
    open: Callable[[Course, Path], Playable]
    source: str
    simplified: str = ""
    published: str = ""


def trained(
    training: Training, course: Course, allowance: Allowance, work: Path, progress: Progress = silent
) -> tuple[Path, float]:
    """Return the folder of a training and the processor seconds that it spent; train unless it was done before.

    Args:
        training: The training.
        course: What to train on.
        allowance: What it may spend.
        work: Folder of all trainings.
        progress: Called with what the training reports.

    Raises:
        SceneError: If the folder holds a training on other photographs or with another allowance.
        FormatError: If its note is damaged.
    """
    folder = work / training.name
    key = _key(course, allowance)
    note = folder / _NOTE
    if note.is_file():
        return folder, _read_note(note, key)
    before = 0.0
    if training.after is not None:
        _, before = trained(training.after, course, allowance, work, progress)
    partial = work / f"{training.name}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    began = processor_seconds()
    training.run(course, allowance, partial, progress)
    spent = before + processor_seconds() - began
    (partial / _NOTE).write_text(json.dumps({"key": key, "seconds": spent}), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(partial, folder)
    return folder, spent


def processor_seconds() -> float:
    """Return the processor seconds of this process and of those that it started and that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _read_note(note: Path, key: str) -> float:
    """Return the seconds of a note, if it belongs to this course."""
    try:
        document = json.loads(read_whole(note))
        seconds = float(document["seconds"])
        found = str(document["key"])
    except (ValueError, KeyError, TypeError) as error:
        remedy = f"delete {note.parent} to train again"
        raise FormatError(note, "", "key and seconds of a training", str(error), remedy) from None
    if found != key:
        raise SceneError(
            f"{note.parent}: expected a training on these photographs with this budget, got another; give another"
            " --work, or delete it"
        )
    return seconds


def _key(course: Course, allowance: Allowance) -> str:
    """Return a hash of what a training depends on."""
    sha = hashlib.sha256(json.dumps([asdict(allowance), course.size, course.photos.names]).encode())
    sha.update(np.ascontiguousarray(course.photos.views.images).tobytes())
    return sha.hexdigest()[:16]
