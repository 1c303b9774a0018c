"""What is fuzzed: a target has valid cases, a way to change one, and a call that must end in a result or a known error.

A case is files by name; for a wire, messages by their place. A name that ends in @link is a link to what its bytes say,
one that ends in @pipe a pipe. The changed case of an input follows from the seed, the
target and the number of the input alone, so that every finding can be made again.
"""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from random import Random

from gsvis.errors import FormatError
from tests.fuzz.mutators import kind_of, mutate, zip_of

__all__ = ["Case", "Target", "case_of", "pack_case", "run_case", "unpack_case"]

Case = dict[str, bytes]

_SHARE_DAMAGED = 0.15  # of the inputs that are changed: a second fault behind a first is seldom reached
_MOST_BYTES = 4 << 20  # of a case: changes that copy must not pile up


def change_files(rng: Random, case: Case, target: Target) -> Case:
    """Change one file by its kind; rarely remove one or put another in its place."""
    found, names = dict(case), sorted(name for name in case if "@" not in name)
    name = rng.choice(names)
    way = rng.randrange(40)
    if way == 0 and len(names) > 1:
        del found[name]
    elif way == 1:
        found[name] = b""
    elif way == 2:
        other = rng.choice(target.cases)
        found[name] = other[rng.choice(sorted(other))]
    elif way == 3:
        found[name] = mutate(rng, "bytes", found[name])
    else:
        found[name] = mutate(rng, target.kinds.get(name, kind_of(name)), found[name])
    return found


@dataclass(frozen=True, eq=False)
class Target:
    """One way into the library.

    Attributes:
        name: Also of its folder in tests/corpus.
        make: Makes the valid cases.
        run: Reads a case, which lies in the folder; what it raises beside `allowed` is a finding.
        allowed: What a damaged case may raise.
        kinds: Of files whose name does not say their kind.
        change: Changes a case once.
        modules: What it is to cover.
        weight: Share of the inputs, beside that of the others.
        refuses: Whether some damage is refused; what counts damage as missing never refuses.
        beginnings: Of messages: a damaged case may raise a ValueError whose message begins with one of them.
        damage: Makes cases with one deliberate fault each, by what it is.
    """

    name: str
    make: Callable[[], list[Case]]
    run: Callable[[Path, Case], None]
    allowed: tuple[type[BaseException], ...] = (FormatError,)
    kinds: dict[str, str] = field(default_factory=dict)
    change: Callable[[Random, Case, Target], Case] = change_files
    modules: tuple[str, ...] = ()
    weight: float = 1.0
    refuses: bool = True
    beginnings: tuple[str, ...] = ()
    damage: Callable[[], dict[str, Case]] = dict

    @cached_property
    def cases(self) -> list[Case]:
        """The valid cases."""
        return self.make()

    @cached_property
    def damaged(self) -> dict[str, Case]:
        """The cases with one deliberate fault, by what it is."""
        return self.damage()


def case_of(target: Target, seed: int, index: int) -> Case:
    """The case of an input: first the valid cases, then those with one deliberate fault, then changed ones of both."""
    cases, damaged = target.cases, list(target.damaged.values())
    if index < len(cases):
        return cases[index]
    if index < len(cases) + len(damaged):
        return damaged[index - len(cases)]
    rng = Random(f"{seed}/{target.name}/{index}")
    case = rng.choice(damaged if damaged and rng.random() < _SHARE_DAMAGED else cases)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5))):
        try:
            changed = target.change(rng, case, target)
        except Exception:  # earlier changes left nothing of its kind: the change is left out, and a test counts these
            continue
        if sum(map(len, changed.values())) <= _MOST_BYTES:
            case = changed
    return case


def run_case(target: Target, folder: Path, case: Case, *, valid: bool = False) -> str:
    """Read a case in an empty folder.

    Returns:
        "read" or "refused".

    Raises:
        BaseException: What is a finding; for a valid case, whatever it raises.
    """
    for name, data in case.items():
        plain, _, kind = name.partition("@")
        path = folder / plain
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "link":
            path.symlink_to(os.fsdecode(data))
        elif kind == "pipe":
            os.mkfifo(path)
        else:
            path.write_bytes(data)
    try:
        target.run(folder, case)
    except (*target.allowed, ValueError) as error:
        line = str(error)
        if valid or not (isinstance(error, target.allowed) or line.startswith(target.beginnings)):
            raise
        if not line or "\n" in line or len(line) > 2000:
            raise AssertionError(
                f"expected an error of one line, got {line[:80]!r} of {len(line)} characters"
            ) from error
        return "refused"
    return "read"


def pack_case(case: Case) -> bytes:
    """A case as one small file of the corpus."""
    return zip_of(case, zipfile.ZIP_DEFLATED)


def unpack_case(data: bytes) -> Case:
    """The case that was packed."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def digest_of(case: Case) -> str:
    """A short name for a case."""
    return hashlib.sha256(pack_case(case)).hexdigest()[:12]
