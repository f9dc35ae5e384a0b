"""The localization table: its patterns, its answers, its file."""

from dataclasses import replace

import numpy as np
import pytest

from model.drive_modes.sources import all_patterns, magnitudes_of_sources, sums_of_sources
from model.errors import InputError
from model.fem.assembly import assemble
from model.fem.elements import ELEMENTS
from model.fem.harmonic import direct_acceleration
from model.fem.mesh import Mesh
from model.finger.fingertip import fingertip_points
from model.finger.grid import Grid
from model.finger.perception import sensation_level
from model.structure.point_load import PointLoad
from model.structure.point_mass import PointMass
from model.table.build import build_table
from model.table.file import load_table, save_table
from model.table.question import Question
from model.table.summary import summarize
from model.table.weak_cells import find_weak_cells
from model.vibration.peak import peak_acceleration, tone_amplitudes
from paper_plate import make_paper_rig


@pytest.fixture(scope="module")
def rig():
    """A mesh that is quick to solve directly, of elements as smooth as fields are."""
    paper = make_paper_rig(24, 18)
    return replace(paper, mesh=Mesh(6, 5, paper.plate.length, paper.plate.width, ELEMENTS["Q5"]))


@pytest.fixture(scope="module")
def table(rig):
    """The paper's patterns on the paper's grid."""
    return build_table(rig)


def solved_directly(rig, pattern, points):
    """Frequencies and amplitudes of a pattern at points by the sparse direct solve."""
    matrices = assemble(rig.plate, rig.mesh)
    return tone_amplitudes(
        pattern.excitation,
        rig.eras,
        lambda f: direct_acceleration(matrices, rig.eras, f, points),
    )


def query(table, target, *, quiet=(), level_db_sl=20.0):
    """The pattern for one target."""
    return table.query(Question((target,), tuple(quiet), level_db_sl=level_db_sl))


def test_the_paper_has_4482_patterns():
    """Four ERAs alone and six pairs at 27 frequencies: 4 * 27 + 6 * 27²."""
    patterns = all_patterns(4, 27).index
    assert len(patterns) == 4 * 27 + 6 * 27**2 == 4482
    assert len(np.unique(patterns, axis=0)) == 4482
    assert set((patterns >= 0).sum(axis=1)) == {1, 2}


def test_patterns_that_tables_share_cannot_be_overwritten(table):
    """One table's user cannot change what another one answers."""
    with pytest.raises(ValueError, match="read-only"):
        all_patterns(len(table.eras), len(table.frequencies)).index[0, 0] = 5


def test_every_pattern_is_what_adding_up_its_tones_gives():
    """Row by row, the vectorised sum equals Eq. 28 written out for that pattern."""
    rng = np.random.default_rng(0)
    response = rng.normal(size=(5, 3, 4)) + 1j * rng.normal(size=(5, 3, 4))
    fast = sums_of_sources(magnitudes_of_sources(response).T, 3).T
    for row, pattern in zip(fast, all_patterns(3, 5).index, strict=True):
        slow = np.zeros(4)
        for frequency in range(5):
            slow += np.abs(response[frequency, pattern == frequency].sum(axis=0))
        np.testing.assert_allclose(row, slow)


@pytest.mark.parametrize(
    "quiet", [[(0.25, 0.18)], [(0.03, 0.19), (0.27, 0.05)]], ids=["one", "two"]
)
def test_an_answer_holds_against_the_direct_solve(rig, table, quiet):
    """Level and contrast predicted are those of the sparse direct solve at the fingertips."""
    target = (0.09, 0.07)
    pattern = query(table, target, quiet=quiet, level_db_sl=18.0)
    frequencies, at_target = solved_directly(rig, pattern, fingertip_points(*target, rig.plate))
    level = 20 * np.log10((10 ** (sensation_level(frequencies, at_target) / 20)).mean())
    assert level == pytest.approx(18.0, abs=0.01)
    loudest = max(
        peak_acceleration(solved_directly(rig, pattern, fingertip_points(*q, rig.plate))[1]).max()
        for q in quiet
    )
    contrast = 20 * np.log10(peak_acceleration(at_target).mean() / loudest)
    assert pattern.contrast_db == pytest.approx(contrast, abs=0.02)


def test_no_other_pattern_has_more_contrast(rig, table):
    """The answer is the best of all patterns that reach the level, tried one by one."""
    target, quiet = (0.20, 0.15), (0.06, 0.06)
    pattern = query(table, target, quiet=[quiet], level_db_sl=20.0)
    matrices = assemble(rig.plate, rig.mesh)
    points = np.concatenate([fingertip_points(*p, rig.plate) for p in (target, quiet)])
    count = len(fingertip_points(*target, rig.plate))
    response = direct_acceleration(matrices, rig.eras, table.frequencies, points)
    best = -np.inf
    for row in all_patterns(4, 27).index[::7]:  # every seventh: enough to catch a wrong choice
        active = np.flatnonzero(row >= 0)
        amplitudes = np.array(
            [np.abs(response[f, row == f].sum(axis=0)) for f in np.unique(row[active])]
        )
        level = sensation_level(table.frequencies[np.unique(row[active])], amplitudes[:, :count])
        if 20 * np.log10((10 ** (level / 20)).mean()) >= 20.0:
            peak = amplitudes.sum(axis=0)
            best = max(best, 20 * np.log10(peak[:count].mean() / peak[count:].max()))
    assert np.isfinite(best)
    assert pattern.contrast_db >= best - 0.02


