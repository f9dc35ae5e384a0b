"""How far magnets move on a plate, worked out for rigid ones."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.reduction.free_plate import solve_free_plate
from model.structure.exciter import Exciter
from model.transients.excursions import excursions_of, relative_motions
from plates import exciter_rig


def test_magnets_on_a_board_as_light_as_they_are() -> None:
    """Four of 109 g on 411 g of stiff board that heaves: two masses on a spring, driven between.

    At (M + m) / M m the resonance is 1.4 times as high as on a board that is held, where at 40 Hz
    all in phase move their magnets ten times as far.
    """
    rig = exciter_rig("type: DAEX25FHE-4, coil_mass: 0, power: 1 W, stiffness: 3189, damping: 0.76")
    plate, (length, width) = rig.plate, (0.3, 0.23)
    corners = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width)]
    eras = tuple(replace(era, x=x, y=y) for era, (x, y) in zip(rig.eras, corners, strict=True))
    stiff = replace(plate, material=replace(plate.material, E=1e13))
    rig = replace(rig, plate=stiff, eras=eras, masses=())
    free = solve_free_plate(stiff, rig.mesh, frequency_max=300.0)
    frequencies = np.array([30.0, 39.0, 55.0, 90.0])
    found = np.abs(relative_motions(rig, free, frequencies).sum(axis=1))
    exciter = eras[0]
    assert isinstance(exciter, Exciter)
    w = 2 * math.pi * frequencies
    current = exciter.voltage / (4.4 + 1j * w * 1e-4)
    back = 1j * w * (0.76 + 3.63**2 / (4.4 + 1j * w * 1e-4))
    reduced = 0.10929 * (stiff.mass / 4) / (0.10929 + stiff.mass / 4)
    expected = np.abs(3.63 * current / (3189 + back - w**2 * reduced))
    for number in range(4):
        assert found[:, number] == pytest.approx(expected, rel=0.01)


def test_excursion_within_the_frequencies_of_a_rig() -> None:
    """By its level: half of it is half as far, and from a frequency on all are within."""
    rig = exciter_rig("type: DAEX13-4SM, power: 1 W", frequency="[60, 300]")
    full = excursions_of(rig)
    half = excursions_of(replace(rig, limits=replace(rig.limits, level=0.5)))
    assert half.largest == pytest.approx(full.largest / 2)
    assert full.passed.all()
    assert 60 < half.allowed < full.allowed < 300
    narrow = replace(rig, limits=replace(rig.limits, frequency_min=full.allowed))
    assert not excursions_of(narrow).passed.any()
