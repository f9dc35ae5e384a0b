"""Hidden plates in a process of their own: what is measured, felt and true is asked for."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from benchmarks.identification.hidden import Hidden, draw, finger_stiffness
from benchmarks.identification.thin_plate import Complexes, Mounted, Reals


@dataclass(frozen=True, eq=False)
class Truth:
    """A hidden plate laid open, for what would be answered if it were known.

    mounted: with its modes; receptance (f, r) of these, attached (n + masses, r) their shapes at
    ERAs and masses, shapes (p, r) those at points.
    """

    mounted: Mounted
    receptance: Complexes
    attached: Reals
    shapes: Reals


class HiddenPlates:
    """Client of the process with the hidden plates."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def measured(self, kind: str, seed: int, frequencies: Reals, sensors: int) -> Complexes:
        """Responses at so many sensors (f, s, n) [1/s²] with noise, the first ones at the ERAs."""
        return np.asarray(self._ask("measured", kind, seed, frequencies, sensors))

    def felt(
        self, kind: str, seed: int, frequency: float, points: Reals, fingers: Reals, factors: Reals
    ) -> Complexes:
        """Acceleration at points (p, 2) per base displacement (p, n) [1/s²].

        fingers (k, 2) [m], factors (k, 4) of their loads, (0, 4) for weightless ones.
        """
        return np.asarray(self._ask("felt", kind, seed, frequency, points, fingers, factors))

    def truth(self, kind: str, seed: int, frequencies: Reals, points: Reals) -> Truth:
        """The plate laid open, with shapes at points (p, 2) [m]."""
        found = self._ask("truth", kind, seed, frequencies, points)
        assert isinstance(found, Truth)
        return found

    def _ask(self, *question: object) -> Any:
        self._connection.send(question)
        return self._connection.recv()


@contextmanager
def hidden_plates() -> Iterator[HiddenPlates]:
    """Run the process while the block does."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), daemon=True)
    process.start()
    try:
        yield HiddenPlates(ours)
    finally:
        ours.send(("stop",))
        process.join()


def _serve(connection: Connection) -> None:
    while True:
        what, *arguments = connection.recv()
        if what == "stop":
            return
        connection.send(_ANSWERS[what](*arguments))


@lru_cache(maxsize=2)
def _plate(kind: str, seed: int) -> Hidden:
    return draw(kind, seed)


def _measured(kind: str, seed: int, frequencies: Reals, sensors: int) -> Complexes:
    return _plate(kind, seed).measured(frequencies, np.random.default_rng([seed, 1]), sensors)


def _felt(
    kind: str, seed: int, frequency: float, points: Reals, fingers: Reals, factors: Reals
) -> Complexes:
    loads = np.array([finger_stiffness(frequency, each) for each in factors], dtype=complex)
    mounted = _plate(kind, seed).mounted
    inside = np.clip(points, 0, [mounted.plate.length, mounted.plate.width])
    return mounted.accelerations(
        frequency, inside, fingers=fingers if len(loads) else None, loads=loads
    )


def _truth(kind: str, seed: int, frequencies: Reals, points: Reals) -> Truth:
    return truth_of(_plate(kind, seed).mounted, frequencies, points)


def truth_of(mounted: Mounted, frequencies: Reals, points: Reals) -> Truth:
    """A mounted plate laid open at frequencies (f,) [Hz], with shapes at points (p, 2) [m]."""
    plate = mounted.plate
    places = np.vstack([mounted.at, mounted.masses[:, :2]])
    return Truth(
        mounted,
        np.array([mounted.receptance(float(f)) for f in frequencies]),
        plate.shapes(places),
        plate.shapes(np.clip(points, 0, [plate.length, plate.width])),
    )


_ANSWERS: dict[str, Any] = {"measured": _measured, "felt": _felt, "truth": _truth}
