"""Concentration of a vibration: of fields with a known answer, and of a table's patterns."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from model.answer.answer_report import cell_centres, concentration_of, measures
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import lattice
from model.finger import fingertip_points, is_beyond
from plates import smooth_rig, smooth_table

TARGET = (0.15, 0.12)
PLATE = smooth_rig().plate
AREA = PLATE.length * PLATE.width
POINTS = cell_centres(PLATE)
NEAR = np.hypot(*(POINTS - TARGET).T) <= 0.05
CIRCLE = pi * 0.05**2


def concentration(*amplitudes, frequencies=(100.0,)):
    """Concentration of amplitudes (f, p) at the centres of cells, 1 m/s² at the target."""
    field = np.array(amplitudes, dtype=float)
    return concentration_of(
        np.array(frequencies), field, ~is_beyond(POINTS, [TARGET]), felt=1.0, plate=PLATE
    )


def test_concentration_weighs_energy_and_sums_amplitudes_over_frequencies():
    """Half the frequency is four times the energy; two quarters of the target make a half."""
    found = concentration(NEAR, ~NEAR, frequencies=(100.0, 200.0))
    assert found.energy_share_near == pytest.approx(4 / (4 + (AREA / CIRCLE - 1)), rel=0.01)
    left = POINTS[:, 0] < PLATE.length / 2
    for amplitude, area in ((0.249, 0.0), (0.251, AREA / 2)):
        found = concentration(amplitude * left, amplitude * left, frequencies=(100.0, 200.0))
        assert found.area_above_half == pytest.approx(area, rel=0.01)


def test_concentration_on_a_plate_within_five_centimetres():
    """Where nothing is farther away, all of it is around the target."""
    small = replace(PLATE, length=0.06, width=0.06)
    points = cell_centres(small)
    near = ~is_beyond(points, [(0.03, 0.03)])
    found = concentration_of(
        np.array([100.0]), np.full((1, len(points)), 0.5), near, felt=1.0, plate=small
    )
    assert found.contrast_95_db == pytest.approx(20 * np.log10(2))
    assert found.energy_share_near == pytest.approx(1.0)


def test_concentration_agrees_with_points_counted_one_by_one():
    """Two targets, from points 1.7 mm apart; with quiet fingers there is no concentration."""
    table = smooth_table()
    places = ((0.09, 0.08), (0.24, 0.14))
    answer = query(table, Placement(places), drive_mode="phased")
    layer = answer.layers[0]
    points = lattice(*(np.arange(0.0008, side, 0.0017) for side in (PLATE.length, PLATE.width)))
    frequencies, amplitudes = table.amplitudes(layer.excitation, points)
    energy = ((amplitudes / frequencies[:, None]) ** 2).sum(axis=0)
    peak = amplitudes.sum(axis=0)
    discs = [fingertip_points(*place, PLATE) for place in places]
    felt = min(table.amplitudes(layer.excitation, disc)[1].sum(axis=0).mean() for disc in discs)
    near = np.min([np.hypot(*(points - place).T) for place in places], axis=0) <= 0.05
    far = np.sort(peak[~near])
    found = measures(table, answer).concentration
    assert found is not None
    contrast = 20 * np.log10(felt / far[int(0.95 * len(far))])
    assert found.contrast_95_db == pytest.approx(contrast, abs=0.1)
    assert found.area_above_half == pytest.approx((peak > felt / 2).mean() * AREA, rel=0.02)
    assert found.energy_share_near == pytest.approx(energy[near].sum() / energy.sum(), abs=0.01)
    answer = query(table, Placement(places[:1], places[1:]), drive_mode="phased")
    assert measures(table, answer).concentration is None
