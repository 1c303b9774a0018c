"""The staircase test for a person: one HTML page with all pictures inside, and the reader of its saved result.

The page runs the walk of `gsvis.color.Staircase` in the browser, over the rungs of its rule. It asks which of two
pictures differs from the reference, when one is drawn without the terms below epsilon. It needs no network and sends
nothing.
"""

from __future__ import annotations

import base64
import io
import json
import math
import os
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from gsvis import _check
from gsvis._text import as_text
from gsvis.color.epsilon import MOST_AT_BOUND, STUCK, UP_STEPS, EpsilonCalibration, StaircaseRule, replay
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.fields import parse_json
from gsvis.files.limits import read_whole
from gsvis.prepare.approximations import Approximations
from gsvis.progress import Progress, silent
from gsvis.report.html import plain, table

__all__ = ["PERSON_RULE", "draw_ladder", "load_staircase_result", "write_staircase_page"]

PERSON_RULE = StaircaseRule(
    start=0.1,
    down_step=math.log(10.0) / 8.0,
    coarse=(),
    discard=4,
    reversals=16,
    max_trials=100,
    lowest=0.1 * 10.0 ** (-14 / 8),
    highest=0.1 * 10.0 ** (4 / 8),
)
"""Rule for people, for whom trials are expensive: 19 rungs from 0.316 to 0.0018, eight per decade; about 50 trials.

Simulated people who choose one of two, with logistic spreads of 0.1 to 0.4 in log epsilon: the estimate has a bias of
2% and a standard deviation of 18% to 31%. Coarse first steps would save 5 trials, but send 7 runs of 1000 to the lowest
rung by luck.
"""

_TYPICAL_TRIALS = 2.5  # per counted or discarded reversal, with a guess rate of one half


def draw_ladder(pictures: Approximations, epsilons: ArrayLike, *, progress: Progress = silent) -> NDArray[np.float32]:
    """Return (C, E, H, W, 3) images for E epsilons, as `write_staircase_page` takes them.

    Args:
        pictures: C views of a scene.
        epsilons: (E,), such as the rungs of a rule.
        progress: Called with stage "rungs".
    """
    chosen = _check.floats("epsilons", epsilons, ("E",), np.float64).tolist()
    rungs = []
    for done, epsilon in enumerate(chosen):
        progress("rungs", done, len(chosen))
        rungs.append(pictures.images(epsilon))
    progress("rungs", len(chosen), len(chosen))
    return np.stack(rungs, axis=1)


def write_staircase_page(
    path: str | os.PathLike[str],
    reference: ArrayLike,
    approximations: ArrayLike,
    rule: StaircaseRule = PERSON_RULE,
    *,
    title: str,
    pixels_per_degree: float = 67.0,
    about: Mapping[str, Any] | None = None,
    progress: Progress = silent,
) -> int:
    """Write the page, atomically.

    Pictures are stored as lossless 8-bit WebP, duplicates once.

    Args:
        path: The HTML file.
        reference: (V, H, W, 3) images with all terms, 0 black to 1 white; clipped to that range, as on a display.
        approximations: (V, E, H, W, 3) images with the terms active at each of the E `rule.rungs`, in their
            descending order.
        rule: How epsilon moves.
        title: Name of the scene, text.
        pixels_per_degree: Resolution at the distance that the page asks for; 67 is the default of
            `gsvis.render.metrics.flip`, so that person and metric see the same.
        about: Provenance of the pictures, for the page and the result: "gsvis" (its version), "command", how the
            cameras were drawn; JSON values.
        progress: Called with stage "pictures".

    Returns:
        The size of the page in bytes.

    Raises:
        ValueError: If shapes do not fit each other and the rule, or a value is not finite.
        OSError: If the file cannot be written.
    """
    for name, images in (("reference", reference), ("approximations", approximations)):
        if isinstance(images, np.ndarray) and images.dtype == np.uint8:
            raise ValueError(f"{name}: expected floats, got bytes; divide them by 255")
    same = _check.floats("reference", reference, ("V", "H", "W", 3))
    views, height, width, _ = same.shape
    if same.size == 0:
        raise ValueError(f"reference: expected at least one view and one pixel, got shape {same.shape}")
    rungs = rule.rungs
    other = _check.floats("approximations", approximations, (views, len(rungs), height, width, 3))
    if not 1.0 <= pixels_per_degree <= 1000.0:
        raise ValueError(f"pixels_per_degree: expected a value in [1, 1000], got {pixels_per_degree!r}")
    pictures: dict[str, int] = {}
    first, rest = _encode(same, other, pictures, progress)
    provenance = {
        **({} if about is None else about),
        "observer": "person",
        "task": "which of two differs from the reference",
        "scene": title,
        "views_shown": views,
        "width": width,
        "height": height,
        "pixels_per_degree": float(pixels_per_degree),
    }
    document = {
        "rule": {
            **rule.as_dict(),
            "rungs": rungs.tolist(),
            "first": rule.above,
            "up_steps": UP_STEPS,
            "stuck": STUCK,
            "most_at_bound": MOST_AT_BOUND,
        },
        "prefix": "data:image/webp;base64,",
        "pictures": list(pictures),
        "reference": first,
        "approximations": rest,
        "provenance": provenance,
    }
    html = _page(document, title, rule, width, height, pixels_per_degree)
    encoded = html.encode("utf-8")
    with atomic_path(path) as partial:
        partial.write_bytes(encoded)
    return len(encoded)


