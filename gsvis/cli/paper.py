"""The pieces of the paper's system, and the switch that stands for all of them.

`--as-in-paper` is short for a row of options, one for each piece that a command has. They take the place of the switch
before the command line is read, so that reports and packages state the pieces themselves. An option that is given as
well wins: `--as-in-paper --fit lobes` is the paper's system with one piece of ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["PIECES", "SWITCH", "Piece", "expand", "pieces_of"]

SWITCH = "--as-in-paper"


@dataclass(frozen=True)
class Piece:
    """A piece of the system that the paper has in another way.

    Attributes:
        option: The option that chooses it, in every command that has it.
        paper: The words of the paper's way.
        ours: The words of our way, the default.
        section: Where the paper describes it; "" for a piece that the paper lacks.
    """

    option: str
    paper: str
    ours: str
    section: str

    @property
    def words(self) -> tuple[str, str]:
        """The paper's way on a command line."""
        return self.option, self.paper


PIECES = (
    Piece("--importance", "gradient", "removal", "6.1, equation 6"),
    Piece("--grow", "clones", "merged", "6.1"),
    Piece("--preview", "0", "0.02", ""),
    Piece("--certify", "0", "8192", "6.2"),
    Piece("--directions", "faces", "weighed", "3.1"),
    Piece("--variant", "hsl", "rgb", "5.1"),
    Piece("--fit", "omp", "lobes", "5.2"),
    Piece("--width-price", "0", "3", ""),
    Piece("--color-steps", "0", "300", "7.1.1"),
    Piece("--epsilon", "auto", "0.02", "6.2"),
    Piece("--cell-terms", "stored", "computed", "6.2"),
    Piece("--terms", "cell", "pose", "6.2, equation 7"),
    Piece("--policy", "fov-first", "utility", "6.3"),
    Piece("--tracer", "embree", "hierarchy", ""),
    Piece("--traced-sample", "0", "5000", "3.1"),
)
"""All pieces, in the order of the paper's flow. `docs/how-to/paper.md` says what each one is."""


def pieces_of(options: Sequence[str]) -> list[Piece]:
    """Return the pieces that a command has, by its options."""
    return [piece for piece in PIECES if piece.option in options]


def expand(arguments: Sequence[str], options: Sequence[str]) -> list[str]:
    """Return a command line with the pieces of the paper in place of the switch; unchanged without it.

    Args:
        arguments: The words of the command line.
        options: The options of its command.
    """
    if SWITCH not in map(_hyphens, arguments):
        return list(arguments)
    given = {_hyphens(word.partition("=")[0]) for word in arguments}
    rest = [word for word in arguments if _hyphens(word) != SWITCH]
    added = [word for piece in pieces_of(options) if piece.option not in given for word in piece.words]
    return [*rest, *added]


def _hyphens(word: str) -> str:
    """Return a word with hyphens for underscores, if it is an option."""
    return word.replace("_", "-") if word.startswith("--") else word
