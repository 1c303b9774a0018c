"""What keeps compiling short: no checks of slices in a kernel, and one version of a kernel for any caller."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gsvis import _check
from gsvis.color._kernels import sh as _kernels_sh
from gsvis.color._kernels import srbf as _kernels_srbf
from gsvis.color.evaluate import Evaluator
from gsvis.render import GaussianTensors, rasterize
from gsvis.render._kernels import order as _kernels_order
from gsvis.render._kernels import project as _kernels_project
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from tests.color.samples import random_colors

ROOT = Path(__file__).parents[1]
COMPILES = re.compile(r"\b(njit|kernel|inner)\b")
KERNELS = sorted((ROOT / "gsvis").rglob("_kernels/*.py"))


def has_slice(node: ast.AST) -> bool:
    return isinstance(node, ast.Subscript) and any(isinstance(part, ast.Slice) for part in ast.walk(node.slice))


def slices_to_slices(source: str) -> list[int]:
    """Lines in a compiled function that assign one slice to another."""
    found = []
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef) and any(
            COMPILES.search(ast.unparse(d)) for d in function.decorator_list
        ):
            for node in ast.walk(function):
                if isinstance(node, ast.Assign) and has_slice(node.value) and any(map(has_slice, node.targets)):
                    found.append(node.lineno)
    return found


def test_such_lines_are_found() -> None:
    assert slices_to_slices("@njit(cache=True)\ndef f(a, b, n):\n    a[:n] = b[:n]\n    a[:n] = 0.0\n") == [3]
    assert slices_to_slices("def f(a, b, n):\n    a[:n] = b[:n]\n") == []


def test_no_slice_is_assigned_to_a_slice() -> None:
    found = {str(path.relative_to(ROOT)): slices_to_slices(path.read_text(encoding="utf-8")) for path in KERNELS}
    assert {name: lines for name, lines in found.items() if lines} == {}


def test_no_loop_is_compiled_three_times_over() -> None:
    for path in KERNELS:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for decorator in getattr(node, "decorator_list", ()):
                assert "parallel" not in ast.unparse(decorator), f"{path}:{decorator.lineno}: use threads.py or `share`"


def test_read_only_views_share_memory_and_leave_the_arrays_alone() -> None:
    array = np.arange(3.0)
    (view,) = _check.read_only(array)
    array[0] = 7.0
    assert view[0] == 7.0
    assert array.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        view[0] = 1.0


def draw() -> tuple[Callable[[], object], Callable[[], object], tuple[object, ...]]:
    """A scene, whose arrays cannot be written, and tensors, whose arrays can."""
    rng = np.random.default_rng(0)
    shape = rng.normal(size=(9, 3)), rng.normal(size=(9, 4)), np.full((9, 3), 0.3), np.full(9, 0.5)
    g = Gaussians(*shape, rng.normal(size=(9, 1, 3)))
    view = Cameras.orbit((0.0, 0.0, 0.0), 4.0, 1, width=16, height=16)
    tensors = GaussianTensors.from_gaussians(g, torch.float32)
    kernels = _kernels_project.project.kernel, _kernels_order.order_ties.kernel, _kernels_sh.colors_from_sh.kernel
    return lambda: rasterize(g, view), lambda: rasterize(tensors, view), kernels


def evaluate() -> tuple[Callable[[], object], Callable[[], object], tuple[object, ...]]:
    """Centers that can be written and that cannot."""
    rng = np.random.default_rng(0)
    maker, means = Evaluator(random_colors(rng, 20, "hsl")), rng.normal(size=(20, 3)).astype(np.float32)
    (fixed,) = _check.read_only(means)
    eye = np.zeros(3)
    return lambda: maker.colors(means, eye), lambda: maker.colors(fixed, eye), (_kernels_srbf.colors_from_eye.kernel,)


@pytest.mark.parametrize("case", [draw, evaluate])
def test_a_kernel_has_one_version_for_arrays_that_can_be_written_and_that_cannot(
    case: Callable[[], tuple[Callable[[], object], Callable[[], object], tuple[object, ...]]],
) -> None:
    one, other, kernels = case()
    one()
    before = [len(kernel.signatures) for kernel in kernels]  # type: ignore[attr-defined]
    other()
    assert [len(kernel.signatures) for kernel in kernels] == before  # type: ignore[attr-defined]
    assert min(before) > 0
