"""The motion of a base, and the plate in time."""

import cmath
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from model.errors import InputError
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import Era
from model.structure.materials import material
from model.structure.plate import Plate
from model.transients.base_motion import BaseMotions, Motion, raised_cosine
from model.transients.time_response import plate_in_time

OMEGA = 2 * math.pi * 110.0


class Fade(NamedTuple):
    """From one complex amplitude [m] to another; start and ramp [s]."""

    start: float
    ramp: float
    omega: float
    first: complex
    last: complex


FADES = [
    Fade(1.0, 0.02, OMEGA, 0j, 1e-4 * cmath.exp(0.7j)),
    Fade(1.005, 0.01, 2 * OMEGA, 1.6e-4j, 6e-5 - 2e-5j),
    Fade(1.01, 0.03, OMEGA, 5e-5 + 0j, 0j),
    Fade(1.015, 0.0, OMEGA / 2, 0j, 6e-5 + 0j),
]


def moved(motions: BaseMotions, number: int, era: int, time: float) -> float:
    """Displacement [m] of a base at a time [s] by the definition of a term."""
    (of_set,) = motions.active([number], [time])
    tau = time - motions.start
    value = motions.c0 + (0j if motions.c1 is None else motions.c1) * tau
    y = (value * np.exp(1j * motions.omega * tau)).imag
    return float(y[of_set & (motions.era == era)].sum())


def faded(fade: Fade, time: float) -> float:
    """Displacement [m] along a raised cosine."""
    tau = time - fade.start
    if tau < 0:
        return 0.0
    share = 1.0 if tau >= fade.ramp else (1 - math.cos(math.pi * tau / fade.ramp)) / 2
    amplitude = fade.first + (fade.last - fade.first) * share
    return (amplitude * cmath.exp(1j * fade.omega * tau)).imag


def terms(fades: Sequence[Fade]) -> Motion:
    """The motion of a base by some fades."""
    return [term for fade in fades for term in raised_cosine(*fade)]


@pytest.mark.parametrize("time", [0.99, 1.0, 1.0031, 1.0142, 1.015, 1.0199, 1.03, 1.2])
def test_terms_of_fades_add_up_to_raised_cosines(time: float) -> None:
    """Of two sets of motions each base has its own, at every moment of a fade and after it."""
    rest: Motion = ()
    motions = BaseMotions([terms(FADES[:1]), terms(FADES[1:3])], [rest, terms(FADES[3:])])
    for number, era, fades in (
        (0, 0, FADES[:1]),
        (0, 1, FADES[1:3]),
        (1, 0, []),
        (1, 1, FADES[3:]),
    ):
        expected = sum(faded(fade, time) for fade in fades)
        assert moved(motions, number, era, time) == pytest.approx(expected, abs=1e-17)


def test_terms_that_have_ended_are_left_out() -> None:
    """A fade to silence is forgotten once it is silent, a lasting tone is not."""
    motions = BaseMotions([terms([FADES[0], FADES[2]])], since=1.05)
    assert motions.omega.tolist() == [OMEGA]
    assert motions.end.tolist() == [math.inf]


ERA = Era("", 0, 0, stiffness=100.0**2, damping=2 * 100.0, bolt_mass=0.0, stroke=1e-4)
"""Under one kilogram it is damped critically, in numbers that are exact."""


PLATE = Plate(0.3, 0.2, 0.001, material("steel"), loss_factor=0.0)
THREE_MASSES = ReducedPlate(
    PLATE, np.zeros(3), np.zeros(3), lambda points: np.eye(3)[: len(points)]
)
"""A kilogram on each of three ERAs, and nothing between them: as few coordinates as stand."""


@pytest.mark.parametrize("mass", [0.0, 3.0])
def test_plate_in_time_refuses_critical_damping(mass: float) -> None:
    """c = 2 sqrt(k m): two eigenvectors are one, and nothing must be computed with their inverse.

    With 1 + 3 kg and twice the damping as well, there the numbers make it singular altogether.
    """
    factor = (1 + mass) ** 0.5
    era = replace(ERA, bolt_mass=mass, damping=factor * ERA.damping)
    eras = [replace(era, x=x, y=y) for x, y in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1))]
    with pytest.raises(InputError, match="damped critically"):
        plate_in_time(THREE_MASSES, eras)
    softer = [replace(each, damping=0.999 * era.damping) for each in eras]
    solved = plate_in_time(THREE_MASSES, softer)
    assert np.abs(solved.eigenvalues) == pytest.approx(100 / factor)
