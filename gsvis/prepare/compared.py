"""Compare what a client gets of a package with the scene that it was made from, long after it was prepared."""

from __future__ import annotations

from dataclasses import replace

from gsvis.errors import SceneError
from gsvis.package.compare import measure_fidelity
from gsvis.package.fidelity import Fidelity
from gsvis.package.package import Package
from gsvis.prepare.config import PrepareConfig
from gsvis.progress import Progress, silent
from gsvis.scene.source import Source

__all__ = ["compare_with_source"]

_SAME = 0.1  # dB by which two measurements of the same scene may differ


def compare_with_source(package: Package, source: Source, *, progress: Progress = silent) -> tuple[Fidelity, str]:
    """Return how near what a client gets comes to a scene, and a remark if that is probably another scene.

    The views are those of `prepare_package`, or drawn where the package has none. Steps that need what the package does
    not hold are taken from its manifest.

    Args:
        package: The package.
        source: The scene.
        progress: Called with stage "fidelity".

    Raises:
        SceneError: If no view can be drawn.
    """
    recorded = package.manifest.info.fidelity
    if recorded is not None:
        cameras = recorded.cameras
    else:
        space, why_not = source.navigable(up=package.manifest.info.up)
        if space is None:
            raise SceneError(f"{source.path or source.name}: {why_not}")
        cameras = PrepareConfig.fidelity_views.cameras(source.whole, space)
    has_sets = package.manifest.visibility is not None
    found = measure_fidelity(
        source.gaussians,
        package.contents,
        cameras,
        sets=package.visibility if has_sets else None,
        active=None if package.epsilon is None else package.active_terms,
        progress=progress,
    )
    if recorded is None:
        return found, ""
    found = replace(found, steps={**recorded.steps, **found.steps})
    if abs(found.records.psnr - recorded.records.psnr) <= _SAME:
        return found, ""
    return found, (
        f"gsvis prepare measured {recorded.records.psnr:.1f} dB for every record: is {source.name} the scene from which"
        " the package was made?"
    )
