"""Output of a channel in time: a sum of sinusoids that fade, or follow an envelope.

Every change is a cross-fade along a raised cosine, whose two gains add up to one.
"""

import cmath
import math
from collections import defaultdict
from itertools import pairwise
from typing import NamedTuple, TypeAlias

from model.transients.base_motion import Fade, Term


class FadingTone(NamedTuple):
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
    def is_lasting(self) -> bool:
        """Whether its final amplitude is non-zero."""
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
        gain = (1 - math.cos(math.pi * (time - self.start) / self.ramp)) / 2
        return self.gain_from + (self.gain_to - self.gain_from) * gain

    def amplitude(self, time: float) -> complex:
        """Complex amplitude in full strokes at a time [s] not before start."""
        return self.full * self.gain(time)

    def fade_out(self, time: float, *, ramp: float) -> "FadingTone":
        """This tone, silent within ramp [s]; a fade-out that ends sooner is kept.

        An interrupted fade continues from its present gain.
        """
        if self.silent_from <= time + ramp:
            return self
        gain = self.gain(time)
        return FadingTone(self.frequency, self.full, self.origin, time, ramp, gain, 0.0)

    def motion(self, *, stroke: float) -> tuple[Fade]:
        """Base motion of an ERA with this stroke [m] whose channel plays it."""
        omega = 2 * math.pi * self.frequency
        amplitude = stroke * self.full * cmath.exp(1j * omega * (self.start - self.origin))
        return (Fade(self.start, self.ramp, omega, amplitude, self.gain_from, self.gain_to),)


class ShapedTone(NamedTuple):
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
    def is_lasting(self) -> bool:
        """Whether its final amplitude is non-zero."""
        return self.values[-1] != 0

    @property
    def settled_amplitude(self) -> complex:
        """Settled complex amplitude."""
        return self.values[-1]

    @property
    def silent_from(self) -> float:
        """Time of silence [s]; infinity for a lasting tone."""
        return math.inf if self.is_lasting else self.settled

    def amplitude(self, time: float) -> complex:
        """Complex amplitude at a time [s] not before start."""
        steps = (time - self.start) / self.step
        before = int(steps)
        if before >= len(self.values) - 1:
            return self.values[-1]
        here, there = self.values[before : before + 2]
        return here + (there - here) * (steps - before)

    def fade_out(self, time: float, *, ramp: float) -> "FadingTone | ShapedTone":
        """Fade from the present amplitude within ramp [s], or by its own end where that is sooner.

        Without its further knots, which may be higher.
        """
        ramp = max(0.0, min(ramp, self.silent_from - time))
        reached = self.amplitude(time)
        return FadingTone(self.frequency, reached, self.origin, time, ramp, 1.0, 0.0)

    def motion(self, *, stroke: float) -> tuple[Term, ...]:
        """Base motion of an ERA with this stroke [m] whose channel plays it."""
        omega = 2 * math.pi * self.frequency
        terms = []
        # Computed once: between a sum and a product, samples would belong to both terms or none.
        moments = [self.start + number * self.step for number in range(len(self.values))]
        for (since, until), (here, there) in zip(
            pairwise(moments), pairwise(self.values), strict=True
        ):
            phase_factor = stroke * cmath.exp(1j * omega * (since - self.origin))
            slope = (there - here) / self.step
            terms.append(Term(since, until, omega, here * phase_factor, slope * phase_factor))
        if self.is_lasting:
            phase_factor = stroke * cmath.exp(1j * omega * (self.settled - self.origin))
            terms.append(Term(self.settled, math.inf, omega, self.values[-1] * phase_factor))
        return tuple(terms)


ToneSegment: TypeAlias = FadingTone | ShapedTone

Output: TypeAlias = tuple[ToneSegment, ...]
"""The output of one channel: the sum of these tones."""


def fade_to(
    playing: Output,
    time: float,
    *,
    ramp: float,
    frequency: float = 0.0,
    amplitude: complex = 0j,
    keep_phase: bool = False,
) -> Output:
    """The output after a command at a time [s] to fade to a tone within ramp [s].

    amplitude in full strokes, 0 for silence. Its phase counts from `time`; with keep_phase, from
    the origin of a lasting tone of the same frequency.
    """
    fading: Output = ()
    if ramp > 0:
        audible = [tone for tone in playing if tone.silent_from > time]
        fading = tuple([tone.fade_out(time, ramp=ramp) for tone in audible])
    if amplitude == 0:
        return fading
    origin = time
    if keep_phase:
        same = [tone for tone in playing if tone.is_lasting and tone.frequency == frequency]
        origin = same[0].origin if same else time
    gain_from = 1.0 if ramp == 0 else 0.0
    return (*fading, FadingTone(frequency, amplitude, origin, time, ramp, gain_from, 1.0))


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
    """The output after a command at a time [s] to follow an envelope to a tone.

    amplitude and knots in full strokes, ramp and step in s. With keep_phase a lasting tone of the
    same frequency continues from its present amplitude; else the new one begins at zero. All others
    fade out within ramp.
    """
    continuing = next(
        (
            tone
            for tone in playing
            if keep_phase and tone.is_lasting and tone.frequency == frequency
        ),
        None,
    )
    faded = (tone.fade_out(time, ramp=ramp) for tone in playing if tone is not continuing)
    fading = tuple(tone for tone in faded if tone.silent_from > time)
    begin = 0j if continuing is None else continuing.amplitude(time)
    origin = time if continuing is None else continuing.origin
    return (*fading, ShapedTone(frequency, origin, time, step, (begin, *knots, amplitude)))


def end_along(
    playing: Output, time: float, *, ramp: float, step: float, knots: tuple[complex, ...]
) -> Output:
    """The output after a command at a time [s] to end along an envelope; see `shape_to`.

    The ending is that of the newest tone, from its present amplitude, also while an onset leads it
    to silence; of one that is silent already there is none.
    """
    newest = playing[-1] if playing else None
    if newest is None or newest.silent_from <= time:
        return fade_to(playing, time, ramp=ramp)
    fading = fade_to(playing[:-1], time, ramp=ramp)
    values = (newest.amplitude(time), *knots, 0j)
    return (*fading, ShapedTone(newest.frequency, newest.origin, time, step, values))


def level_of(playing: Output, time: float) -> float:
    """Level 0..1 of a channel at a time [s], fades included.

    Tones of one frequency add as complex amplitudes, magnitudes add across frequencies.
    """
    if len(playing) < 2:
        return sum(abs(tone.amplitude(time)) for tone in playing)
    amplitudes: dict[float, complex] = defaultdict(complex)
    for tone in playing:
        phase_factor = cmath.exp(-2j * math.pi * tone.frequency * tone.origin)
        amplitudes[tone.frequency] += tone.amplitude(time) * phase_factor
    return sum(abs(amplitude) for amplitude in amplitudes.values())
