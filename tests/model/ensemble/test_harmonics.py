"""Second harmonics of ERAs at fingers, by the direct solver at twice the frequency."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from model.answer.promise import FingersOnPlate
from model.arrays import FloatArray
from model.ensemble.draws import Drawing, percentile
from model.fem import ELEMENTS, Mesh, assemble
from model.finger import FINGERTIP_RADIUS, FIVE_POINTS, detection_threshold
from model.rig.rig import Uncertainty
from model.structure.attachments import FingertipLoad
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from plates import smooth_rig

PLACES = ((0.09, 0.07), (0.25, 0.18))
LOADS = (1.0, 2.5)
FREQUENCIES = np.array([60.0, 145.0, 260.0, 430.0, 520.0])
SHARE = 0.02
WEIGHTS = np.array(
    [[1, 0.3j, -0.5, 0.2], [0.1, 1, 0.4j, 0], [-1, 0.2, 0.6, 1j], [1, 1, 0, 0], [1, 0, 0, 0]],
    dtype=np.complex64,
)


MANY = Drawing(count=4000, seed=3, thicknesses=1)


@cache
def table() -> LocalizationTable:
    """The paper's plate on a mesh that carries 1 kHz; one drive is weaker above 60 Hz."""
    rig = smooth_rig()
    gains = ((60.0, 1.0, 0.3), (61.0, 0.5, 0.3))
    eras = (replace(rig.eras[0], gains=gains), *rig.eras[1:])
    mesh = Mesh(8, 6, rig.plate.length, rig.plate.width, ELEMENTS["Q5"])
    known = replace(Uncertainty.none(), harmonic=SHARE)
    limits = replace(rig.limits, frequency_max=520.0)
    rig = replace(rig, eras=eras, mesh=mesh, limits=limits, uncertainty=known)
    return build_table(rig, frequencies=FREQUENCIES)


def directly(frequency: float) -> FloatArray:
    """Acceleration at twice it by each base that moves by its full stroke, (eras, fingers, p)."""
    of = table()
    points = np.array(PLACES)[:, None] + FINGERTIP_RADIUS * FIVE_POINTS.points
    found = direct_acceleration(
        assemble(of.plate, of.mesh),
        [replace(era, gains=()) for era in of.eras],
        np.array([2 * frequency]),
        points.reshape(-1, 2),
        loads=[
            FingertipLoad(*at, of.fingertip.scaled(load))
            for at, load in zip(PLACES, LOADS, strict=True)
        ],
    )
    return found[0].reshape(len(of.eras), len(PLACES), -1)


@pytest.mark.parametrize("row", range(4))
def test_harmonics_at_fingers_are_those_of_drawn_phases(row: int) -> None:
    """Mean and percentiles of independent complex normal numbers of a share, by the direct solver.

    Of each ERA's own motion, which for one is smaller at twice the frequency.
    """
    frequency = float(FREQUENCIES[row])
    motion = SHARE * np.abs(WEIGHTS[row]) * [1.0 if frequency < 60.5 else 0.5, 1.0, 1.0, 1.0]
    rng = np.random.default_rng(1)
    numbers = rng.standard_normal((20_000, 4, 2)) @ [1, 1j] / np.sqrt(2)
    fields = np.einsum("de,e,ekp->dkp", numbers, motion, directly(frequency))
    expected = np.abs(fields) ** 2 @ FIVE_POINTS.weights / detection_threshold(2 * frequency) ** 2

    fingers = FingersOnPlate.of(table(), PLACES, LOADS)
    found = fingers.harmonics(MANY, np.array([row]), WEIGHTS[[row]])[0]
    assert (found[:, 0] == 0).all()  # of the nominal plate
    np.testing.assert_allclose(found[:, 1:].mean(axis=1), expected.mean(axis=0), rtol=0.06)
    for percent in (50, 90):
        by_draws = np.percentile(expected, percent, axis=0)
        np.testing.assert_allclose(percentile(found[:, 1:], percent), by_draws, rtol=0.09)


def test_harmonics_beyond_what_skin_feels_count_for_nothing() -> None:
    """Thresholds end at 1 kHz: twice 520 Hz has none."""
    fingers = FingersOnPlate.of(table(), PLACES, LOADS)
    assert not fingers.harmonics(MANY, np.array([4]), WEIGHTS[[4]]).any()


def test_search_counts_harmonics_as_over_the_plate() -> None:
    """One ERA: mean square over the plate at twice the frequency by the direct solver."""
    of, row = table(), 2
    direct = direct_acceleration(
        assemble(of.plate, of.mesh),
        [replace(era, gains=()) for era in of.eras],
        2 * FREQUENCIES[[row]],
        of.raster.points,
    )[0, 1]
    thresholds = detection_threshold(FREQUENCIES[row] * np.array([1.0, 2.0]))
    expected = (SHARE * thresholds[0] / thresholds[1]) ** 2 * (np.abs(direct) ** 2).mean()
    found = of.search_error_power[row, 1] - of.error_power[row, 1]
    assert found == pytest.approx(expected, rel=0.02)
