"""Settled patterns of a hidden plate, whose theory is not the model's, at random touches."""

from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

from benchmarks.identification.hidden import LENGTH, WIDTH, Hidden, finger_stiffness
from benchmarks.identification.thin_plate import Mounted
from benchmarks.setting import random_contacts
from model.identification.forward import RestingFinger
from model.identification.settled_patterns import SettledPattern
from model.structure.attachments import Fingertip

FREQUENCIES = np.linspace(40.0, 500.0, 27)
SECONDS = 12.0  # between patterns

_Found = TypeVar("_Found")


def settled_patterns(
    hidden: Hidden,
    plate: Mounted,
    *,
    count: int,
    start: int = 0,
    noise: float = 0.01,
    heaviest: float | None = None,
) -> Iterator[SettledPattern]:
    """Patterns from a number on, under two to four fingers of unknown loads, read with noise.

    heaviest: load of the first finger of each, relative to the usual one.
    """
    for number in range(start, start + count):
        rng = np.random.default_rng([7, number])
        places = random_contacts(rng, int(rng.integers(2, 5)), (LENGTH, WIDTH), margin=0.013)
        frequency = float(rng.choice(FREQUENCIES))
        bases = 50e-6 * rng.uniform(0.2, 1, 4) * np.exp(2j * np.pi * rng.uniform(size=4))
        factors = np.exp(0.5 * rng.standard_normal(len(places)))
        if heaviest is not None:
            factors[0] = heaviest
        loads = np.array([finger_stiffness(frequency, np.full(4, each)) for each in factors])
        felt = plate.accelerations(frequency, plate.at, fingers=places, loads=loads)
        values = hidden.sensor_gain * (felt @ bases)
        parts = rng.standard_normal((2, 4))
        values = values + noise * np.abs(values) * (parts[0] + 1j * parts[1])
        fingers = tuple(RestingFinger(x, y, Fingertip()) for x, y in places.tolist())
        yield SettledPattern(number * SECONDS, frequency, bases, values, fingers)


def played(
    take: Callable[[SettledPattern], _Found],
    hidden: Hidden,
    plate: Mounted,
    *,
    count: int,
    start: int = 0,
) -> list[_Found]:
    """What is found of each of some patterns."""
    return [take(each) for each in settled_patterns(hidden, plate, count=count, start=start)]
