"""Parallel tasks on processes and clusters, the C kernels, versions, and small helpers.

The kernels are chosen by processor; their memory is judged under sanitizers.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import model.compiled
from build_libraries import Library, compile_library, kernel_library
from model import caching, processes
from model.arrays import NEARLY, best_along, best_by, best_first, best_of, best_rows, ranked_by
from model.caching import NUMERICS_VERSION, code_version
from model.compiled import kernels as compiled_kernels
from model.compiled.kernels import kernels, processor_features, why_slow
from model.compiled.versions import Version, versions
from model.errors import InputError
from model.processes import on_cluster, on_processes
from reference_figures import RECORD, reference_figures


def die(shared: int, task: int) -> None:
    """End the process at once, as the system does when memory is short."""
    os._exit(shared + task)


def test_a_process_that_dies_is_an_error() -> None:
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
    stopped = time.monotonic()
    with suppress(KeyboardInterrupt):
        results.throw(KeyboardInterrupt)
    assert time.monotonic() - stopped < 40


def die_with_the_program(shared: int, task: int) -> None:
    """Kill the program, and go on."""
    os.kill(os.getppid(), signal.SIGKILL)


def test_workers_end_with_a_program_that_is_killed() -> None:
    """Its output ends: a worker that waits for tasks would hold it open."""
    program = (
        "from model.processes import on_processes; from test_processes import *\n"
        "if __name__ == '__main__': list(on_processes(2, die_with_the_program, 1, {0: 1}))"
    )
    folders = (Path(__file__).parent, Path(__file__).parents[1] / "support")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, env=environment, timeout=60
    )
    assert done.returncode == -signal.SIGKILL


REMEDY = "increase NUMERICS_VERSION and run python tests/support/reference_figures.py"


def test_numerics_version_changes_when_figures_change():
    """Recorded figures are those of this code to rounding, and of this NUMERICS_VERSION."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    assert record["numerics_version"] == NUMERICS_VERSION, REMEDY
    found = reference_figures()
    assert found.keys() == record["figures"].keys()
    for name, values in record["figures"].items():
        tolerance = {"atol": 2e-3} if name.endswith("_db") else {"rtol": 2e-6}
        np.testing.assert_allclose(found[name], values, err_msg=f"{name}: {REMEDY}", **tolerance)


def test_code_version_changes_with_the_source(monkeypatch, tmp_path):
    """One more space in a module is another version."""
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "module.py").write_text("a = 1", encoding="utf-8")
    monkeypatch.setattr(caching.resources, "files", lambda package: tmp_path)
    first = code_version.__wrapped__()
    (tmp_path / "inner" / "module.py").write_text("a =  1", encoding="utf-8")
    assert code_version.__wrapped__() != first


