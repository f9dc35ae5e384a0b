"""What a channel of a simulated amplifier plays: sinusoids that fade in and out.

Every change is a fade: what was played fades out while what shall be played fades in, both along
the same raised cosine, so that their gains add up to one at any moment.
"""

import cmath
import math
from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias, Union

if TYPE_CHECKING:
    from sim.shaped_tone import ShapedTone


@dataclass(frozen=True, slots=True)
class FadingTone:
    """gain(t) level sin(2 pi frequency (t - origin) + phase) from start on.

    frequency [Hz]; level: 0..1 of full stroke; phase [rad]; origin: when the phase was set [s].
    The gain goes from gain_from at start [s] to gain_to along a raised cosine of ramp [s] and stays
    there; a ramp of 0 is a jump.
    """

    frequency: float
    level: float
    phase: float
    origin: float
    start: float
    ramp: float
    gain_from: float
    gain_to: float

    @property
    def settled(self) -> float:
        """When the fade is over [s]."""
        return self.start + self.ramp

    @property
    def lasts(self) -> bool:
        """Whether it stays, once it has settled."""
        return self.gain_to > 0

    @property
    def settled_amplitude(self) -> complex:
        """Complex amplitude in full strokes once it has settled."""
        return cmath.rect(self.level * self.gain_to, self.phase)

    @property
    def silent_from(self) -> float:
        """When the tone has faded out [s]; infinity for one that stays."""
        return self.settled if self.gain_to == 0 else math.inf

    def gain(self, time: float) -> float:
        """Gain at a time [s] not before start."""
        if time >= self.settled:
            return self.gain_to
        share = (1 - math.cos(math.pi * (time - self.start) / self.ramp)) / 2
        return self.gain_from + (self.gain_to - self.gain_from) * share

    def amplitude(self, time: float) -> complex:
        """Complex amplitude in full strokes at a time [s] not before start."""
        return cmath.rect(self.level * self.gain(time), self.phase)

    def fade_out(self, time: float, *, ramp: float) -> "FadingTone":
        """This tone, silent within ramp [s]; a fade-out that ends sooner is left as it is.

        A fade that is cut short goes on from the gain it has reached: its value is continuous.
        """
        if self.silent_from <= time + ramp:
            return self
        return replace(self, start=time, ramp=ramp, gain_from=self.gain(time), gain_to=0.0)


Tone: TypeAlias = Union[FadingTone, "ShapedTone"]

Output: TypeAlias = tuple[Tone, ...]
"""What one channel plays: the sum of these tones."""


def fade_to(
    playing: Output,
    time: float,
    *,
    ramp: float,
    frequency: float = 0.0,
    level: float = 0.0,
    phase: float = 0.0,
    keep_phase: bool = False,
) -> Output:
    """What a channel plays once it was told at time [s] to go to this tone within ramp [s].

    Units as in `FadingTone`; level 0 is silence. The phase counts from now, unless keep_phase is
    set and the channel is about to play this frequency already: then it counts from where that
    one's does.
    """
    faded = (tone.fade_out(time, ramp=ramp) for tone in playing)
    fading = tuple(tone for tone in faded if tone.silent_from > time)
    if level == 0:
        return fading
    origin = time
    if keep_phase:
        same = [tone for tone in playing if tone.lasts and tone.frequency == frequency]
        origin = same[0].origin if same else time
    gain_from = 1.0 if ramp == 0 else 0.0
    return (*fading, FadingTone(frequency, level, phase, origin, time, ramp, gain_from, 1.0))


def level_of(playing: Output, time: float) -> float:
    """Level 0..1 that a channel has at a time [s], its fades included.

    Tones of one frequency add as complex amplitudes, magnitudes add across frequencies.
    """
    amplitudes: dict[float, complex] = defaultdict(complex)
    for tone in playing:
        turn = cmath.exp(-2j * math.pi * tone.frequency * tone.origin)
        amplitudes[tone.frequency] += tone.amplitude(time) * turn
    return sum(abs(amplitude) for amplitude in amplitudes.values())
