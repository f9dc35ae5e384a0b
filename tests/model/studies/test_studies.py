"""Solving, keeping and ranking the cases of a study."""

import io
import logging
import multiprocessing
from dataclasses import replace

import numpy as np
import pytest

from model.design.contacts import anywhere
from model.errors import InputError
from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.rig.layouts import candidate_places
from model.structure.actuator import Era
from model.structure.point_load import PointLoad
from model.studies import solve
from model.studies.finished import FinishedCases
from model.studies.kinds import count_cases, placement_cases
from model.studies.run import CHUNK, run_study
from model.studies.solve import DRIVES, CaseResults, solve_cases, study_problem
from model.studies.workers import on_processes
from model.vibration.activation import MEDIAN, cumulative_statistics
from paper_plate import make_paper_rig
from studies import FREQUENCIES, chunks_of, same_to_the_bit, small_study


@pytest.fixture(scope="module")
def study():
    """A problem and cases for more than two chunks."""
    return small_study(layouts=2 * CHUNK + 10)


@pytest.fixture(scope="module")
def results(study):
    """All cases solved in this process, without a cache."""
    problem, cases = study
    return solve_cases(problem.solve(), cases)


def median_peak(acceleration, active):
    """Median over the points of what the peaks add up to, from (f, eras, p): Eq. 28 as it reads."""
    return np.median(np.abs(acceleration[:, list(active)].sum(axis=1)).sum(axis=0))


