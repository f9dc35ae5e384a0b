"""What a channel of an amplifier plays, as the plate takes it: tones in time."""

from collections.abc import Sequence

from drivers.playback import Voice
from sim.waveform import FadingTone, Output, ShapedTone, ToneSegment


def output_of(voices: Sequence[Voice]) -> Output:
    """Return the tones of a channel's voices; a raised cosine between two amplitudes is two."""
    return tuple([tone for voice in voices for tone in _tones(voice)])


def _tones(voice: Voice) -> tuple[ToneSegment, ...]:
    way = voice.transition
    if way.knots:
        values = (way.first, *way.knots, way.last)
        return (ShapedTone(voice.frequency, voice.origin, way.start, way.step, values),)
    tones = []
    if way.first and way.step:
        fading = (way.first, voice.origin, way.start, way.step, 1.0, 0.0)
        tones.append(FadingTone(voice.frequency, *fading))
    if way.last:
        rising = (way.last, voice.origin, way.start, way.step, 0.0 if way.step else 1.0, 1.0)
        tones.append(FadingTone(voice.frequency, *rising))
    return tuple(tones)
