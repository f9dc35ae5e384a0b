"""Tasks on a real Dask cluster of two worker processes.

Dask, which takes a second to load, is loaded by those tests that run.
"""

import os
import signal
import sys
from collections.abc import Iterator

import pytest

from model import cluster
from model.cluster import check_address, on_cluster
from model.errors import InputError

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


def test_cluster_without_workers_is_refused() -> None:
    """Waiting for ever for a worker to come is no answer."""
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=0, dashboard_address=":0") as empty,
        pytest.raises(InputError, match="has no workers"),
    ):
        dict(on_cluster(empty.scheduler_address, divmod, 1, TASKS))


@pytest.mark.long
def test_cluster_gives_up_on_a_task_that_kills_its_workers(address: str, monkeypatch) -> None:
    """A task that ends whichever worker takes it, as one does for which memory is too short."""
    from distributed import Client

    monkeypatch.setattr(cluster, "_run_same_code", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    with Client(address, set_as_default=False) as client:
        client.run_on_scheduler(_allow_failures, 0)
    with pytest.raises(InputError, match="memory"):
        dict(on_cluster(address, divmod, 1, {0: 1}))


def _allow_failures(count, dask_scheduler):
    """How many workers a task may cost, on the scheduler."""
    dask_scheduler.allowed_failures = count


def test_cluster_without_dask_names_the_extra(monkeypatch) -> None:
    """The error names the extra to install."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"\[cluster\]"):
        dict(on_cluster("tcp://127.0.0.1:1", divmod, 1, TASKS))


def test_cluster_without_scheduler_is_refused(monkeypatch) -> None:
    """Nothing listens at the address: the error says so, and how to start one."""
    monkeypatch.setattr(cluster, "_CONNECT_TIMEOUT", 0.2)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "):
        dict(on_cluster("tcp://127.0.0.1:1", divmod, 1, TASKS))


@pytest.mark.parametrize("text", ["", "nonsense", "foo://x:1", "tcp://host", "tcp://host:port"])
def test_address_that_dask_would_hang_over_is_refused(text: str) -> None:
    """It never reaches Dask."""
    with pytest.raises(InputError, match="dask scheduler"):
        check_address(text)


def test_every_worker_checks_its_code() -> None:
    """Nothing is called on a worker that joins later, with other code."""
    with pytest.raises(InputError, match="same era-haptics"):
        cluster._run_same_code("0.0.1+123456789abc", pytest.fail, "called")
