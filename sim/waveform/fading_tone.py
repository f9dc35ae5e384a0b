"""A sinusoid that fades in or out along a raised cosine."""

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class FadingTone:
    """gain(t) Im[full exp(2 pi i frequency (t - origin))] from start.

    frequency [Hz]; full: complex amplitude at gain 1, in full strokes; origin [s]: of its phase.
    The gain goes from gain_from at start [s] to gain_to along a raised cosine of ramp [s];
    a ramp of 0 is a step.
    """

    frequency: float
    full: complex
    origin: float
    start: float
    ramp: float
    gain_from: float
    gain_to: float

    @property
    def settled(self) -> float:
        """End of the fade [s]."""
        return self.start + self.ramp

    @property
    def lasts(self) -> bool:
        """Whether it is audible once settled."""
        return self.gain_to > 0

    @property
    def settled_amplitude(self) -> complex:
        """Settled complex amplitude in full strokes."""
        return self.full * self.gain_to

    @property
    def silent_from(self) -> float:
        """Time of silence [s]; infinity for a lasting tone."""
        return self.settled if self.gain_to == 0 else math.inf

    def gain(self, time: float) -> float:
        """Gain at a time [s] not before start."""
        if time >= self.settled:
            return self.gain_to
        share = (1 - math.cos(math.pi * (time - self.start) / self.ramp)) / 2
        return self.gain_from + (self.gain_to - self.gain_from) * share

    def amplitude(self, time: float) -> complex:
        """Complex amplitude in full strokes at a time [s] not before start."""
        return self.full * self.gain(time)

    def fade_out(self, time: float, *, ramp: float) -> "FadingTone":
        """This tone, silent within ramp [s]; a fade-out that ends sooner is kept.

        An interrupted fade continues from its present gain.
        """
        if self.silent_from <= time + ramp:
            return self
        return replace(self, start=time, ramp=ramp, gain_from=self.gain(time), gain_to=0.0)
