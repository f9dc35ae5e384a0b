"""Designs computed by other processes and machines."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from era_haptics.lab.design.contact_rule import anywhere
from era_haptics.lab.design.design_run import rank_layouts
from era_haptics.lab.design.era_area import area_of
from era_haptics.lab.design.given_layouts import layouts_of
from era_haptics.lab.design.problem import DesignProblem
from era_haptics.lab.design.results import Design
from era_haptics.lab.design.runner import Runner
from kit.plates import make_paper_rig
from model.processes import on_cluster, on_processes

RIG = make_paper_rig(12, 9)
AREA = area_of("edge", RIG.plate)
THREE_SETS = tuple(anywhere(RIG.plate).sets(3, seed=1))
CONTACTS = replace(anywhere(RIG.plate), given=THREE_SETS)


def figures_by(runner: Runner) -> bytes:
    """Return all numbers of a design of ten layouts with four ERAs, two of them judged."""
    design_problem = DesignProblem(RIG, 4, AREA, CONTACTS, seed=0)
    layouts = {design_problem: layouts_of("random:10", design_problem)}
    design: Design = rank_layouts(layouts, finalists=2, runner=runner)
    rows = []
    for layout in design.layouts:
        contrast = layout.mean_db if layout.judged else 0
        rows.append([*layout.found.positions.ravel(), layout.found.score_db, contrast])
    return np.array(rows).tobytes()


@pytest.mark.long
def test_processes_and_a_cluster_find_the_same_to_the_bit() -> None:
    """One process, two of this machine and two Dask workers."""
    import dask  # takes a second
    from distributed import LocalCluster

    by_one = figures_by(Runner())
    by_two = figures_by(Runner(machines=partial(on_processes, 2)))
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
    ):
        by_cluster = figures_by(Runner(machines=partial(on_cluster, cluster.scheduler_address)))

    assert by_two == by_one
    assert by_cluster == by_one
