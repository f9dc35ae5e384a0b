"""A sinusoid whose amplitude and phase follow the knots of an envelope."""

import math
from dataclasses import dataclass

from sim.waveform.fading_tone import FadingTone


@dataclass(frozen=True, slots=True)
class ShapedTone:
    """Im[a(t) exp(2 pi i frequency (t - origin))] from start, a in full strokes.

    frequency [Hz]; start, origin [s]; a interpolates `values` linearly, one per step [s] from
    start, and stays at the last.
    """

    frequency: float
    origin: float
    start: float
    step: float
    values: tuple[complex, ...]

    @property
    def settled(self) -> float:
        """Time of the last value [s]."""
        return self.start + self.step * (len(self.values) - 1)

    @property
    def lasts(self) -> bool:
        """Whether it is audible once settled."""
        return self.values[-1] != 0

    @property
    def settled_amplitude(self) -> complex:
        """Settled complex amplitude."""
        return self.values[-1]

    @property
    def silent_from(self) -> float:
        """Time of silence [s]; infinity for a lasting tone."""
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
        """Fade from the present amplitude, within ramp [s], unless it ends sooner."""
        if self.silent_from <= time + ramp:
            return self
        reached = self.amplitude(time)
        return FadingTone(self.frequency, reached, self.origin, time, ramp, 1.0, 0.0)