TASKS = {number: number for number in range(6)}


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A scheduler with two workers, each a process of its own; no dashboard.

    Forked off a process that has loaded Dask: loading takes each a second.
    """
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as running,
    ):
        yield running.scheduler_address


def test_cluster_yields_every_result_of_other_processes(address: str) -> None:
    """Each task once, with its number, solved elsewhere with what all of them share."""
    found = dict(on_cluster(address, divmod, 17, {n: n + 1 for n in TASKS}))
    assert found == {n: (17 // (n + 1), 17 % (n + 1)) for n in TASKS}
    assert os.getpid() not in dict(on_cluster(address, _process, None, TASKS)).values()


def _process(shared: None, task: int) -> int:
    return os.getpid()


@pytest.mark.long
def test_cluster_gives_up_on_a_task_that_kills_its_workers(address: str, monkeypatch) -> None:
    """A task that ends whichever worker takes it, as one does for which memory is too short."""
    from distributed import Client

    monkeypatch.setattr(processes, "run_same_code", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    with Client(address, set_as_default=False) as client:
        client.run_on_scheduler(_allow_failures, 0)
    with pytest.raises(InputError, match="memory"):
        dict(on_cluster(address, divmod, 1, {0: 1}))


def _allow_failures(count, dask_scheduler):
    """How many workers a task may cost, on the scheduler."""
    dask_scheduler.allowed_failures = count


def test_cluster_without_workers_or_scheduler_is_refused(monkeypatch) -> None:
    """Waiting for ever for a worker to come is no answer.

    Nothing listens at an address: the error says so, and how to start one; without Dask it names
    the extra to install.
    """
    from distributed import LocalCluster

    monkeypatch.setattr(processes, "SCHEDULER_TIMEOUT", 0.2)
    nowhere = "tcp://127.0.0.1:1"
    with LocalCluster(n_workers=0, dashboard_address=":0") as empty:
        for address, said in (
            (empty.scheduler_address, "has no workers"),
            (nowhere, r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "),
        ):
            with pytest.raises(InputError, match=said):
                dict(on_cluster(address, divmod, 1, TASKS))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"\[cluster\]"):
        dict(on_cluster(nowhere, divmod, 1, TASKS))


def test_every_worker_checks_its_code() -> None:
    """Nothing is called on a worker that joins later, with other code."""
    with pytest.raises(InputError, match="same era-haptics"):
        processes.run_same_code("0.0.1+123456789abc", pytest.fail, "called")


ITEMS = "abcde"
ALIKE = ([1.0, 3.0, 2.0, 3.0], [-5.0, -1.0, -2.0, -1.0], [0.0, np.inf, 1.0, np.inf])


@pytest.mark.parametrize(
    ("choose", "scores", "expected"),
    [
        *((best_of, scores, 1) for scores in ALIKE),
        *((lambda s: best_along(s[None], axis=1).tolist(), scores, [1]) for scores in ALIKE),
        (
            lambda s: best_along(np.column_stack([s, s[::-1]]), axis=0).tolist(),
            [1.0, 3.0, 2.0, 3.0],
            [1, 0],
        ),
        (lambda s: best_first(s).tolist(), [2.0, 7.0, 2.0, 0.0, 7.0], [1, 4, 0, 2, 3]),
        (lambda s: best_first(s).tolist(), [1.0, np.inf, -np.inf, np.inf], [1, 3, 0, 2]),
        (lambda s: best_first(s).tolist(), [], []),
        (
            lambda s: best_rows(s, 3).T.tolist(),
            [[2.0, -4.0], [7.0, -1.0], [2.0, -1.0], [0.0, -9.0], [7.0, -4.0]],
            [[1, 4, 0], [1, 2, 0]],
        ),
        (
            lambda s: best_by(ITEMS, lambda item: s[ITEMS.index(item)]),
            [2.0, 1.0, 2.0, 3.0, 3.0],
            "d",
        ),
        (
            lambda s: "".join(ranked_by(ITEMS, lambda item: s[ITEMS.index(item)])),
            [2.0, 1.0, 2.0, 3.0, 3.0],
            "deacb",
        ),
        # What is better by more than rounding, however little more.
        (best_of, [1.0, 1 + 3 * NEARLY], 1),
        (lambda s: best_first(s).tolist(), [1.0, 1 + 3 * NEARLY], [1, 0]),
    ],
)
def test_the_first_of_the_nearly_equal_best_is_chosen(choose, scores, expected):
    """Whatever rounding adds to equal scores, of any sign; of none there is an empty order."""
    for seed in range(20):
        rounding = np.random.default_rng(seed).uniform(-1, 1, np.shape(scores))
        assert choose(np.array(scores) * (1 + NEARLY / 4 * rounding)) == expected


RUNNABLE = [each for each in versions() if each.features.keys() <= processor_features()]
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.mark.long
@pytest.mark.parametrize("version", RUNNABLE, ids=lambda each: each.name)
def test_knots_are_within_the_stroke_and_their_memory(version: Version, tmp_path: Path) -> None:
    """Of 28 random tones, huge, silent and undefined ones too, and without memory for one.

    Some reach the bound of full stroke, and none is beyond it.
    """
    program = tmp_path / "harness"
    folder, harness = Path(*model.compiled.__path__), Path(__file__).with_name("knots_harness.c")
    files = (f"-I{folder}", "-o", str(program), str(harness), "-lm")
    flags = kernel_library(version).flags
    subprocess.run(["cc", *flags, *SANITIZERS, *files], check=True)
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "1.000"
    assert not done.stderr


@pytest.fixture
def libraries(tmp_path: Path) -> Path:
    """A folder with a library per version, whose function `lanes` returns the version's lanes."""
    for version in versions():
        source = tmp_path / f"{version.name}.c"
        source.write_text(f"int lanes(void) {{ return {version.lanes}; }}")
        library = Library(version.file, (source,), (), ())
        compile_library(library, tmp_path / version.file)
    return tmp_path


@pytest.mark.parametrize(
    ("features", "missing", "expected"),
    [
        ((), (), 4),
        (("AVX2",), (), 4),
        (("AVX2", "FMA3"), (), 8),
        (("AVX2", "FMA3", "AVX512F", "AVX512DQ", "AVX512VL"), (), 16),
        (("AVX2", "FMA3", "AVX512F", "AVX512DQ", "AVX512VL"), ("avx512",), 8),
        (("AVX2", "FMA3"), ("avx2", "plain"), None),
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
    """Among the libraries that are there; without one, a sentence says that answers are slow."""
    without_kernels()
    for name in missing:
        (libraries / f"kernels-{name}.so").unlink()
    monkeypatch.setattr(compiled_kernels, "KERNEL_FOLDER", libraries)
    monkeypatch.setattr(compiled_kernels, "processor_features", lambda: frozenset(features))
    loaded = kernels()
    assert (loaded and loaded.library.lanes()) == expected
    assert (loaded and loaded.lanes) == expected
    assert (why_slow() is None) == (expected is not None)


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
