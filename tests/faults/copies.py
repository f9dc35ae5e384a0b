"""Run tests in copies of the tree, each in a process of its own.

A copy consists of hard links, so that it takes no time and is compiled already. Third-party modules
are imported before processes are forked, so that each process imports only the project.
"""

import contextlib
import os
import shutil
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
FORK = get_context("fork")
_NOT_COPIED = shutil.ignore_patterns(
    ".git", ".venv", ".*_cache", ".hypothesis", "out", "dist", "_build"
)
_PRELOADED = (
    *("numpy", "scipy.linalg", "scipy.sparse.linalg", "scipy.special"),
    *("hypothesis", "pydantic", "can", "canopen"),
)
_PRELOADED_FOR_MANY = (
    *("scipy.optimize", "scipy.interpolate", "scipy.signal", "scipy.ndimage"),
    *("pint", "rich.console", "matplotlib.figure"),
)


def prepare(*, are_many: bool) -> None:
    """Limit linear algebra to one thread, and import what most tests need (or many of them)."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"  # before numpy loads
    for module in (*_PRELOADED, *(_PRELOADED_FOR_MANY if are_many else ())):
        import_module(module)


@contextlib.contextmanager
def sound_copy() -> Iterator[Path]:
    """Copy this checkout into a temporary folder, of which workers make their own copies."""
    with TemporaryDirectory() as folder:
        yield Path(shutil.copytree(ROOT, Path(folder) / "sound", ignore=_NOT_COPIED))


@contextlib.contextmanager
def changed_copy(sound: Path, texts: Mapping[str, str]) -> Iterator[Path]:
    """Give some files of this worker's copy other texts, and restore them afterwards."""
    folder = _own_copy(sound)
    try:
        for file, text in texts.items():
            (folder / file).unlink()  # or the sound tree would change as well
            (folder / file).write_text(text, "utf-8")
        yield folder
    finally:
        for file in texts:
            (folder / file).unlink(missing_ok=True)
            (folder / file).hardlink_to(sound / file)


@cache
def _own_copy(sound: Path) -> Path:
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    folder = sound.with_name(str(os.getpid()))
    return Path(shutil.copytree(sound, folder, symlinks=True, copy_function=os.link))


class Outcomes:
    """A pytest plugin: how each test ended, which is "passed" or the first line of its failure."""

    def __init__(self) -> None:
        self.by_test: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note the result of a phase of a test; a failure in any phase counts."""
        crash = getattr(report.longrepr, "reprcrash", None)
        if report.failed:
            self.by_test[report.nodeid] = crash.message.split("\n")[0] if crash else "failed"
        elif report.when == "call":
            self.by_test[report.nodeid] = report.outcome


def run_tests(
    folder: Path,
    tests: Sequence[str],
    *,
    limit: float,
    options: Sequence[str] = (),
    plugins: Sequence[Any] = (),
) -> dict[str, str] | None:
    """Run tests in a tree, in a process of their own; return how each ended.

    limit: seconds after which the process is killed, with all processes that it has started; the
    result is then None.
    """
    receiving, sending = FORK.Pipe(duplex=False)
    run = partial(_run_pytest, folder, [*options, *tests], plugins, sending)
    process = FORK.Process(target=run)
    process.start()
    sending.close()
    outcomes: dict[str, str] | None
    try:
        outcomes = receiving.recv() if receiving.poll(limit) else None
    except EOFError:
        outcomes = {}
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid or 0, signal.SIGKILL)
    process.join()
    return outcomes


def _run_pytest(
    folder: Path, arguments: Sequence[str], plugins: Sequence[Any], sending: Connection
) -> None:
    os.setsid()
    os.chdir(folder)
    os.environ["PYTHONPATH"] = str(folder)
    sys.path[0] = str(folder)
    null = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(null, number)
    outcomes = Outcomes()
    options = ["-q", "-p", "no:cacheprovider", "--assert=plain"]
    pytest.main([*options, *arguments], plugins=[outcomes, *plugins])
    sending.send(outcomes.by_test)
