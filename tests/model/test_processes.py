"""Parallel tasks on processes and clusters, the C kernels, versions, and choices of the best."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import model.compiled
from build_libraries import Library, compile_library, kernel_library
from model import caching, processes
from model.arrays import NEARLY, best_along, best_of
from model.caching import NUMERICS_VERSION, code_version
from model.compiled import kernels as compiled_kernels
from model.compiled.kernels import kernels, processor_features, why_slow
from model.compiled.versions import Version, versions
from model.errors import InputError
from model.processes import on_cluster, on_processes
from reference_figures import RECORD, reference_figures

# Processes


def die(shared: int, task: int) -> None:
    """End the process immediately, as the system does when memory is short."""
    os._exit(shared + task)


def test_process_that_dies_is_an_error() -> None:
    """With a remedy."""
    with pytest.raises(InputError, match=r"died.*--workers"):
        list(on_processes(2, die, 1, {0: 8}))


def wait_a_minute(shared: int, task: int) -> int:
    """Return the first task's number; others take a minute."""
    if task:
        time.sleep(60)
    return task


def test_workers_end_amid_their_tasks_when_the_caller_stops() -> None:
    """As on Ctrl-C: the second task would take a minute."""
    results = on_processes(2, wait_a_minute, 1, {0: 0, 1: 1})
    assert next(results) == (0, 0)

    start = time.monotonic()
    with suppress(KeyboardInterrupt):
        results.throw(KeyboardInterrupt)

    assert time.monotonic() - start < 40


def die_with_the_program(shared: int, task: int) -> None:
    """Kill the program, and go on."""
    os.kill(os.getppid(), signal.SIGKILL)


def test_workers_end_with_a_program_that_is_killed() -> None:
    """Its output ends: a worker that waits for tasks would hold it open."""
    program = (
        "from model.processes import on_processes; from test_processes import *\n"
        "if __name__ == '__main__': list(on_processes(2, die_with_the_program, 1, {0: 1}))"
    )
    tests = Path(__file__).parents[1]
    folders = (tests / "model", tests / "programs", tests / "support")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}

    completed = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, env=environment, timeout=60
    )

    assert completed.returncode == -signal.SIGKILL


# Versions

REMEDY = "increase NUMERICS_VERSION and run python tests/programs/reference_figures.py"


def test_numerics_version_changes_when_figures_change() -> None:
    """Recorded figures are those of this code to rounding, and of this NUMERICS_VERSION."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))

    figures = reference_figures()

    assert record["numerics_version"] == NUMERICS_VERSION, REMEDY
    assert figures.keys() == record["figures"].keys()
    for name, values in record["figures"].items():
        tolerance = {"atol": 2e-3} if name.endswith("_db") else {"rtol": 2e-6}
        np.testing.assert_allclose(figures[name], values, err_msg=f"{name}: {REMEDY}", **tolerance)


def test_code_version_changes_with_the_source(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Another space in a module is another version."""
    source = tmp_path / "inner" / "module.py"
    source.parent.mkdir()
    monkeypatch.setattr(caching.resources, "files", lambda package: tmp_path)

    source.write_text("a = 1", encoding="utf-8")
    first = code_version.__wrapped__()
    source.write_text("a =  1", encoding="utf-8")
    second = code_version.__wrapped__()

    assert second != first


# Clusters


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A scheduler with two workers, each a process of its own; no dashboard.

    Forked off a process that has loaded Dask: loading takes each a second.
    """
    import dask
    from distributed import LocalCluster

    forking = dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"})
    with (
        forking,
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
    ):
        yield cluster.scheduler_address


def test_cluster_yields_every_result(address: str) -> None:
    """Each task once, with its number, solved with the shared argument."""
    results = dict(on_cluster(address, divmod, 17, {0: 1, 1: 2, 2: 3, 3: 4}))

    assert results == {0: (17, 0), 1: (8, 1), 2: (5, 2), 3: (4, 1)}


def allow_failures(count: int, dask_scheduler: Any) -> None:
    """Set how many workers a task may cost, on the scheduler."""
    dask_scheduler.allowed_failures = count


@pytest.mark.long
def test_cluster_gives_up_on_a_task_that_kills_its_workers(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when memory is too short for a task."""
    from distributed import Client

    monkeypatch.setattr(processes, "run_same_code", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    with Client(address, set_as_default=False) as client:
        client.run_on_scheduler(allow_failures, 0)

    with pytest.raises(InputError, match="memory"):
        dict(on_cluster(address, divmod, 1, {0: 1}))


NOWHERE = "tcp://127.0.0.1:1"


def test_cluster_without_workers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not waited for forever."""
    from distributed import LocalCluster

    monkeypatch.setattr(processes, "SCHEDULER_TIMEOUT", 0.2)
    with (
        LocalCluster(n_workers=0, dashboard_address=":0") as empty,
        pytest.raises(InputError, match="has no workers"),
    ):
        dict(on_cluster(empty.scheduler_address, divmod, 1, {0: 1}))


def test_cluster_without_a_scheduler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error has the address; without Dask it names the extra to install."""
    monkeypatch.setattr(processes, "SCHEDULER_TIMEOUT", 0.2)

    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "):
        dict(on_cluster(NOWHERE, divmod, 1, {0: 1}))

    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"\[cluster\]"):
        dict(on_cluster(NOWHERE, divmod, 1, {0: 1}))


