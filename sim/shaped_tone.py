"""A sinusoid whose amplitude and phase follow the knots of an envelope."""

import cmath
import math
from dataclasses import dataclass

from sim.waveform import FadingTone, Output


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
        level, phase = cmath.polar(self.amplitude(time))
        return FadingTone(self.frequency, level, phase, self.origin, time, ramp, 1.0, 0.0)


def shape_to(
    playing: Output,
    time: float,
    *,
    ramp: float,
    step: float,
    knots: tuple[complex, ...],
    frequency: float,
    amplitude: complex,
    keep_phase: bool,
) -> Output:
    """What a channel plays once it was told at time [s] to go to this tone along an envelope.

    amplitude and knots in full strokes, ramp and step in s. Where the channel is about to play this
    frequency already and keep_phase is set, the tone that does goes on from the amplitude it has;
    else the new one begins at zero. All others fade out within ramp.
    """
    going_on = next(
        (tone for tone in playing if keep_phase and tone.lasts and tone.frequency == frequency),
        None,
    )
    faded = (tone.fade_out(time, ramp=ramp) for tone in playing if tone is not going_on)
    fading = tuple(tone for tone in faded if tone.silent_from > time)
    begin = 0j if going_on is None else going_on.amplitude(time)
    origin = time if going_on is None else going_on.origin
    return (*fading, ShapedTone(frequency, origin, time, step, (begin, *knots, amplitude)))


def end_along(
    playing: Output, time: float, *, ramp: float, step: float, knots: tuple[complex, ...]
) -> Output:
    """What a channel plays once it was told at time [s] to end along an envelope; as `shape_to`."""
    lasting = next((tone for tone in playing if tone.lasts), None)
    if lasting is None:
        return tuple(tone for tone in playing if tone.silent_from > time)
    return shape_to(
        playing,
        time,
        ramp=ramp,
        step=step,
        knots=knots,
        frequency=lasting.frequency,
        amplitude=0j,
        keep_phase=True,
    )
