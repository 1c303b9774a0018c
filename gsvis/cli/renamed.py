"""Names that options had before, and names that other programs use; a wrong one is answered with ours.

One thing has one name in all commands. Names that were given up are listed here, each with the one that replaced it.
"""

from __future__ import annotations

from collections.abc import Container

__all__ = ["RENAMED", "SYNONYMS", "current_name"]

_FACES = dict.fromkeys(("pvs", "cut", "paint"), "--face-size")
_IMAGES = dict.fromkeys(("train", "levels", "prepare"), "--width and --height")

RENAMED: dict[str, dict[str, str]] = {
    "--as-is": {"simulate": "--no-retarget"},
    "--backend": {"render": "--device, or --reference", "train": "--device"},
    "--camera": {"render": "--cameras"},
    "--compression": {"convert": "--ksplat-compression"},
    "--hold-out": {"train": "--test-every"},
    "--iterations": {"train": "--steps", "levels": "--steps"},
    "--least-db": {"clean": "--min-psnr"},
    "--max-sh-degree": {"convert": "--sh-degree"},
    "--most-changed": {"clean": "--max-changed"},
    "--no-refine": {"color": "--fit omp"},
    "--processes": {"serve": "--workers"},
    "--rays": {"pvs": "--certify", "pvs-report": "--raycast"},
    "--shares": {"levels": "--levels"},
    "--size": {**_FACES, **_IMAGES},
    "--store": {"world": "--work"},
    "--up": {"convert": "--change-up"},
    "--viewpoints": {"pvs-report": "--eyes"},
    "--views": {"cut": "--held-out"},
}
"""Old name of an option -> command -> the new one."""

SYNONYMS: dict[str, tuple[str, ...]] = {
    "--cameras": ("--camera", "--camera-path", "--poses-file"),
    "--device": ("--gpu", "--accelerator"),
    "--face-size": ("--face-pixels", "--cube-size"),
    "--height": ("--image-height",),
    "--max-memory": ("--memory", "--mem", "--memory-limit"),
    "--min-psnr": ("--least-db", "--psnr"),
    "--out": ("--output", "--output-dir", "--destination"),
    "--overwrite": ("--force", "--replace"),
    "--seed": ("--random-seed",),
    "--sh-degree": ("--max-sh-degree", "--sh"),
    "--steps": ("--iterations", "--iters", "--max-steps"),
    "--test-every": ("--hold-out", "--llffhold"),
    "--width": ("--image-width",),
    "--workers": ("--processes", "--jobs", "--threads", "--num-workers"),
}
"""Name of an option in all commands -> names of the same thing that no command has."""


def current_name(command: str, option: str, known: Container[str]) -> str | None:
    """Return one line that names the option of today; None for a name that says nothing.

    Args:
        command: Name of a command, such as "levels".
        option: A name that is none of its options, such as "--shares".
        known: Options of the command.
    """
    new = RENAMED.get(option, {}).get(command)
    if new is not None:
        return f"{option} of gsvis {command} is now {new}"
    for ours, theirs in SYNONYMS.items():
        if option in theirs and ours in known:
            return f"gsvis {command} has no option {option}; its name here is {ours}"
    return None
