"""Robust contrast: every plate of the ensemble against the direct solver."""

from dataclasses import replace

import numpy as np
import pytest

from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.structure.point_load import PointLoad
from model.table.build import build_table
from model.table.question import Question
from model.table.robust import Ensemble, draw_ensemble, ensemble_contrast_db, with_robust_contrast
from model.vibration.peak import base_amplitudes
from paper_table import smooth_rig, smooth_table

TARGET, QUIET = (0.09, 0.07), ((0.25, 0.18), (0.03, 0.19))

MEMBERS = Ensemble(
    thickness=np.array([1.0, 1.02, 0.98]),
    damping=np.array([1.0, 2.0, 0.5]),
    stiffness=np.array([[1.0, 1.0, 1.0, 1.0], [0.9, 1.1, 1.0, 0.95], [1.1, 1.0, 0.92, 1.05]]),
    gain=np.array(
        [[1, 1, 1, 1], [1.05, 0.96, 1.02, np.exp(0.1j)], [np.exp(-0.08j), 1, 0.93, 1]],
        dtype=complex,
    ),
    deviation=np.zeros((3, 3), dtype=complex),
)


def directly(rig, pattern, member, *, targets=1):
    """Contrast [dB] by the sparse direct solve of that plate with the fingers on it.

    targets: how many of the places are; the weakest one counts.
    """
    scale, damping = MEMBERS.thickness[member], MEMBERS.damping[member]
    plate = replace(
        rig.plate,
        thickness=rig.plate.thickness * scale,
        loss_factor=rig.plate.loss_factor * damping,
    )
    eras = [
        replace(era, stiffness=era.stiffness * stiffness, damping=era.damping * damping)
        for era, stiffness in zip(rig.eras, MEMBERS.stiffness[member], strict=True)
    ]
    fingers = [
        PointLoad(x, y, stiffness=1000.0, damping=2.0, mass=0.0002) for x, y in (TARGET, *QUIET)
    ]
    discs = [fingertip_points(*place, rig.plate) for place in (TARGET, *QUIET)]
    frequencies, bases = base_amplitudes(pattern.excitation, rig.eras)
    unit = direct_acceleration(
        assemble(plate, rig.mesh),
        eras,
        frequencies,
        np.concatenate(discs),
        loads=[*rig.masses, *fingers],
    )
    weights = bases / [era.stroke for era in rig.eras] * MEMBERS.gain[member]
    peak = np.abs(np.einsum("fe,fep->fp", weights, unit)).sum(axis=0)
    peaks = np.split(peak, np.cumsum([len(disc) for disc in discs])[:-1])
    felt = min(
        each @ fingertip_weights(*place, rig.plate)
        for each, place in zip(peaks[:targets], (TARGET, *QUIET), strict=False)
    )
    return 20 * np.log10(felt / max(each.max() for each in peaks[targets:]))


@pytest.mark.parametrize(("targets", "mode"), [(1, "switched"), (1, "phased"), (2, "switched")])
def test_ensemble_contrast_agrees_with_the_direct_solve(targets, mode):
    """Thicker, softer, damped otherwise, misdriven, with fingers on it: within 0.1 dB."""
    places = (TARGET, *QUIET)
    question = Question(places[:targets], places[targets:], drive_mode=mode)
    pattern = smooth_table().query(question)
    found = ensemble_contrast_db(smooth_table(), question, pattern.excitation, MEMBERS)
    solved = [directly(smooth_rig(), pattern, member, targets=targets) for member in range(3)]
    np.testing.assert_allclose(found, solved, atol=0.1)
    assert np.ptp(solved) > 0.3  # the plates do differ


