"""What all tests share: fixed Hypothesis profiles and the folder of real data."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable, Generator, Iterator
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.bare_plots import draw_bare_plots
from tests.longest import LONGEST

os.environ.setdefault("MPLBACKEND", "Agg")
if "GSVIS_CACHE" not in os.environ:  # not the folder of whoever runs the tests
    os.environ["GSVIS_CACHE"] = tempfile.mkdtemp(prefix="gsvis-cache-")
    atexit.register(shutil.rmtree, os.environ["GSVIS_CACHE"], ignore_errors=True)
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # workers of one machine do not spin against each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads spin after each product, a fifth of the time of tests
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")  # it colors each error, and tries many types
if "PYTEST_XDIST_WORKER" in os.environ:  # beside others, who have the same cores; what a test starts inherits it
    os.environ.setdefault("NUMBA_NUM_THREADS", "2")
    os.environ.setdefault("OMP_NUM_THREADS", "2")
    from tests.one_compiler import compile_once, locked  # here, because numba reads its threads when it is imported

    compile_once()

settings.register_profile(
    "gsvis",
    derandomize=True,
    deadline=None,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("gsvis")

_DEFAULT_REALDATA = Path(__file__).resolve().parents[2] / "shared" / "data"
TESTS = Path(__file__).resolve().parent


@pytest.fixture(scope="session")
def realdata() -> Path:
    """The folder of real scenes: `GSVIS_REALDATA`, or `../shared/data`; skips where there is none."""
    folder = Path(os.environ.get("GSVIS_REALDATA", _DEFAULT_REALDATA))
    if not folder.is_dir():
        pytest.skip("no real data: set GSVIS_REALDATA to the folder that holds scenes/ and photos/")
    return folder


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers share, for `tests.made_once` and spaces of real scenes."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def real_space(shared_folder: Path) -> Callable[[Any], Any]:
    """A function that returns the navigable space of a real scene, found once for all workers: it takes seconds."""
    from gsvis.scene.navigable import NavigableSpace
    from tests.known_spaces import remember_spaces

    def find(g: Any) -> Any:
        with remember_spaces(shared_folder):
            return NavigableSpace.from_scene(g)

    return find


@pytest.fixture(scope="session")
def warm_processes() -> Iterator[None]:
    """Fork the processes of pools from one that has imported what they need and started no thread.

    To import it anew is most of what they cost here; `tests/cli/test_pvs.py` has pools as they are.
    """
    if "forkserver" not in get_all_start_methods():  # Windows
        yield
        return
    context = get_context("forkserver")
    context.set_forkserver_preload(["gsvis.jobs.processes", "gsvis.pvs._tasks", "gsvis.pvs.build", "gsvis.world.build"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsvis.jobs.processes.get_context", lambda method: context)
        yield


@pytest.fixture(scope="module")
def coarse_plots() -> Iterator[None]:
    """Draw the plots of reports with few pixels."""
    from gsvis.report import theme

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(theme, "_DPI", 40)
        yield


@pytest.fixture(scope="module")
def bare_plots(coarse_plots: None) -> Iterator[None]:
    """Draw the plots of reports without axes and words, which take most of the time."""
    with draw_bare_plots():
        yield


@pytest.fixture(scope="session")
def blank() -> bytes:
    """A plot without any content, as PNG bytes."""
    from gsvis.report import theme

    return theme.draw_png(lambda axes, colors: axes.set_axis_off())


@pytest.fixture
def blank_plots(monkeypatch: pytest.MonkeyPatch, blank: bytes) -> None:
    """Leave the plots of reports blank, for tests that look at none: drawing takes most of a small report's time."""
    monkeypatch.setattr("gsvis.report.theme.draw_png", lambda *arguments: blank)


def pytest_xdist_auto_num_workers() -> int:
    """Two workers more than cores that this process may use, or as many as PYTEST_XDIST_AUTO_NUM_WORKERS says.

    While some wait for a browser, a server or a kernel that another compiles, the others work.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return int(os.environ.get("PYTEST_XDIST_AUTO_NUM_WORKERS") or cores + 2)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Collect without looking for garbage, and set aside what stays: later looks would pass over it each time."""
    _begin_elsewhere(session.config)
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()
        gc.set_threshold(10_000, 20, 20)  # looks took 3% of the time of the tests


def _begin_elsewhere(config: pytest.Config) -> None:
    """Let each worker begin to collect all tests at another file: in a fresh clone it finds the others compiled."""
    worker, count = (os.environ.get(f"PYTEST_XDIST_WORKER{name}", "") for name in ("", "_COUNT"))
    if worker and config.args == config.getini("testpaths"):
        files = sorted(map(str, TESTS.rglob("test_*.py")))
        first = int(worker.removeprefix("gw")) * len(files) // int(count)
        config.args = files[first:] + files[:first]


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Generator[None, object, object]:
    """Sort the files. In a fresh clone, let one worker at a time look for constants in all sources.

    Hypothesis does that here, in two seconds, and keeps what it finds: the others read it.
    """
    _sort_files(items)
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return (yield)
    with locked("constants"):
        return (yield)


def _sort_files(items: list[pytest.Item]) -> None:
    """Begin with the longest files: a worker must not be left alone with one at the end. Mix the others.

    In the order of their names those that wait for a browser would run side by side, and no core would work.
    """
    places = {TESTS / name: (place, 0) for place, name in enumerate(LONGEST)}
    for path in {item.path for item in items} - places.keys():
        places[path] = (len(LONGEST), zlib.crc32(os.path.relpath(path, TESTS).encode()))
    items.sort(key=lambda item: (places[item.path], item.path))
