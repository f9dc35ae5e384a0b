"""A sinusoid whose amplitude and phase follow the knots of an envelope."""

import math
from dataclasses import dataclass

from sim.waveform.fading_tone import FadingTone


@dataclass(frozen=True, slots=True)
class ShapedTone:
    """Im[a(t) exp(2 pi i frequency (t - origin))] from start on, a in full strokes.

    frequency [Hz]; start, origin [s]; a goes along straight lines through `values`, the first at
    start, then one every step [s], and stays at the last.
    """

    frequency: float
    origin: float
    start: float
    step: float
    values: tuple[complex, ...]

    @property
    def settled(self) -> float:
        """When the last value is reached [s]."""
        return self.start + self.step * (len(self.values) - 1)

    @property
    def lasts(self) -> bool:
        """Whether it stays, once it has settled."""
        return self.values[-1] != 0

    @property
    def settled_amplitude(self) -> complex:
        """Complex amplitude once it has settled."""
        return self.values[-1]

    @property
    def silent_from(self) -> float:
        """When the tone has ended [s]; infinity for one that stays."""
        return math.inf if self.lasts else self.settled

    def amplitude(self, time: float) -> complex:
        """Complex amplitude at a time [s] not before start."""
        steps = (time - self.start) / self.step
        before = int(steps)
        if before >= len(self.values) - 1:
            return self.values[-1]
        here, there = self.values[before : before + 2]
        return here + (there - here) * (steps - before)

    def fade_out(self, time: float, *, ramp: float) -> "FadingTone | ShapedTone":
        """The tone with the amplitude it has reached, silent within ramp [s].

        One that ends sooner by itself is left as it is.
        """
        if self.silent_from <= time + ramp:
            return self
        reached = self.amplitude(time)
        return FadingTone(self.frequency, reached, self.origin, time, ramp, 1.0, 0.0)
