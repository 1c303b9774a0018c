"""The page's own reader of static scenes, run by node, with other numbers in place of some of its constants."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

__all__ = ["VIEWER", "build_reader"]

VIEWER = Path(__file__).resolve().parents[1] / "viewer"
_RULES = ("src/core/static-plan.ts", "src/core/static-glances.ts")


def build_reader(folder: Path, name: str, **constants: float) -> Path:
    """Return the script of the reader, built in a folder under a name.

    Args:
        folder: A folder that exists.
        name: What the script is called; other readers in the folder have other names.
        constants: Values for constants of static-plan.ts and static-glances.ts.

    Raises:
        ValueError: If there is no such constant.
    """
    work = folder / f"{name}-sources"
    for part in ("src", "tools"):
        shutil.copytree(VIEWER / part, work / part)
    texts = {rule: (work / rule).read_text(encoding="utf-8") for rule in _RULES}
    for key, value in constants.items():
        found = 0
        for rule, text in texts.items():
            texts[rule], count = re.subn(rf"const {key} = [\d.]+;", f"const {key} = {value:g};", text)
            found += count
        if found != 1:
            raise ValueError(f"{key}: expected a constant of {' or '.join(_RULES)}, found {found}")
    for rule, text in texts.items():
        (work / rule).write_text(text, encoding="utf-8")
    script = folder / f"{name}.mjs"
    words = ["npx", "esbuild", str(work / "tools/static-trace.ts"), "--bundle", "--platform=node", "--format=esm"]
    subprocess.run([*words, f"--outfile={script}", "--log-level=error"], cwd=VIEWER, check=True)
    return script
