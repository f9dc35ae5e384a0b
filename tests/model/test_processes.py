"""Parallel tasks on processes and clusters, the compiled library, versions, and small helpers.

The library is built, cached, and refused if damaged; its memory is judged under sanitizers.
"""

import ctypes
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import model.compiled
from model import caching, processes
from model.arrays import NEARLY, best_along, best_by, best_first, best_of, best_rows, ranked_by
from model.caching import NUMERICS_VERSION, code_version
from model.compiled import kernels as library_cache
from model.compiled.kernels import (
    Version,
    compile_library,
    kernels,
    processor_features,
    versions,
    why_slow,
)
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
    subprocess.run(["cc", *version.flags, *SANITIZERS, *files], check=True)
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "1.000"
    assert not done.stderr


_PROGRAM = """
import sys
import time
from pathlib import Path
from model.compiled.kernels import kept_library
found = kept_library("seven", [Path(sys.argv[1])], flags=(), what="seven")
print(found.seven())
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The cache folder of these tests."""
    return tmp_path / "cache" / "era-haptics"


def seven(folder: Path) -> int:
    """What a function that returns seven gives, compiled or kept, in a process of its own."""
    source = folder.parents[1] / "seven.c"
    source.write_text("int seven(void) { return 7; }")
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(source)],
        env=os.environ | {"XDG_CACHE_HOME": str(folder.parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    return int(done.stdout)


def forge(path: Path, *, mode: int = 0o755, checksum_mode: int = 0o644) -> None:
    """Put a library there that returns eight, with its checksum, of these rights."""
    source = path.with_suffix(".c")
    source.write_text("int seven(void) { return 8; }")
    compile_library(path, [source], flags=(), what="eight")
    source.unlink()
    path.chmod(mode)
    checksum = path.with_name(f"{path.name}.sha256")
    checksum.write_text(hashlib.sha256(path.read_bytes()).hexdigest())
    checksum.chmod(checksum_mode)


def exchange(path: Path) -> None:
    """Put another library there, without its checksum."""
    forge(path)
    path.with_name(f"{path.name}.sha256").unlink()


def test_library_unsafe_or_not_whole_is_compiled_again(folder: Path) -> None:
    """It is not loaded, and the next process finds a good one.

    The first page alone is left after a power failure: what is mapped beyond it is SIGBUS. Every
    user may have written a library or its checksum.
    """
    assert seven(folder) == 7
    (path,) = folder.glob("*.so")
    good = path.read_bytes()
    for damage in (
        lambda: os.truncate(path, 4096),
        lambda: forge(path, mode=0o777),
        lambda: forge(path, checksum_mode=0o666),
        lambda: exchange(path),
    ):
        damage()
        assert seven(folder) == 7
        assert path.read_bytes() == good
    forge(path)  # safe and whole: what is kept is loaded
    assert seven(folder) == 8


@pytest.mark.long
def test_folder_in_which_others_write_is_not_used(folder: Path) -> None:
    """Neither the folder nor one above it, unless it is sticky as /tmp; no library is left."""
    assert seven(folder) == 7
    (path,) = folder.glob("*.so")
    forge(path)
    for each in (folder, folder.parent):
        each.chmod(0o777)
        assert seven(folder) == 7
        each.chmod(0o700)
    assert seven(folder) == 8
    folder.parent.chmod(0o1777)
    assert seven(folder) == 8


@pytest.mark.long
def test_link_in_a_folder_of_others_is_not_followed(folder: Path) -> None:
    """They could lead it to any library that the user keeps; one of the user's own is followed."""
    kept = folder.parents[1] / "kept"
    kept.mkdir(mode=0o700)
    folder.parent.symlink_to(kept)
    assert seven(folder) == 7
    (path,) = folder.glob("*.so")
    forge(path)
    assert seven(folder) == 8
    shared = folder.parents[1] / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    folder.parent.rename(shared / "link")
    folder.parent.symlink_to(shared / "link")
    assert seven(folder) == 7


def test_files_of_another_user_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root's are not: who could write them need not."""
    path = tmp_path / "library.so"
    path.touch(0o755)
    library_cache.check_own(path)
    owner = os.geteuid()
    if owner:
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    else:
        os.chown(path, 1, -1)
    with pytest.raises(PermissionError):
        library_cache.check_own(path)
    library_cache.check_own(Path("/"))


def test_least_recently_used_libraries_are_removed(folder: Path) -> None:
    """With their checksums; names hold the C library, so that another one compiles its own."""
    folder.mkdir(parents=True, mode=0o700)
    for number in range(library_cache.MAX_KEPT_LIBRARIES + 1):
        for name in (f"old{number}.so", f"old{number}.so.sha256"):
            (folder / name).touch()
            os.utime(folder / name, (number, number))
    assert seven(folder) == 7
    (path,) = folder.glob("seven-*.so")
    kept = {f"old{number}.so" for number in range(2, library_cache.MAX_KEPT_LIBRARIES + 1)}
    kept |= {path.name}
    assert {each.name for each in folder.iterdir()} == kept | {f"{name}.sha256" for name in kept}
    assert os.confstr("CS_GNU_LIBC_VERSION").replace(" ", "") in path.name


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Of a function that returns seven."""
    path = tmp_path / "seven.c"
    path.write_text("int seven(void) { return 7; }")
    return path


@pytest.mark.parametrize("cc", ["/nowhere/cc", "false", "sleep 60 #"])
def test_compiler_that_gives_no_library_is_bad_input(
    cc: str,
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    without_kernels: Callable[[], None],
) -> None:
    """Neither is there a file then, nor a part of one.

    Without a compiler there is no library, no error, and words that say how much slower it is.
    """
    assert kernels() is not None
    assert why_slow() is None
    with monkeypatch.context() as patch:
        patch.setenv("CC", cc)
        patch.setattr(library_cache, "COMPILE_TIMEOUT", 0.01)
        with pytest.raises(InputError):
            compile_library(tmp_path / "seven.so", [source], flags=(), what="seven")
    assert [path.name for path in tmp_path.iterdir()] == ["seven.c"]
    without_kernels()
    assert kernels() is None
    assert why_slow()


def test_threads_compile_the_same_at_once(source: Path, tmp_path: Path) -> None:
    """Each in a folder of its own, so that no thread loads a part of the library."""
    path = tmp_path / "seven.so"

    def load(_: int) -> int:
        compile_library(path, [source], flags=(), what="seven")
        return int(ctypes.CDLL(str(path)).seven())

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(load, range(4))) == [7] * 4
    assert {each.name for each in tmp_path.iterdir()} == {"seven.c", "seven.so"}
