"""Designs on several machines, resumed from what was finished."""

import logging
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from model.cluster import on_cluster
from model.design.area import area_of
from model.design.contacts import anywhere
from model.design.layouts import layouts_of
from model.design.problem import DesignProblem
from model.design.run import Design, Runner, rank_layouts
from model.processes import on_processes
from paper_plate import make_paper_rig


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few layouts together."""
    monkeypatch.setattr("model.design.run.CHUNK", 4)


def ranked(runner: Runner, *, seed: int = 0) -> Design:
    """Ten layouts of four ERAs, two of them judged by three contact sets."""
    rig = make_paper_rig(12, 9)
    few = tuple(anywhere(rig.plate).sets(3, seed=1))
    contacts = replace(anywhere(rig.plate), given=few, text="few")
    some = DesignProblem(rig, 4, area_of("edge", rig.plate), contacts, seed=seed)
    return rank_layouts({some: layouts_of("random:10", some)}, finalists=2, runner=runner)


def figures(design: Design) -> bytes:
    """All numbers of a design."""
    rows = [
        [*each.found.positions.ravel(), each.found.score_db, each.mean_db if each.judged else 0]
        for each in design.layouts
    ]
    return np.array(rows).tobytes()


@pytest.mark.long
def test_processes_and_a_cluster_find_the_same_to_the_bit() -> None:
    """One process, two of this machine and two Dask workers."""
    import dask  # takes a second
    from distributed import LocalCluster

    here = figures(ranked(Runner()))
    assert figures(ranked(Runner(machines=partial(on_processes, 2)))) == here
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as running,
    ):
        there = Runner(machines=partial(on_cluster, running.scheduler_address))
        assert figures(ranked(there)) == here


def test_an_interrupted_design_resumes(tmp_path) -> None:
    """Ctrl-C after the first of three chunks: the second run solves two, the third nothing."""

    def interrupted(solve, shared, tasks):
        yield next(on_processes(1, solve, shared, tasks))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ranked(Runner(tmp_path, interrupted))
    second, third = Runner(tmp_path), Runner(tmp_path)
    assert figures(ranked(second)) == figures(ranked(third)) == figures(ranked(Runner()))
    assert second.resumed["chunks"] == 1
    assert third.resumed["chunks"] == 3
    other = Runner(tmp_path)
    ranked(other, seed=1)
    assert other.resumed["chunks"] == 0


def test_damaged_files_are_ignored_logged_and_written_anew(tmp_path, caplog) -> None:
    """A file cut short, one with a bit turned, and one renamed to that of another chunk."""
    whole = figures(ranked(Runner(tmp_path)))
    cut, turned, *_ = paths = sorted(tmp_path.glob("chunks-*.npz"))
    contents = [path.read_bytes() for path in paths]
    cut.write_bytes(contents[0][: len(contents[0]) // 2])
    middle = contents[1].index(b"\x93NUMPY") + 130  # in an array
    flipped = bytes([contents[1][middle] ^ 1])
    turned.write_bytes(contents[1][:middle] + flipped + contents[1][middle + 1 :])
    paths[2].write_bytes(contents[1])
    again = Runner(tmp_path)
    with caplog.at_level(logging.WARNING):
        assert figures(ranked(again)) == whole
    assert again.resumed["chunks"] == 0
    assert len(caplog.records) == 3
    assert [path.read_bytes() for path in paths] == contents
