"""Hidden plates in a process of their own: what is measured, felt and true is asked for."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from benchmarks.identification.hidden import Hidden, draw, finger_stiffness
from benchmarks.identification.thin_plate import Complexes, Mounted, Reals


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

    def truth(self, kind: str, seed: int) -> Mounted:
        """The plate laid open, with its modes."""
        found = self._ask("truth", kind, seed)
        assert isinstance(found, Mounted)
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
    return mounted.accelerations(
        frequency, points, fingers=fingers if len(loads) else None, loads=loads
    )


def _truth(kind: str, seed: int) -> Mounted:
    return _plate(kind, seed).mounted


_ANSWERS: dict[str, Any] = {"measured": _measured, "felt": _felt, "truth": _truth}
