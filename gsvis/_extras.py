"""Optional packages: the extra of gsvis that installs each, and one error for a missing one.

Nothing here imports a package. A module that needs one calls `require` before the work begins.
"""

from __future__ import annotations

from importlib.util import find_spec

from gsvis.errors import MissingExtraError

__all__ = ["EXTRAS", "has", "missing", "project_of", "remedy_of", "require"]

EXTRAS = {
    "dask": "cluster",
    "distributed": "cluster",
    "flip_evaluator": "metrics",
    "fsspec": "cluster",
    "gsplat": "cuda",
    "lpips": "metrics",
    "matplotlib": "report",
    "open3d": "open3d",
    "pxr": "usd",
    "pycolmap": "train",
    "skimage": "mesh",
    "torch": "torch",
    "torchvision": "metrics",
}
"""The extra of pyproject.toml that installs each optional package."""


_PROJECTS = {"pxr": "usd-core", "skimage": "scikit-image"}


def project_of(package: str) -> str:
    """Return the name under which an optional package is installed.

    Examples:
        >>> project_of("skimage"), project_of("flip_evaluator")
        ('scikit-image', 'flip-evaluator')
    """
    return _PROJECTS.get(package, package.replace("_", "-"))


def remedy_of(package: str) -> str:
    """Return the command that installs an optional package.

    Examples:
        >>> print(remedy_of("matplotlib"))
        pip install "gsvis[report]"
    """
    return f'pip install "gsvis[{EXTRAS[package]}]"'


def has(package: str) -> bool:
    """Return whether a package is installed, without importing it."""
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False


def missing(what: str, package: str) -> MissingExtraError:
    """Return the error for a missing package.

    Args:
        what: Name of the command or option that needs the package.
        package: One of `EXTRAS`.
    """
    return MissingExtraError(what, project_of(package), EXTRAS[package])


def require(what: str, *packages: str) -> None:
    """Raise unless optional packages are installed.

    Args:
        what: Name of the command or option that needs them.
        packages: Names of modules, from `EXTRAS`.

    Raises:
        MissingExtraError: For the first package that is missing; names the extra.
    """
    for package in packages:
        if not has(package):
            raise missing(what, package)