def test_ensemble_contrast_includes_measured_gains_bolts_and_masses():
    """Contrast on each plate is that of the direct solve."""
    rig = smooth_rig()
    measured = ((1.0, 0.0), (0.6, 0.8), (1.3, -0.5), (0.8, 0.2))
    eras = tuple(
        replace(era, gains=((100.0, *gain),), bolt_mass=0.012)
        for era, gain in zip(rig.eras, measured, strict=True)
    )
    rig = replace(rig, eras=eras, masses=(PointLoad(0.2, 0.05, mass=0.03),))
    table = build_table(rig, frequencies=np.array([110.0, 250.0]))
    question = Question((TARGET,), QUIET, drive_mode="phased")
    pattern = table.query(question)
    found = ensemble_contrast_db(table, question, pattern.excitation, MEMBERS)
    solved = [directly(rig, pattern, member) for member in range(3)]
    np.testing.assert_allclose(found, solved, atol=0.1)


def test_robust_contrast_is_the_tenth_percentile_of_the_same_plates():
    """Nine of ten plates of the drawn ensemble have more; without quiet fingers it is None."""
    question = Question((TARGET,), QUIET, drive_mode="phased")
    table = smooth_table()
    pattern = with_robust_contrast(table, question, table.query(question))
    contrasts = ensemble_contrast_db(
        table, question, pattern.excitation, draw_ensemble(4, contact_count=3)
    )
    assert (contrasts > pattern.robust_contrast_db).mean() == pytest.approx(0.9, abs=0.006)
    assert with_robust_contrast(table, question, pattern) == pattern
    alone = Question((TARGET,))
    assert with_robust_contrast(table, alone, table.query(alone)).robust_contrast_db is None


def test_discretisation_error_enters_the_robust_contrast():
    """An error that drowns one finger's response trades places with it; twice the error is 6 dB.

    Far above the response it is the whole amplitude D there: D over quiet and target over D make
    target over quiet.
    """
    question = Question((TARGET,), QUIET[:1], drive_mode="phased")
    table = smooth_table()
    excitation = table.query(question).excitation
    deviation = 1e6 * np.array([[0, 0], [1, 0], [0, 1j]])
    plates = replace(
        draw_ensemble(4, contact_count=2),
        thickness=np.ones(3),
        damping=np.ones(3),
        stiffness=np.ones((3, 4)),
        gain=np.ones((3, 4)),
        deviation=deviation,
    )
    right, at_target, at_quiet = ensemble_contrast_db(table, question, excitation, plates)
    assert at_target + at_quiet == pytest.approx(right, abs=0.01)
    worse = replace(table, discretisation_error=2 * table.discretisation_error)
    twice = ensemble_contrast_db(worse, question, excitation, plates)
    assert twice - [right, at_target, at_quiet] == pytest.approx([0, 6.02, -6.02], abs=0.01)


def test_error_amplitude_is_the_error_of_the_direct_field():
    """One ERA driven: its field over the plate by the direct solve, root mean square, times it."""
    rig, table = smooth_rig(), smooth_table()
    frequency = float(table.frequencies[8])
    base = 40e-6 * np.exp(1j) * np.array([0, 1, 0, 0])
    direct = direct_acceleration(
        assemble(rig.plate, rig.mesh), rig.eras, np.array([frequency]), table.raster.points
    )[0, 1]
    rms = np.sqrt((np.abs(direct) ** 2).mean()) * 40e-6 / rig.eras[1].stroke
    expected = table.discretisation_error[8] * rms
    assert table.error_amplitude(frequency, base) == pytest.approx(expected, rel=1e-3)


def test_ensemble_has_the_documented_tolerances():
    """Gains 5 %, phases 5 degrees, k_b within 10 %, thickness within 2 %, damping half to twice."""
    ensemble = draw_ensemble(1000, contact_count=2)
    assert np.abs(ensemble.gain).std() == pytest.approx(0.05, rel=0.05)
    assert np.degrees(np.angle(ensemble.gain)).std() == pytest.approx(5.0, rel=0.05)
    for values, low, high in (
        (ensemble.stiffness, 0.9, 1.1),
        (ensemble.thickness, 0.98, 1.02),
        (ensemble.damping, 0.5, 2.0),
    ):
        assert low <= values.min() < low * 1.05
        assert high * 0.95 < values.max() <= high
