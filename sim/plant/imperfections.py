"""How real amplifiers differ from what they are told: gain, phase, noise, and time.

The simulated bench is perfect unless it is given some. What a channel plays then reaches the base
of its ERA with the channel's gain and phase, with its noise on top while it plays, and late: by the
latency that all amplifiers have, and each by its own skew. Not modelled: clocks that run at
different speeds, distortion, and errors that drift.
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
from sim.waveform.output import Output

NOISE_LINES = 32
NOISE_LOW, NOISE_HIGH = 10.0, 1000.0  # Hz


@dataclass(frozen=True)
class ChannelErrors:
    """Of one channel: gain, a factor; phase [rad]; noise, rms in full strokes while it plays."""

    gain: float = 1.0
    phase: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what no channel does."""
        if not all(math.isfinite(value) for value in (self.gain, self.phase, self.noise)):
            raise InputError(f"{self}: gain, phase and noise must be finite numbers")
        if self.gain < 0 or self.noise < 0:
            raise InputError(f"{self}: gain and noise must not be below zero")


@dataclass(frozen=True)
class Imperfections:
    """Of a whole bench; none by default.

    channels: those that are not perfect; latency [s]: from when a command is carried out until a
    base moves as it says; skew [s]: how much later or earlier than that an amplifier is, by name;
    seed: of the noise.
    """

    channels: Mapping[Channel, ChannelErrors] = field(default_factory=dict)
    latency: float = 0.0
    skew: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse times that are none, and a base that moves before it was told to."""
        for delay in (self.latency, *(self.latency + skew for skew in self.skew.values())):
            if not (math.isfinite(delay) and delay >= 0):
                raise InputError(
                    f"a latency of {self.latency:g} s with skews {dict(self.skew)} would move a "
                    f"base {delay:g} s after its command; latency plus skew must not be below zero"
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
                    f"imperfections: {name} is no amplifier of the rig: {', '.join(rig.amplifiers)}"
                )

    def delay(self, amplifier: str) -> float:
        """From a command of this amplifier until bases move [s]."""
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
    """Errors for every channel and amplifier of a rig, the same for the same seed.

    gain and phase [rad]: standard deviations, normal, those of the robust contrast by default;
    noise: that of every channel; latency [s]; skew [s]: amplifiers differ by up to this, uniform.
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
    """What a channel plays, so much later [s]."""
    if delay == 0:
        return output
    return tuple(
        replace(tone, start=tone.start + delay, origin=tone.origin + delay) for tone in output
    )


def realised(terms: Sequence[Term], errors: ChannelErrors) -> list[Term]:
    """The motion of a base that these terms would move, with its channel's gain and phase."""
    if (errors.gain, errors.phase) == (1.0, 0.0):
        return list(terms)
    turn = cmath.rect(errors.gain, errors.phase)
    return [replace(term, c0=turn * term.c0, c1=turn * term.c1) for term in terms]


@dataclass(frozen=True)
class Noise:
    """Stationary noise from 10 to 1000 Hz, as sinusoids that the plate is solved for exactly.

    One line at a random place and with a random phase in each of 32 equal bands, all of one size;
    near enough to a normal distribution. omegas [rad/s] and phases [rad] at time 0: (n,).
    """

    omegas: tuple[float, ...]
    phases: tuple[float, ...]

    def terms(self, rms: float, *, start: float, end: float) -> list[Term]:
        """Its share in the motion of a base from start to end [s]; rms [m]."""
        size = rms * math.sqrt(2 / len(self.omegas))
        return [
            Term(start, end, omega, cmath.rect(size, phase + omega * start))
            for omega, phase in zip(self.omegas, self.phases, strict=True)
        ]


def draw_noise(*, seed: int, number: int) -> Noise:
    """The noise of one of many sources, by its number."""
    rng = np.random.default_rng([seed, number])
    edges = np.linspace(NOISE_LOW, NOISE_HIGH, NOISE_LINES + 1)
    frequencies = rng.uniform(edges[:-1], edges[1:])
    phases = rng.uniform(0, 2 * math.pi, NOISE_LINES)
    return Noise(tuple((2 * math.pi * frequencies).tolist()), tuple(phases.tolist()))
