"""Random draws of plates within the uncertainty, fixed by a seed: thickness exact, the rest
first-order.

Plates are drawn once per number of ERAs and fingers, from standard normal numbers whose mean and
variance are made exact, so that a few draws give the percentiles of many. Candidates are evaluated
with other draws than the promise, which would otherwise be too optimistic. 90 % of plates keep a
promise.

`ClockErrors` are delays of amplifiers, common to all ERAs of an amplifier. If an amplifier's clock
is late by d, its ERAs move as exp(-2 pi i f d) times the commanded motion. With a single amplifier
delays have no effect: a common phase of all ERAs cannot be felt.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from model.errors import InputError
from model.rig.rig import Channel


@dataclass(frozen=True)
class Drawing:
    """How plates are drawn."""

    count: int
    """Number of plates."""
    seed: int
    thicknesses: int
    """Number of their thicknesses."""
    bases: int = 1
    """Number of thicknesses at which the effects of all other parameters are computed.

    Each for equally many plates; 1 for the nominal thickness alone.
    """


JUDGING_DRAWS = Drawing(count=64, seed=1, thicknesses=5)
PROMISED_DRAWS = Drawing(count=200, seed=8, thicknesses=40, bases=5)
"""Draws for evaluating candidates, and draws for the promise."""

COMMON = 2.0
"""Error of the common gain on drawn plates, in standard deviations."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Parameters of d plates from the thinnest to the thickest, with `a` attachments, and fingers.

    In standard deviations unless stated otherwise.
    """

    loss: Float32Array
    """Loss factor (d,) of the plate."""
    damping: Float32Array
    """Damping (d,) of all ERAs."""
    own: Float32Array
    """Stiffness (a, d) of each ERA and foot, 0 of other masses; load of each finger."""
    gains: Complex64Array
    """Relative change (a, d) of the gain of each ERA, 0 elsewhere."""
    errors: Complex64Array
    """Discretization error (k, d) at each finger, of mean square 1."""
    harmonics: Complex64Array
    """Second harmonic (n, d) of each ERA relative to its motion."""
    node: IntArray
    """Thickness (d,) of each plate, by number."""
    touches: Float32Array
    """Displacement (2, k, d) of each finger from its reported position, along x and along y."""


@lru_cache(maxsize=64)
def draw(
    era_count: int,
    finger_count: int,
    *,
    masses: int = 0,
    to_feet: int = 0,
    count: int,
    seed: int,
    gain: float,
    phase: float,
    common_gain: float,
    harmonic: float,
    thicknesses: int,
) -> Draws:
    """Draw plates with ERAs, masses and fingers, with a given number of thicknesses.

    to_feet: number of masses up to the last uncertain foot; gain, phase [rad]: standard deviations
    per ERA; common_gain: for all ERAs together; harmonic: RMS per ERA. Every thickness has equally
    many plates, or one fewer. All answers of a plate share its common gain: half of the plates have
    it COMMON standard deviations low, the others high, so that 90 % of levels hold on a plate whose
    gain is within this range.
    """
    rng = np.random.default_rng([seed, era_count, finger_count])
    n, k = era_count, finger_count
    # Numbers for touches and feet come last, so that they leave all others unchanged.
    counts = [3 + n + k, n, n, k, k, 1, n, n, to_feet]
    numbers = standard_normal(rng, sum(counts) + 2 * k, count)
    numbers = numbers[:, numbers[0].argsort()]  # by thickness
    parts = np.split(numbers, np.cumsum(counts))
    parameters, sizes, phases, real, imaginary, common, harmonics, quadrature, feet, touches = parts
    common = np.where(common > np.median(common), COMMON, -COMMON)
    gains = (1 + gain * sizes) * np.exp(1j * phase * phases + common_gain * common) - 1
    of_masses = np.pad(feet, ((0, masses - to_feet), (0, 0)))
    own = np.insert(parameters[3:], [n] * masses, of_masses, axis=0)
    drawn = Draws(
        loss=parameters[1].astype(np.float32),
        damping=parameters[2].astype(np.float32),
        own=own.astype(np.float32),
        gains=np.pad(gains, ((0, masses + k), (0, 0))).astype(np.complex64),
        errors=_complex(real, imaginary),
        harmonics=_complex(harmonics, quadrature, harmonic),
        node=np.arange(count) * thicknesses // count,
        touches=touches.reshape(2, k, count).astype(np.float32),
    )
    for shared in vars(drawn).values():
        shared.setflags(write=False)  # cached, and so shared
    return drawn


def _complex(real: FloatArray, imaginary: FloatArray, size: float = 1.0) -> Complex64Array:
    """Return complex normal numbers of a root mean square (size), from real ones."""
    return np.asarray(math.sqrt(0.5) * size * (real + 1j * imaginary), dtype=np.complex64)


def standard_normal(rng: np.random.Generator, rows: int, count: int) -> np.ndarray:
    """Draw normal numbers (rows, count) with exactly mean 0 and variance 1 in each row."""
    numbers = rng.standard_normal((rows, count))
    numbers -= numbers.mean(axis=1, keepdims=True)
    return np.asarray(numbers / np.sqrt((numbers**2).mean(axis=1, keepdims=True)))


PERCENTILE = 10
"""Promised percentile of the drawn plates: 90 % have more."""


def over_fingertips(
    power: Float32Array | FloatArray, weights: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Return mean amplitude and largest squared amplitude over fingertips, both (c, k, d).

    power (c, k p, d): squared amplitudes at points; weights (k, p): of the points in the mean.
    """
    by_finger = power.reshape(len(power), *weights.shape, -1)
    means = (weights[:, None] @ np.sqrt(by_finger))[:, :, 0]
    loudest = np.maximum.reduce(by_finger, axis=2)
    return means, np.asarray(loudest)


