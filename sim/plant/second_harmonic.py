"""Second harmonics of ERAs: the tones that these play beside those that they are to play.

A share of each tone's own amplitude, at twice its frequency and twice its phase, and an angle of
each ERA. Of signals there are none, and of several tones together no sums and differences.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from drivers.playing.playback import Voice
from model.answer.answer import Layer
from model.transients.base_motion import BaseEnvelope
from model.vibration import Tone


def of_voices(voices: Sequence[Voice], share: complex) -> list[Voice]:
    """Second harmonics of the voices of a channel; none of share 0."""
    if not share:
        return []
    found = []
    for voice in voices:
        way = voice.transition
        first, last, *knots = (_doubled(each, share) for each in (way.first, way.last, *way.knots))
        doubled = replace(way, first=first, last=last, knots=tuple(knots))
        found.append(replace(voice, frequency=2 * voice.frequency, transition=doubled))
    return found


def of_layer(layer: Layer, shares: Mapping[str, complex]) -> list[Layer]:
    """Second harmonics of a layer's voices as it starts; shares: by ERA, none where all are 0."""
    if not any(shares.values()):
        return []
    return [
        replace(
            voice,
            excitation={
                name: Tone.from_phasor(2 * tone.frequency, _doubled(tone.phasor, shares[name]))
                for name, tone in voice.excitation.items()
            },
            onset=voice.onset
            and {name: _of_envelope(each, shares[name]) for name, each in voice.onset.items()},
        )
        for voice in layer.voices
    ]


def _of_envelope(envelope: BaseEnvelope, share: complex) -> BaseEnvelope:
    start, *knots = (_doubled(value, share) for value in (envelope.start, *envelope.knots))
    return BaseEnvelope(2 * envelope.frequency, start, tuple(knots), envelope.step)


def _doubled(amplitude: complex, share: complex) -> complex:
    """Amplitude of the second harmonic of one."""
    return share * amplitude * amplitude / abs(amplitude) if amplitude else 0j
