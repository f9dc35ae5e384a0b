"""Imperfections of amplifiers: errors of gain and phase, noise, latency and skew.

Not modelled: clock drift, distortion, drifting errors.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from model.errors import InputError
from model.rig.rig import Channel, Rig
from model.transients.base_motion import Term
from model.vibration.excitation import GAIN_ERROR, PHASE_ERROR
from sim.waveform import Output

NOISE_LINES = 32
NOISE_LOW, NOISE_HIGH = 10.0, 1000.0  # Hz


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of one channel: gain factor, phase [rad], noise rms in full strokes while it plays."""

    gain: float = 1.0
    phase: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not all(math.isfinite(value) for value in (self.gain, self.phase, self.noise)):
            raise InputError(f"{self}: gain, phase and noise must be finite numbers")
        if self.gain < 0 or self.noise < 0:
            raise InputError(f"{self}: gain and noise must not be negative")


@dataclass(frozen=True)
class Imperfections:
    """Imperfections of a bench, by default none.

    channels: errors by channel; latency [s]: from a command to the base motion; skew [s]: added to
    the latency, by amplifier; seed: of the noise.
    """

    channels: Mapping[Channel, ChannelErrors] = field(default_factory=dict)
    latency: float = 0.0
    skew: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        """Check that every delay is finite and not negative."""
        for delay in (self.latency, *(self.latency + skew for skew in self.skew.values())):
            if not (math.isfinite(delay) and delay >= 0):
                raise InputError(
                    f"latency plus skew must be finite and not negative, got {delay:g} s (latency "
                    f"{self.latency:g} s, skew {dict(self.skew)})"
                )

    def check(self, rig: Rig) -> None:
        """Raise InputError for amplifiers and channels that the rig does not have."""
        wired = set(rig.wiring.values())
        for channel in self.channels:
            if channel not in wired:
                raise InputError(
                    f"imperfections: no ERA is wired to channel {channel.number} of amplifier "
                    f"{channel.amplifier}"
                )
        for name in self.skew:
            if name not in rig.amplifiers:
                raise InputError(
                    f"imperfections: amplifier must be one of {', '.join(rig.amplifiers)}, "
                    f"got {name}"
                )

    def delay(self, amplifier: str) -> float:
        """Delay from a command of this amplifier to the base motion [s]."""
        return self.latency + self.skew.get(amplifier, 0.0)


def draw_imperfections(
    rig: Rig,
    *,
    gain: float = GAIN_ERROR,
    phase: float = PHASE_ERROR,
    noise: float = 0.0,
    latency: float = 0.0,
    skew: float = 0.0,
    seed: int = 0,
) -> Imperfections:
    """Draw errors for all channels and amplifiers of a rig.

    gain, phase [rad]: standard deviations, by default those of the robust contrast; noise: rms of
    every channel; latency [s]; skew [s]: maximum, uniformly distributed.
    """
    rng = np.random.default_rng(seed)
    channels = {
        channel: ChannelErrors(
            max(0.0, 1 + gain * rng.standard_normal()), phase * rng.standard_normal(), noise
        )
        for channel in rig.wiring.values()
    }
    late = {name: float(rng.uniform(0, skew)) for name in rig.amplifiers}
    return Imperfections(channels, latency, late, seed)


def delayed(output: Output, delay: float) -> Output:
    """The output of a channel, delayed [s]."""
    if delay == 0:
        return output
    return tuple(
        replace(tone, start=tone.start + delay, origin=tone.origin + delay) for tone in output
    )


def realised(terms: Sequence[Term], errors: ChannelErrors) -> list[Term]:
    """Base motion with the gain and phase errors of its channel."""
    if (errors.gain, errors.phase) == (1.0, 0.0):
        return list(terms)
    phase_factor = cmath.rect(errors.gain, errors.phase)
    return [replace(term, c0=phase_factor * term.c0, c1=phase_factor * term.c1) for term in terms]


@dataclass(frozen=True)
class Noise:
    """Stationary noise from 10 to 1000 Hz as a sum of sinusoids.

    One line of random frequency and phase in each of 32 equal bands, all of equal amplitude; nearly
    normally distributed. omegas [rad/s], phases [rad] at time 0: (n,).
    """

    omegas: tuple[float, ...]
    phases: tuple[float, ...]

    def terms(self, rms: float, *, start: float, end: float) -> list[Term]:
        """Its base motion from start to end [s]; rms [m]."""
        size = rms * math.sqrt(2 / len(self.omegas))
        return [
            Term(start, end, omega, cmath.rect(size, phase + omega * start))
            for omega, phase in zip(self.omegas, self.phases, strict=True)
        ]


def draw_noise(*, seed: int, number: int) -> Noise:
    """Draw the noise of a source by its number."""
    rng = np.random.default_rng([seed, number])
    edges = np.linspace(NOISE_LOW, NOISE_HIGH, NOISE_LINES + 1)
    frequencies = rng.uniform(edges[:-1], edges[1:])
    phases = rng.uniform(0, 2 * math.pi, NOISE_LINES)
    return Noise(tuple((2 * math.pi * frequencies).tolist()), tuple(phases.tolist()))