def test_level_scales_the_drive_and_leaves_the_contrast(table):
    """20 dB less asked for is a tenth of the stroke, the same ERAs, the same contrast."""
    loud = query(table, (0.1, 0.1), quiet=[(0.2, 0.1)], level_db_sl=20.0)
    soft = query(table, (0.1, 0.1), quiet=[(0.2, 0.1)], level_db_sl=0.0)
    # A pattern that only the softer level admits may be better, never worse.
    assert soft.contrast_db >= loud.contrast_db - 1e-9
    if soft.excitation.keys() == loud.excitation.keys():
        for name, tone in soft.excitation.items():
            if tone.frequency == loud.excitation[name].frequency:
                assert tone.amplitude == pytest.approx(loud.excitation[name].amplitude / 10)


def test_mirrored_contacts_get_mirrored_patterns(table):
    """On a symmetric plate, west and east swap with the contacts."""
    length = table.plate.length
    west = query(table, (0.07, 0.06), quiet=[(0.22, 0.15)])
    east = query(table, (length - 0.07, 0.06), quiet=[(length - 0.22, 0.15)])
    assert east.contrast_db == pytest.approx(west.contrast_db, abs=1e-3)
    swap = {"SW": "SE", "SE": "SW", "NE": "NW", "NW": "NE"}
    mirrored = {swap[name]: tone.frequency for name, tone in west.excitation.items()}
    assert {name: tone.frequency for name, tone in east.excitation.items()} == mirrored


def test_a_lone_finger_has_a_level_and_no_contrast(table):
    """Without other fingers there is nothing to be told from: contrast is None."""
    pattern = query(table, (0.15, 0.11))
    assert pattern.contrast_db is None
    assert pattern.quiet_level_db_sl is None
    assert pattern.level_db_sl == 20.0


def test_cells_are_numbered_along_x_first(table):
    """Cell 12 of a 12x9 grid is the first of the second row; its centre is half a cell in."""
    np.testing.assert_allclose(Grid(12, 9).centres(table.plate)[12], [0.0127, 0.0381])


def test_a_table_knows_what_the_plate_carries(tmp_path):
    """With 60 g on it the plate answers as the direct solve says; the file keeps it for its rig."""
    rig = replace(make_paper_rig(12, 9), masses=(PointMass(0.1, 0.15, 0.06),))
    laden = build_table(rig, frequencies=np.array([110.0, 210.0]))
    solved = direct_acceleration(
        assemble(rig.plate, rig.mesh),
        rig.eras,
        laden.frequencies,
        laden.raster.points,
        loads=[PointLoad(0.1, 0.15, mass=0.06)],
    )
    error = np.linalg.norm(laden.acceleration.transpose(1, 2, 0) - solved) / np.linalg.norm(solved)
    assert error < 1e-3
    save_table(laden, tmp_path / "laden.npz")
    back = load_table(tmp_path / "laden.npz", fingerprint=rig.fingerprint)
    assert back.masses == rig.masses
    with pytest.raises(InputError, match="fingerprint"):
        load_table(tmp_path / "laden.npz", fingerprint=make_paper_rig(12, 9).fingerprint)


def test_fingerprint_is_of_the_physics(rig):
    """Rewiring, a material's name and whole numbers keep it, another stiffness does not."""
    material = replace(rig.plate.material, name="other")
    same = replace(rig, wiring={}, amplifiers={}, plate=replace(rig.plate, material=material))
    whole = replace(rig, eras=(replace(rig.eras[0], stiffness=17000, x=0), *rig.eras[1:]))
    assert same.fingerprint == whole.fingerprint == rig.fingerprint
    softer = replace(rig, eras=(replace(rig.eras[0], stiffness=16000.0), *rig.eras[1:]))
    assert softer.fingerprint != rig.fingerprint


@pytest.mark.parametrize(
    "frequencies",
    [[], [100.0, 100.0], [200.0, 100.0], [10.0], [100.0, 900.0], [100.0, float("nan")]],
)
def test_build_refuses_impossible_frequencies(rig, frequencies):
    """None, unordered, outside the rig's limits, not a number."""
    with pytest.raises(InputError, match="frequencies"):
        build_table(rig, frequencies=np.array(frequencies))


def test_the_summary_counts_what_the_table_holds(table):
    """Every cell of the paper's plate can be made to feel it; contrast falls with more fingers."""
    summary = summarize(table, find_weak_cells(table))
    assert summary["cells"] == 108
    assert summary["patterns"] == 4482
    assert summary["dead_zone_share"] == 0.0
    medians = [summary[f"contrast_{k}_quiet_median_db"] for k in (1, 2, 3)]
    assert medians[0] > medians[1] > medians[2] > 0


def test_a_small_plate_has_no_contact_sets_to_show():
    """Where no two fingers fit 5 cm apart the distribution is empty, not an endless loop."""
    rig = make_paper_rig(6, 6)
    small = replace(
        rig,
        plate=replace(rig.plate, length=0.03, width=0.03),
        mesh=replace(rig.mesh, length=0.03, width=0.03),
        eras=tuple(replace(era, x=0.03 * (era.x > 0), y=0.03 * (era.y > 0)) for era in rig.eras),
    )
    built = build_table(small, grid=Grid(2, 2))
    summary = summarize(built, find_weak_cells(built))
    assert summary["contrast_1_quiet_median_db"] is None
