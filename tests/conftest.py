"""What all tests share: one thread for linear algebra, the paper's plate, the order of files."""

import fcntl
import gc
import os
import random
import signal
from collections.abc import Generator, Iterator
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from types import SimpleNamespace

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # before numpy loads: two threads are slower here, and erratic

# Programs under test are interrupted, also where a shell has started the suite in the background.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

from build_libraries import BuildError, tree_libraries, update  # noqa: E402
from cases import COLLECTED, SLOWEST  # noqa: E402
from kit.plates import make_paper_rig  # noqa: E402
from model.reduction import free_plate  # noqa: E402
from model.rig.rig import Rig  # noqa: E402
from model.rig.rig_file import example_rig_path, load_rig  # noqa: E402
from model.table.table_file import cached_table  # noqa: E402
from processes.installed import needs  # noqa: E402
from processes.patient_daemon import allow_long_watchdogs, wait_long  # noqa: E402
from registry import threads  # noqa: E402

# Forty examples of each property, a hundred without it, however long a busy machine takes.
settings.register_profile(
    "short", max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("short")


free_plate.FiniteElementModes = lru_cache(12)(free_plate.FiniteElementModes)
"""Free plates are solved once in a process: hundreds of tests are of the same ones."""

threads.gc = SimpleNamespace(**vars(gc) | {"collect": partial(gc.collect, 1)})  # type: ignore[attr-defined]
"""A daemon in a test starts without visiting all objects of the suite: a fifth of a second each."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option by which `make test-changed` runs the nearest files first."""
    parser.addoption(
        "--in-order", action="store_true", help="run files in the order in which they are named"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Compile the C libraries whose sources have changed; without a compiler, numpy is tested."""
    is_worker = hasattr(config, "workerinput")
    if not is_worker:
        with suppress(BuildError):
            update(tree_libraries())


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One worker more than processors: many tests wait for timeouts or for other processes."""
    return len(os.sched_getaffinity(0)) + 1


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip files without a test that is asked for by its mark: importing all takes seconds."""
    is_asked = config.option.markexpr.startswith("real_time")
    if not is_asked or collection_path.suffix != ".py":
        return None
    return True if "mark.real_time" not in collection_path.read_text("utf-8") else None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Visit folders in another order in each worker: each file is compiled by one, not by all."""
    report = yield
    if isinstance(collector, pytest.Dir):
        random.Random(os.environ.get("PYTEST_XDIST_WORKER", "")).shuffle(report.result)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect no garbage while tests are collected, and never visit what was: hardly any is."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run the slowest files first, unless `--in-order`; the order within each file stays."""
    config.stash[COLLECTED] = {item.nodeid for item in items}
    if config.getoption("--in-order", default=False):
        return
    place = {name: number for number, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: (place.get(item.path.name, len(SLOWEST)), item.path))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test, before its fixtures, for what its marks `needs` name and the machine lacks."""
    for mark in item.iter_markers("needs"):
        needs(*mark.args)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    """Collect garbage once, whose errors count; pytest does it five times, of all that is left."""
    gc.collect()
    gc.freeze()


CONFIRM_TIMEOUT = 10.0  # s; in place of 0.3 s, for a stop


@pytest.fixture
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hosts and simulated amplifiers in this process that wait for each other for long."""
    wait_long(monkeypatch, reply_timeout=1.0)
    allow_long_watchdogs(monkeypatch)
    # Tests that only start programs need not load the drivers.
    from drivers.host.amplifier import Amplifier

    monkeypatch.setitem(Amplifier.stop.__kwdefaults__, "timeout", CONFIRM_TIMEOUT)
    monkeypatch.setattr("drivers.host.group.CONFIRM_TIMEOUT", CONFIRM_TIMEOUT)


@pytest.fixture
def plain_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures drawn in a moment, for commands that write some beside what is tested."""
    monkeypatch.setattr("matplotlib.figure.Figure.set_layout_engine", lambda *_, **__: None)
    monkeypatch.setattr("model.figures.style.DPI", 20)


@pytest.fixture
def assumed_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Costs of tolerances in checks of rigs, without the table from which they are computed."""
    from model.study.promise_cost import ToleranceCosts

    costs = ToleranceCosts(20.0, {"weather": 1.0, "foreign_mass": 1.0})
    monkeypatch.setattr("controller.rig_file_check.uncertainty_costs", lambda rig: costs)


@pytest.fixture(scope="session")
def rig() -> Rig:
    """The paper's plate as its file has it."""
    return load_rig(example_rig_path())


@pytest.fixture(scope="session")
def coarse_rig() -> Rig:
    """The paper's own mesh, 12x9."""
    return make_paper_rig(12, 9)


@pytest.fixture(scope="session")
def table_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache folder of all workers, in which one of them has built the example's table."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "table-cache"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock, pytest.MonkeyPatch.context() as patch:
        fcntl.flock(lock, fcntl.LOCK_EX)
        patch.setenv("XDG_CACHE_HOME", str(folder))
        cached_table(load_rig(example_rig_path()))
    return folder