def test_every_worker_checks_its_code() -> None:
    """Nothing is called on a worker that joins later, with other code."""
    with pytest.raises(InputError, match="same era-haptics"):
        processes.run_same_code("0.0.1+123456789abc", pytest.fail, "called")


# Choices of the best


def expect_always(choose: Callable[[np.ndarray], object], scores: Sequence[Any], best: Any) -> None:
    """Require a choice whatever rounding adds to the scores."""
    for seed in range(20):
        rounding = np.random.default_rng(seed).uniform(-1, 1, np.shape(scores))
        rounded = np.array(scores) * (1 + NEARLY / 4 * rounding)
        assert np.array_equal(choose(rounded), best), seed


@pytest.mark.parametrize(
    "scores",
    [[1.0, 3.0, 2.0, 3.0], [-5.0, -1.0, -2.0, -1.0], [0.0, np.inf, 1.0, np.inf]],
    ids=["positive", "negative", "infinite"],
)
def test_first_of_nearly_equal_best_scores_is_chosen(scores: list[float]) -> None:
    """Of any sign; also along an axis."""
    expect_always(best_of, scores, 1)
    expect_always(lambda rounded: best_along(rounded[None], axis=1), scores, [1])
    expect_always(lambda rounded: best_along(rounded[::-1, None], axis=0), scores, [0])


# Kernels

RUNNABLE = [version for version in versions() if version.features.keys() <= processor_features()]
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.mark.long
@pytest.mark.parametrize("version", RUNNABLE, ids=lambda version: version.name)
def test_knots_are_within_the_stroke_and_their_memory(version: Version, tmp_path: Path) -> None:
    """Of 28 random tones, huge, silent and undefined ones too, and without memory for one.

    Some reach the bound of full stroke, and none is beyond it. Sanitizers watch the memory.
    """
    program = tmp_path / "harness"
    folder = Path(*model.compiled.__path__)
    source = Path(__file__).with_name("knots_harness.c")
    flags = (*kernel_library(version).flags, *SANITIZERS, f"-I{folder}")
    subprocess.run(["cc", *flags, "-o", str(program), str(source), "-lm"], check=True)

    completed = subprocess.run([program], check=True, capture_output=True, text=True)

    assert completed.stdout.strip() == "1.000"
    assert completed.stderr == ""


@pytest.fixture
def libraries(tmp_path: Path) -> Path:
    """A folder with a library per version, whose function `lanes` returns the version's lanes."""
    for version in versions():
        source = tmp_path / f"{version.name}.c"
        source.write_text(f"int lanes(void) {{ return {version.lanes}; }}")
        compile_library(Library(version.file, (source,), (), ()), tmp_path / version.file)
    return tmp_path


AVX2 = ("AVX2", "FMA3")
AVX512 = (*AVX2, "AVX512F", "AVX512DQ", "AVX512VL")


@pytest.mark.parametrize(
    ("features", "missing", "expected"),
    [
        ((), (), 4),
        (("AVX2",), (), 4),
        (AVX2, (), 8),
        (AVX512, (), 16),
        (AVX512, ("avx512",), 8),
        (AVX2, ("avx2", "plain"), None),
    ],
)
@pytest.mark.needs("cc")
@pytest.mark.skipif(len(versions()) == 1, reason="this architecture has one version of the kernels")
def test_kernels_are_the_fastest_that_the_processor_can_run(
    features: tuple[str, ...],
    missing: tuple[str, ...],
    expected: int | None,
    libraries: Path,
    without_kernels: Callable[[], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Among the existing libraries; without one, a sentence states that answers are slow."""
    without_kernels()
    for name in missing:
        (libraries / f"kernels-{name}.so").unlink()
    monkeypatch.setattr(compiled_kernels, "KERNEL_FOLDER", libraries)
    monkeypatch.setattr(compiled_kernels, "processor_features", lambda: frozenset(features))

    loaded = kernels()

    if expected is None:
        assert loaded is None
        assert why_slow()
    else:
        assert loaded.library.lanes() == loaded.lanes == expected
        assert why_slow() is None


def test_damaged_kernels_are_not_used(
    without_kernels: Callable[[], None], caplog: pytest.LogCaptureFixture
) -> None:
    """A warning names the file, and numpy computes."""
    without_kernels()
    for version in versions():
        (compiled_kernels.KERNEL_FOLDER / version.file).write_bytes(b"no library")

    assert kernels() is None

    assert "kernels-" in caplog.text
    assert why_slow()