def npy_bytes(array):
    """An array as numpy saves it alone."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def counting(solved):
    """Workers that record the numbers of their chunks."""

    def solve_and_note(problem, chunks):
        solved.extend(chunks)
        yield from on_processes(1)(problem, chunks)

    return solve_and_note


def test_statistics_equal_the_direct_solve(study, results):
    """The rig itself and random layouts agree with one sparse factorisation per frequency."""
    problem, cases = study
    matrices = assemble(problem.rig.plate, problem.rig.mesh)
    for case in (0, 3, 20, 120):
        eras = cases.eras_of(case, problem.rig.eras)
        direct = direct_acceleration(matrices, eras, FREQUENCIES, problem.points)
        for drive, size in enumerate((1, 2, 4)):
            active = results.active_eras(case, drive)
            assert len(active) == size
            median = results.statistics[case, drive, MEDIAN]
            assert median == pytest.approx(median_peak(direct, active), rel=1e-4)
        best = cumulative_statistics(direct)[:4, MEDIAN].max()
        assert results.statistics[case, 0, MEDIAN] == pytest.approx(best, rel=1e-4)


def test_acceleration_of_unequal_eras_equals_the_direct_solve():
    """Stiffness, damping, bolt mass and stroke of each ERA are its own, as in the direct solve."""
    paper = make_paper_rig(12, 9)
    parameters = [(8e3, 1.0, 0.0, 1e-4), (3e4, 5.0, 0.01, 5e-5), (17e3, 3.0, 0.02, 2e-4)]
    eras = tuple(
        Era(era.name, era.x, era.y, *numbers)
        for era, numbers in zip(paper.eras[:3], parameters, strict=True)
    )
    rig = replace(paper, eras=eras)
    cases = placement_cases(rig, layouts=12, seed=0, raster=(7, 5))
    problem = study_problem(rig, cases, FREQUENCIES, contacts=anywhere(rig.plate))
    placed = cases.eras_of(9, eras)
    direct = direct_acceleration(assemble(rig.plate, rig.mesh), placed, FREQUENCIES, problem.points)
    fast = problem.solve().receptances.acceleration(cases.places_of(9), placed)
    np.testing.assert_allclose(fast, direct, rtol=1e-4, atol=1e-4 * np.abs(direct).max())


def test_statistics_include_point_masses(study):
    """A point mass of the rig is there in every layout, as in the direct solve."""
    problem, cases = study
    mass = PointLoad(0.1, 0.08, mass=0.05)
    loaded = replace(problem.rig, masses=(mass,))
    carried = study_problem(loaded, cases, FREQUENCIES, contacts=anywhere(loaded.plate))
    assert carried.digest != problem.digest
    solved = solve_cases(carried.solve(), cases.take(range(8, 9)))
    direct = direct_acceleration(
        assemble(loaded.plate, loaded.mesh),
        cases.eras_of(8, loaded.eras),
        FREQUENCIES,
        carried.points,
        loads=[PointLoad(mass.x, mass.y, mass=mass.mass)],
    )
    expected = median_peak(direct, solved.active_eras(0, 1))
    assert solved.statistics[0, 1, MEDIAN] == pytest.approx(expected, rel=1e-4)


def test_pairs_are_skipped_for_one_era_and_all_for_two():
    """A lone ERA has no pair; of two ERAs the pair is all."""
    rig = make_paper_rig(12, 9)
    cases = count_cases(rig, layouts=6, seed=0, raster=(7, 5))
    problem = study_problem(rig, cases, FREQUENCIES, contacts=anywhere(rig.plate))
    results = solve_cases(problem.solve(), cases)
    by_drive = dict(zip(DRIVES, results.statistics.transpose(1, 0, 2), strict=True))
    assert np.isnan(by_drive["2"][0]).all()
    np.testing.assert_array_equal(by_drive["all"][0], by_drive["1"][0])
    np.testing.assert_array_equal(by_drive["all"][1], by_drive["2"][1])
    assert np.isfinite(results.statistics[1:, DRIVES.index("2")]).all()


def test_run_study_resumes_after_an_interrupt(study, results, tmp_path):
    """Ctrl-C after the first chunk: the second run solves the other two, the third none."""
    problem, cases = study

    def interrupted(problem, chunks):
        yield next(on_processes(1)(problem, chunks))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(
            problem, cases, workers=interrupted, finished=FinishedCases(tmp_path, problem.digest)
        )
    chunks = []
    for solved in (len(cases) - CHUNK, 0):
        finished = FinishedCases(tmp_path, problem.digest)
        run = run_study(problem, cases, workers=counting(chunks), finished=finished)
        assert (run.solved_count, run.cached_count) == (solved, len(cases) - solved)
        assert same_to_the_bit({0: run.results}, {0: results})
    assert chunks == [0, 1]
    assert list(tmp_path.iterdir()) == [finished.path]


@pytest.mark.parametrize("harm", ["cut", "flipped", "emptied", "foreign", "an array"])
def test_finished_cases_ignore_and_log_a_damaged_file(study, results, tmp_path, caplog, harm):
    """A file that is cut, altered, empty or another leads to one warning, and is written anew."""
    problem, cases = study
    finished = FinishedCases(tmp_path, problem.digest)
    finished.add(cases, results)
    content = finished.path.read_bytes()
    middle = len(content) // 3
    finished.path.write_bytes(
        {
            "cut": content[:middle],
            "flipped": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
            "emptied": b"",
            "foreign": b"PK\x03\x04 not such a file",
            "an array": npy_bytes(np.zeros(3)),
        }[harm]
    )
    with caplog.at_level(logging.WARNING):
        again = FinishedCases(tmp_path, problem.digest)
    assert [record.args[0] for record in caplog.records] == [finished.path]
    assert not again.find(cases)[0].any()
    again.add(cases, results)
    assert finished.path.read_bytes() == content


@pytest.mark.parametrize(
    "change",
    [
        {"lowest": 21.0},
        {"sets": (np.array([[0.1, 0.1], [0.2, 0.1]]),)},
        {"frequencies": np.array([60.0, 110.0, 170.0, 251.0])},
        {"rig": make_paper_rig(14, 9)},
        {"rig": make_paper_rig(12, 9, damping_ratio=0.06)},
    ],
    ids=["lowest mode", "contact sets", "frequencies", "mesh", "ERAs"],
)
def test_finished_cases_of_another_problem_are_not_used(
    study, results, tmp_path, monkeypatch, change
):
    """Each problem and NUMERICS_VERSION has its own file, and no other may be renamed to it."""
    problem, cases = study
    FinishedCases(tmp_path, problem.digest).add(cases, results)
    other = replace(problem, **change).digest
    assert FinishedCases(tmp_path, problem.digest).find(cases)[0].all()
    assert not FinishedCases(tmp_path, other).find(cases)[0].any()
    with monkeypatch.context() as patch:
        patch.setattr(solve, "NUMERICS_VERSION", 0)
        assert not FinishedCases(tmp_path, problem.digest).find(cases)[0].any()
    ours = FinishedCases(tmp_path, problem.digest).path
    ours.rename(FinishedCases(tmp_path, other).path)
    assert not FinishedCases(tmp_path, other).find(cases)[0].any()


def test_finished_cases_are_found_by_layout_and_stiffness(study, results, tmp_path):
    """The same layouts of a longer list are found again, others or stiffer ones are not."""
    problem, cases = study
    first = cases.take(range(4))
    finished = FinishedCases(tmp_path, problem.digest)
    finished.add(
        first, CaseResults(results.expected_db[:4], results.statistics[:4], results.active[:4])
    )
    longer = placement_cases(problem.rig, layouts=900, seed=0, raster=(7, 5))
    done, found = finished.find(longer.take(range(1, 6)))
    assert done.tolist() == [True, True, True, False, False]
    np.testing.assert_array_equal(found.statistics[:3], results.statistics[1:4])
    stiffer = replace(first, stiffness_factors=np.array([1.0, 1.0, 1.0, 2.0]))
    assert finished.find(stiffer)[0].tolist() == [True, True, True, False]


@pytest.mark.long
def test_on_processes_replaces_workers_that_die(study, results, caplog):
    """When all workers are killed after the first chunk, all results come, with a warning."""
    problem, cases = study
    chunks = chunks_of(cases, 2)
    others = multiprocessing.active_children()
    solving = on_processes(2)(problem, chunks)
    there = dict([next(solving)])
    workers = [child for child in multiprocessing.active_children() if child not in others]
    assert len(workers) == 2
    for worker in workers:
        worker.kill()
    there |= dict(solving)
    assert same_to_the_bit(there, dict(on_processes(1)(problem, chunks)))
    assert "died" in caplog.text


@pytest.mark.parametrize("frequencies", [[], [0.0], [-60.0], [np.nan], [60.0, 5000.0]])
def test_study_problem_refuses_invalid_frequencies(study, frequencies):
    """No frequency, zero, NaN, and more than the mesh carries are refused."""
    problem, cases = study
    with pytest.raises(InputError, match=r"frequenc|Hz"):
        study_problem(
            problem.rig, cases, np.array(frequencies), contacts=anywhere(problem.rig.plate)
        )


def test_study_problem_too_large_for_memory_is_refused(study):
    """3600 places at 27 frequencies: 27 x 3600 x (3600 + 432) complex numbers are 6.3 GB."""
    problem, _ = study
    places = candidate_places(60, 60) * [problem.rig.plate.length, problem.rig.plate.width]
    frequencies = np.arange(60.0, 321.0, 10.0)
    with pytest.raises(InputError, match=r"6\.3 GB; take fewer --candidates"):
        replace(problem, positions=places, frequencies=frequencies).solve()
