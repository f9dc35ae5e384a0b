"""How a vibration lies over the plate: fields whose spread is plain, and one of a table."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from model.arrays import lattice
from model.finger.contrast import is_beyond
from model.finger.fingertip import fingertip_points
from model.table.concentration import cell_centres, concentration_of, with_concentration
from model.table.question import Question
from paper_table import smooth_rig, smooth_table

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


def test_a_plate_that_moves_as_one_is_nowhere_stronger():
    """All of it is above half of the target, none is told from it, and energy goes with area."""
    found = concentration(np.ones(len(POINTS)))
    assert found.contrast_95_db == pytest.approx(0.0)
    assert found.area_above_half == pytest.approx(AREA)
    assert found.energy_share_near == pytest.approx(CIRCLE / AREA, rel=0.01)


@pytest.mark.parametrize(("share", "contrast"), [(0.06, 20.0), (0.04, 60.0)])
def test_a_twentieth_of_the_plate_around_is_left_out(share, contrast):
    """A strip a tenth as strong as the target counts if it is more than that, else what is left."""
    strip = POINTS[:, 0] < share * (AREA - CIRCLE) / PLATE.width
    found = concentration(np.where(NEAR, 1.0, np.where(strip, 0.1, 0.001)))
    assert found.contrast_95_db == pytest.approx(contrast)
    assert found.area_above_half == pytest.approx(CIRCLE, rel=0.01)


def test_energy_counts_slow_vibrations_for_more():
    """Equal accelerations at half the frequency are twice the velocity, four times the energy."""
    found = concentration(NEAR, ~NEAR, frequencies=(100.0, 200.0))
    assert found.energy_share_near == pytest.approx(4 / (4 + (AREA / CIRCLE - 1)), rel=0.01)


def test_several_frequencies_are_felt_as_their_sum():
    """Half the plate at a quarter of the target, twice: half as strong there, so not above half."""
    left = POINTS[:, 0] < PLATE.length / 2
    below = concentration(0.249 * left, 0.249 * left, frequencies=(100.0, 200.0))
    above = concentration(0.251 * left, 0.251 * left, frequencies=(100.0, 200.0))
    assert below.area_above_half == 0
    assert above.area_above_half == pytest.approx(AREA / 2, rel=0.01)


def test_a_plate_within_five_centimetres_is_told_from_itself():
    """Where nothing is farther away, all of it is around the target."""
    small = replace(PLATE, length=0.06, width=0.06)
    points = cell_centres(small)
    near = ~is_beyond(points, [(0.03, 0.03)])
    found = concentration_of(
        np.array([100.0]), np.full((1, len(points)), 0.5), near, felt=1.0, plate=small
    )
    assert found.contrast_95_db == pytest.approx(20 * np.log10(2))
    assert found.energy_share_near == pytest.approx(1.0)


@pytest.mark.parametrize("mode", ["switched", "phased"])
def test_a_table_tells_the_spread_of_its_field(mode):
    """Two fingers, both targets: the same from points 1.7 mm apart, counted one by one."""
    table = smooth_table()
    places = ((0.09, 0.08), (0.24, 0.14))
    question = Question(places, drive_mode=mode)
    pattern = with_concentration(table, question, table.query(question))
    steps = (np.arange(0.0008, side, 0.0017) for side in (PLATE.length, PLATE.width))
    points = lattice(*steps)
    frequencies, amplitudes = table.amplitudes(pattern.excitation, points)
    velocities = amplitudes / (2 * pi * frequencies[:, None])
    discs = [fingertip_points(*place, PLATE) for place in places]
    felt = min(table.amplitudes(pattern.excitation, disc)[1].sum(axis=0).mean() for disc in discs)
    far, loud, near_energy, energy = [], 0, 0.0, 0.0
    for (x, y), peak, velocity in zip(points, amplitudes.sum(axis=0), velocities.T, strict=True):
        energy += velocity @ velocity
        loud += peak > felt / 2
        if min(np.hypot(x - a, y - b) for a, b in places) > 0.05:
            far.append(peak)
        else:
            near_energy += velocity @ velocity
    level_of_rest = 20 * np.log10(felt / sorted(far)[int(0.95 * len(far))])
    assert pattern.concentration is not None
    assert pattern.concentration.contrast_95_db == pytest.approx(level_of_rest, abs=0.1)
    assert pattern.concentration.area_above_half == pytest.approx(
        loud / len(points) * AREA, rel=0.02
    )
    assert pattern.concentration.energy_share_near == pytest.approx(near_energy / energy, abs=0.01)


def test_fingers_to_be_kept_quiet_are_what_counts():
    """With others on the plate the spread is not told."""
    table = smooth_table()
    question = Question(((0.09, 0.08),), ((0.24, 0.14),))
    assert with_concentration(table, question, table.query(question)).concentration is None
