"""Output of a channel: a sum of sinusoids that fade, or follow an envelope.

Every change is a cross-fade along a raised cosine, whose two gains add up to one.
"""

import cmath
import math
from collections import defaultdict
from typing import TypeAlias

from sim.waveform.fading_tone import FadingTone
from sim.waveform.shaped_tone import ShapedTone

Tone: TypeAlias = FadingTone | ShapedTone

Output: TypeAlias = tuple[Tone, ...]
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
    """The output after a command at a time [s] to follow an envelope to a tone.

    amplitude and knots in full strokes, ramp and step in s. With keep_phase a lasting tone of the
    same frequency continues from its present amplitude; else the new one begins at zero. All others
    fade out within ramp.
    """
    continuing = next(
        (tone for tone in playing if keep_phase and tone.lasts and tone.frequency == frequency),
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
    """The output after a command at a time [s] to end along an envelope; see `shape_to`."""
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
