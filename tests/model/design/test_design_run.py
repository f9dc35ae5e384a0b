"""Designs on several machines."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from era_haptics.lab.design.design_run import Design, Runner, judge, layout_keys, rank_layouts
from era_haptics.lab.design.problem import DesignProblem, anywhere, area_of, layouts_of
from model.config.document import parse_document
from model.processes import on_cluster, on_processes
from model.rig.rig_file import parse_rig
from plates import exciter_rig_text, make_paper_rig


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few layouts together."""
    monkeypatch.setattr("era_haptics.lab.design.design_run.CHUNK", 4)


def ranked(runner: Runner, *, seed: int = 0) -> Design:
    """Ten layouts of four ERAs, two of them judged by three contact sets."""
    rig = make_paper_rig(12, 9)
    few = tuple(anywhere(rig.plate).sets(3, seed=1))
    contacts = replace(anywhere(rig.plate), given=few)
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


def test_a_layout_is_judged_with_the_eras_of_its_problem(tmp_path) -> None:
    """The same places with ERAs of two stiffnesses: each has the answers of its own rig."""
    rig = make_paper_rig(12, 9)
    few = tuple(anywhere(rig.plate).sets(3, seed=1))
    contacts = replace(anywhere(rig.plate), given=few)
    area = area_of("edge", rig.plate)
    soft, stiff = (DesignProblem(rig, 4, area, contacts, stiffness=each) for each in (1e4, 3e4))
    corners = {"corners": soft.own_positions}
    found = rank_layouts({soft: corners, stiff: corners}, finalists=1, runner=Runner())
    for each in found.layouts:
        alone = judge(each.problem.rig_with(soft.own_positions), few)
        assert sorted(each.answers.contrast_db) == pytest.approx(sorted(alone.contrast_db))


def test_layouts_of_exciters_state_their_own_keys() -> None:
    """A suspension by stiffness and damping takes the place of resonance and q, and reads back."""
    text = exciter_rig_text("type: DAEX25CT-4, resonance: 300, resonance_is: free, q: 4")
    rig = parse_rig("board.yaml", text)
    area, contacts = area_of("edge", rig.plate), anywhere(rig.plate)
    sought = DesignProblem(rig, 4, area, contacts, stiffness=5e3)
    places = np.array([[0.05, 0.04], [0.25, 0.04], [0.25, 0.19], [0.06, 0.18]])
    keys = layout_keys(sought, places, parse_document("board.yaml", text).data)
    found = parse_rig("layout.yaml", json.dumps(keys))
    assert [(era.x, era.y) for era in found.eras] == [tuple(at) for at in places.tolist()]
    assert [era.stiffness for era in found.eras] == [5e3] * 4
    assert [era.damping for era in found.eras] == pytest.approx([rig.eras[0].damping] * 4, rel=1e-5)
