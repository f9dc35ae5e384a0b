"""What a channel of a simulated amplifier plays: sinusoids that fade, or follow an envelope.

Every change is a fade: what was played fades out while what shall be played fades in, both along
the same raised cosine, so that their gains add up to one at any moment.
"""

import cmath
import math
from collections import defaultdict
from typing import TypeAlias

from sim.waveform.fading_tone import FadingTone
from sim.waveform.shaped_tone import ShapedTone

Tone: TypeAlias = FadingTone | ShapedTone

Output: TypeAlias = tuple[Tone, ...]
"""What one channel plays: the sum of these tones."""


def fade_to(
    playing: Output,
    time: float,
    *,
    ramp: float,
    frequency: float = 0.0,
    amplitude: complex = 0j,
    keep_phase: bool = False,
) -> Output:
    """What a channel plays once it was told at time [s] to go to this tone within ramp [s].

    amplitude in full strokes, 0 is silence. Its phase counts from now, unless keep_phase is
    set and the channel is about to play this frequency already: then it counts from where that
    one's does.
    """
    faded = (tone.fade_out(time, ramp=ramp) for tone in playing)
    fading = tuple(tone for tone in faded if tone.silent_from > time)
    if amplitude == 0:
        return fading
    origin = time
    if keep_phase:
        same = [tone for tone in playing if tone.lasts and tone.frequency == frequency]
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


def level_of(playing: Output, time: float) -> float:
    """Level 0..1 that a channel has at a time [s], its fades included.

    Tones of one frequency add as complex amplitudes, magnitudes add across frequencies.
    """
    if len(playing) < 2:  # which is most of the time
        return sum(abs(tone.amplitude(time)) for tone in playing)
    amplitudes: dict[float, complex] = defaultdict(complex)
    for tone in playing:
        turn = cmath.exp(-2j * math.pi * tone.frequency * tone.origin)
        amplitudes[tone.frequency] += tone.amplitude(time) * turn
    return sum(abs(amplitude) for amplitude in amplitudes.values())