def percentile(values: FloatArray, percent: float = PERCENTILE) -> FloatArray:
    """Return a percentile over the last axis, linear between values."""
    ordered = np.sort(values, axis=-1)
    last = ordered.shape[-1] - 1
    rank = percent / 100 * last
    low = int(rank)
    high = min(low + 1, last)
    return np.asarray(ordered[..., low] + (rank - low) * (ordered[..., high] - ordered[..., low]))


MAX_HELD = 0.0003
"""Error of a clock [s] up to which its amplifier plays contents together with others.

Beyond it, with 12 identified ERAs on three amplifiers, the ERAs of a single amplifier promise more.
"""

_AS_GOOD_AS_UNKNOWN = 0.01  # s; a period of 100 Hz
_MAX_VARIANCE = 4.0  # of a phase [rad²]; more is no phase at all


@dataclass(frozen=True)
class ClockErrors:
    """Delays of amplifiers, and the amplifier of each of n ERAs.

    Empty if one amplifier drives all ERAs or all clocks are exact; then nothing is drawn.
    """

    amplifier: tuple[int, ...] = ()
    """Amplifier (n,) of each ERA, by index of `errors`."""
    errors: tuple[float, ...] = ()
    """Rms delay [s] of each amplifier, infinite for one whose clock is not held to the others'."""

    @classmethod
    def of(
        cls, eras: Sequence[str], wiring: Mapping[str, Channel], errors: Mapping[str, float]
    ) -> "ClockErrors":
        """Make the errors of ERAs by name from their wiring and amplifiers' rms errors [s].

        Raises InputError for an amplifier whose error is missing, negative or not a number.
        """
        names = sorted({wiring[era].amplifier for era in eras})
        for name in names:
            if not errors.get(name, -1.0) >= 0:  # False for NaN
                raise InputError(
                    f"error of the clock of amplifier {name} must be given in s and not negative, "
                    f"got {errors.get(name)}"
                )
        delays = tuple([float(errors[name]) for name in names])
        if len(names) < 2 or not any(delays):
            return EXACT_CLOCKS
        amplifiers = [names.index(wiring[era].amplifier) for era in eras]
        return cls(tuple(amplifiers), delays)

    @property
    def groups(self) -> tuple[int, ...]:
        """Group of each ERA (n,): 0 for all with synchronized clocks, then one per amplifier.

        Empty if all are synchronized. A content plays on the ERAs of a single group.
        """
        alone = [number for number, error in enumerate(self.errors) if error > MAX_HELD]
        if not alone:
            return ()
        has_synchronized = len(alone) < len(self.errors)
        group_of_amplifier = dict.fromkeys(range(len(self.errors)), 0)
        for group, number in enumerate(alone, start=int(has_synchronized)):
            group_of_amplifier[number] = group
        return tuple([group_of_amplifier[number] for number in self.amplifier])

    def power_shares(self, frequencies: FloatArray) -> Float32Array | None:
        """Relative increase (f, n, n) of the modeled power of pairs of ERAs due to delays.

        None if all clocks are exact. Relative to the mean over the delays: exp(p²) - 1 for ERAs of
        one amplifier, with p = 2 pi f times its error, and 0 for others.
        """
        if not self.errors:
            return None
        amplifiers = np.array(self.amplifier)
        phases = 2 * math.pi * np.multiply.outer(frequencies, self._delay_stds)
        variance = phases[:, amplifiers] ** 2
        is_same = amplifiers[:, None] == amplifiers
        grown = np.expm1(np.minimum(variance, _MAX_VARIANCE))[:, :, None] * is_same
        return np.asarray(grown, dtype=np.float32)

    def delays(self, drawing: Drawing) -> FloatArray:
        """Delay of each amplifier on drawn plates, (amplifiers, d) [s]."""
        return self._delay_stds[:, None] * _numbers(drawing.seed, len(self.errors), drawing.count)

    @property
    def _delay_stds(self) -> FloatArray:
        return np.minimum(self.errors, _AS_GOOD_AS_UNKNOWN)


EXACT_CLOCKS = ClockErrors()
"""All ERAs on one amplifier, or clocks that agree."""


@lru_cache(maxsize=64)
def _numbers(seed: int, amplifiers: int, count: int) -> FloatArray:
    """Draw numbers in random order, unlike drawn plates, which ascend in thickness."""
    return standard_normal(np.random.default_rng([seed, amplifiers, 1]), amplifiers, count)


def delayed(
    gains: Complex64Array, clocks: ClockErrors, drawing: Drawing, omega: FloatArray
) -> Complex64Array:
    """Return gains (f, a, d) on drawn plates with delays, from gains (a, d) without.

    omega (f,) [rad/s]. Of the a attachments and fingers the ERAs come first.
    """
    factors = np.exp(-1j * omega[:, None, None] * clocks.delays(drawing))
    delayed_gains = np.repeat(gains[None], len(omega), axis=0)
    own = [*clocks.amplifier]
    era_count = len(own)
    delayed_gains[:, :era_count] = (1 + gains[:era_count]) * factors[:, own] - 1
    return delayed_gains
