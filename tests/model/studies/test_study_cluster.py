"""A study on a real Dask cluster of two worker processes.

Dask, which takes a second to load, is loaded by those tests that run.
"""

import os
import signal
import sys
from collections.abc import Iterator

import pytest

from model import cluster
from model.cluster import Cluster
from model.design.contacts import contact_rule
from model.errors import InputError
from model.studies import finalists
from model.studies.ranking import score_order
from model.studies.solve import solve_cases
from model.studies.workers import on_cluster, on_processes
from studies import chunks_of, same_to_the_bit, small_study

OTHER = "0.0.1+123456789abc"


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


def worker_pids(address: str) -> list[int]:
    """Process numbers of the cluster's workers."""
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        return list(client.run(os.getpid).values())


@pytest.mark.long
def test_cluster_equals_one_process_bit_for_bit(address):
    """Two worker processes and this process agree in every bit of every chunk."""
    assert len(set(worker_pids(address)) - {os.getpid()}) == 2
    problem, cases = small_study(layouts=40)
    chunks = chunks_of(cases, 8)
    there = dict(on_cluster(Cluster(address))(problem, chunks))
    assert same_to_the_bit(there, dict(on_processes(1)(problem, chunks)))


def test_cluster_judges_finalists_as_one_process_does(address, monkeypatch):
    """The answers of every finalist are the same."""
    monkeypatch.setattr(finalists, "JUDGED_SETS", 6)
    problem, cases = small_study(layouts=6)
    results = solve_cases(problem.solve(), cases)
    scored = score_order(problem.rig, cases, results, drive=0, lowest=1.0)
    rule = contact_rule(None, problem.rig.plate)
    here, there = (
        finalists.judge_finalists(problem.rig, scored, contacts=rule, cluster=where)
        for where in (None, Cluster(address))
    )
    assert {case: each.summary for case, each in here.judged.items()} == {
        case: each.summary for case, each in there.judged.items()
    }


def test_cluster_without_workers_is_refused():
    """Waiting for ever for a worker to come is no answer."""
    from distributed import LocalCluster

    problem, cases = small_study(layouts=4)
    with (
        LocalCluster(n_workers=0, dashboard_address=":0") as empty,
        pytest.raises(InputError, match="has no workers"),
    ):
        dict(on_cluster(Cluster(empty.scheduler_address))(problem, chunks_of(cases, 4)))


@pytest.mark.long
def test_cluster_gives_up_on_a_chunk_that_kills_its_workers(address, monkeypatch):
    """A chunk that ends whichever worker takes it, as one does for which memory is too short."""
    from distributed import Client

    problem, cases = small_study(layouts=4)
    monkeypatch.setattr(cluster, "_run_same_code", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    with Client(address, set_as_default=False) as client:
        client.run_on_scheduler(_allow_failures, 0)
    with pytest.raises(InputError, match="memory"):
        dict(on_cluster(Cluster(address))(problem, chunks_of(cases, 4)))


def _allow_failures(count, dask_scheduler):
    """How many workers a chunk may cost, on the scheduler."""
    dask_scheduler.allowed_failures = count


def test_cluster_without_dask_names_the_extra(monkeypatch):
    """The error names the extra to install."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"\[cluster\]"):
        dict(on_cluster(Cluster("tcp://127.0.0.1:1"))(None, {}))


def test_cluster_without_scheduler_is_refused(monkeypatch):
    """Nothing listens at the address: the error says so, and how to start one."""
    monkeypatch.setattr(cluster, "_CONNECT_TIMEOUT", 0.2)
    problem, cases = small_study(layouts=4)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "):
        dict(on_cluster(Cluster("tcp://127.0.0.1:1"))(problem, chunks_of(cases, 4)))


@pytest.mark.parametrize("text", ["", "nonsense", "foo://x:1", "tcp://host", "tcp://host:port"])
def test_on_cluster_refuses_an_invalid_address(text):
    """An address that Dask would hang over never reaches it."""
    with pytest.raises(InputError, match="dask scheduler"):
        on_cluster(Cluster(text))


def test_every_worker_checks_its_code():
    """Nothing is called on a worker that joins later, with other code."""
    with pytest.raises(InputError, match="same era-haptics"):
        cluster._run_same_code(OTHER, pytest.fail, "called")
