"""What the clocks of several amplifiers on one plate cost: a delay of each, common to its ERAs.

An ERA of an amplifier whose clock is late by d moves as exp(-2 pi i f d) of what it should. One
amplifier alone has none that counts: a phase of all ERAs together is not felt.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray
from model.ensemble.draws import Drawing, standard_normal
from model.errors import InputError
from model.rig.rig import Channel

MAX_HELD = 0.0003
"""Error of a clock [s] up to which its amplifier plays contents together with others.

Of 12 identified ERAs on three amplifiers, those of one alone promise more beyond it.
"""

_AS_GOOD_AS_UNKNOWN = 0.01  # s; a period of 100 Hz
_MAX_VARIANCE = 4.0  # of a phase [rad²]; more is no phase at all


@dataclass(frozen=True)
class ClockErrors:
    """Delays of amplifiers, rms [s], and which of them each of n ERAs is on.

    amplifier (n,): of each ERA, by index of errors; errors: of each amplifier, infinite for one
    whose clock is not held to the others'. Empty where one amplifier has all ERAs, or all clocks
    are exact: then nothing is drawn.
    """

    amplifier: tuple[int, ...] = ()
    errors: tuple[float, ...] = ()

    @classmethod
    def of(
        cls, eras: Sequence[str], wiring: Mapping[str, Channel], errors: Mapping[str, float]
    ) -> "ClockErrors":
        """Of ERAs by name, their wiring, and errors of the amplifiers' clocks, rms [s] by name.

        Raises InputError for an amplifier whose error is missing, negative or not a number.
        """
        names = sorted({wiring[era].amplifier for era in eras})
        for name in names:
            if not errors.get(name, -1.0) >= 0:  # False for NaN
                raise InputError(
                    f"error of the clock of amplifier {name} must be given in s and not negative, "
                    f"got {errors.get(name)}"
                )
        found = tuple(float(errors[name]) for name in names)
        if len(names) < 2 or not any(found):
            return EXACT_CLOCKS
        return cls(tuple(names.index(wiring[era].amplifier) for era in eras), found)

    @property
    def groups(self) -> tuple[int, ...]:
        """Group of each ERA (n,): 0 for all whose clocks are held together, one for each other.

        Empty where all are held together. One content plays on the ERAs of one group only.
        """
        alone = [number for number, each in enumerate(self.errors) if each > MAX_HELD]
        if not alone:
            return ()
        held = [number for number in range(len(self.errors)) if number not in alone]
        order = [held, *([each] for each in alone)] if held else [[each] for each in alone]
        return tuple(
            next(number for number, group in enumerate(order) if amplifier in group)
            for amplifier in self.amplifier
        )

    def power_shares(self, frequencies: FloatArray) -> Float32Array | None:
        """By how much the modelled power of pairs of ERAs grows, (f, n, n); None for none.

        Relative to the mean over the delays: exp(p²) - 1 of ERAs of one amplifier, p = 2 pi f times
        its error, 0 of others.
        """
        if not self.errors:
            return None
        own = np.array(self.amplifier)
        phases = 2 * math.pi * np.multiply.outer(frequencies, self._known)
        variance = phases[:, own] ** 2
        is_same = own[:, None] == own
        grown = np.expm1(np.minimum(variance, _MAX_VARIANCE))[:, :, None] * is_same
        return np.asarray(grown, dtype=np.float32)

    def delays(self, by: Drawing) -> FloatArray:
        """By how much each of the amplifiers is late on drawn plates, (amplifiers, d) [s]."""
        return self._known[:, None] * _numbers(by.seed, len(self.errors), by.count)

    @property
    def _known(self) -> FloatArray:
        return np.minimum(self.errors, _AS_GOOD_AS_UNKNOWN)


EXACT_CLOCKS = ClockErrors()
"""All ERAs on one amplifier, or clocks that agree."""


@lru_cache(maxsize=64)
def _numbers(seed: int, amplifiers: int, count: int) -> FloatArray:
    """In no order, where drawn plates are in that of their thicknesses."""
    return standard_normal(np.random.default_rng([seed, amplifiers, 1]), amplifiers, count)


def delayed(
    gains: Complex64Array, clocks: ClockErrors, by: Drawing, omega: FloatArray
) -> Complex64Array:
    """Gains (a, d) on drawn plates, at each of f frequencies (f,) [rad/s], as clocks are off.

    The ERAs come first of the a attachments and fingers. Returns (f, a, d).
    """
    factors = np.exp(-1j * omega[:, None, None] * clocks.delays(by))
    found = np.repeat(gains[None], len(omega), axis=0)
    own = [*clocks.amplifier]
    found[:, : len(own)] = (1 + gains[: len(own)]) * factors[:, own] - 1
    return found