def load_staircase_result(path: str | os.PathLike[str]) -> EpsilonCalibration:
    """Read the result of the page, or `EpsilonCalibration.as_dict()` written as JSON.

    The trials are replayed by the rule, and the result comes from them.

    Args:
        path: The JSON file.

    Raises:
        FormatError: If the file has another format, its trials do not follow its rule, or its epsilon is not theirs.
        OSError: If it cannot be read.
    """
    document = _document(path)

    def refuse(where: str, expected: str, got: Any) -> NoReturn:
        raise FormatError(path, where, expected, str(got), "save the result of the test again")

    if document.get("format") != "gsvis-epsilon":
        refuse("format", "'gsvis-epsilon'", repr(document.get("format")))
    if document.get("version") != 1:
        refuse("version", "1", repr(document.get("version")))
    rule, trials, provenance = (document.get(name) for name in ("rule", "trials", "provenance"))
    if not isinstance(rule, dict) or set(rule) != set(StaircaseRule().as_dict()):
        refuse("rule", ", ".join(StaircaseRule().as_dict()), plain(sorted(rule) if isinstance(rule, dict) else rule))
    if not isinstance(provenance, dict):
        refuse("provenance", "an object", plain(provenance))
    if not isinstance(trials, list) or not trials or not all(map(_is_trial, trials)):
        refuse("trials", "a list of pairs of an epsilon and true or false", plain(trials)[:80])
    try:
        epsilons, detected = (list(column) for column in zip(*trials, strict=True))
        found = replay(StaircaseRule(**rule), epsilons, detected, provenance)
    except (OverflowError, ValueError) as error:
        raise FormatError(path, "trials", "what the rule gives", f"'{error}'", "save the result again") from error
    epsilon = document.get("epsilon")
    if not (
        isinstance(epsilon, float | int) and 0 < epsilon < 2 and math.isclose(epsilon, found.epsilon, rel_tol=1e-6)
    ):
        refuse("epsilon", f"{found.epsilon:.6g}, by its trials", plain(epsilon))
    return found


def _document(path: str | os.PathLike[str]) -> dict[str, Any]:
    def constant(name: str) -> NoReturn:
        raise ValueError(f"the constant {name}")

    path = _check.path("path", path)
    document = parse_json(path, read_whole(path), parse_constant=constant)
    if not isinstance(document, dict):
        raise FormatError(path, "", "a JSON object", type(document).__name__, "save the result of the test again")
    return document


def _is_trial(trial: Any) -> bool:
    return (
        isinstance(trial, list)
        and len(trial) == 2
        and isinstance(trial[0], float | int)
        and not isinstance(trial[0], bool)
        and isinstance(trial[1], bool)
    )


def _encode(
    reference: NDArray[np.float32], approximations: NDArray[np.float32], pictures: dict[str, int], progress: Progress
) -> tuple[list[int], list[list[int]]]:
    """Return indices of the pictures of references (V,) and approximations (V, E); adds new ones to `pictures`."""
    first = []
    rest = []
    total = len(reference) * (1 + approximations.shape[1])
    progress("pictures", 0, total)
    for view in range(len(reference)):
        found = []
        for image in (reference[view], *approximations[view]):
            found.append(pictures.setdefault(_webp(image), len(pictures)))
            progress("pictures", view * (1 + approximations.shape[1]) + len(found), total)
        first.append(found[0])
        rest.append(found[1:])
    return first, rest


def _webp(image: NDArray[np.float32]) -> str:
    out = io.BytesIO()
    levels = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    Image.fromarray(levels).save(out, "WEBP", lossless=True, quality=60, method=2, exact=True)
    return base64.b64encode(out.getvalue()).decode("ascii")


def _page(
    document: dict[str, Any], title: str, rule: StaircaseRule, width: int, height: int, pixels_per_degree: float
) -> str:
    provenance = document["provenance"]
    widths = 0.5 / math.tan(math.radians(0.5 * min(width / pixels_per_degree, 170.0)))
    shown = [(escape(name), escape(plain(value))) for name, value in provenance.items() if name != "observer"]
    rungs = rule.rungs
    made = (
        f"{len(document['pictures'])} pictures without loss ({sum(map(len, document['pictures'])) / 1e6:.1f} MB in this"
        f" page): {provenance['views_shown']} views at {len(rungs)} values of epsilon from {rungs[0]:.3g} to"
        f" {rungs[-1]:.2g}. Terms that change no channel of their Gaussian's color by more than epsilon are left out"
        f" of the approximations. A right answer takes epsilon one step down, a wrong one {UP_STEPS} steps up, so it"
        " rests where 75% are right; the result is the geometric mean of the last turning points."
    )
    here = Path(__file__).parent
    page = Template((here / "staircase.html").read_text(encoding="utf-8")).substitute(
        title=escape(title),
        version=escape(str(provenance.get("gsvis", ""))),
        lead=f"A test of how much of the colors of {escape(title)} an eye needs.",
        width=str(width),
        height=str(height),
        aspect=f"{width / height:.5f}",
        distance=f"{widths:.2g}",
        near=f"{6.0 * widths:.0f}",
        far=f"{12.0 * widths:.0f}",
        ppd=f"{pixels_per_degree:g}",
        typical=str(round(_TYPICAL_TRIALS * (rule.discard + rule.reversals))),
        made=made,
        table=table(("the pictures", ""), shown),
        data=json.dumps(document, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        script=(here / "staircase.js").read_text(encoding="utf-8"),
        style=(files("gsvis.report") / "page.css").read_text(encoding="utf-8"),
    )
    return as_text(page)
