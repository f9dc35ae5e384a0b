"""Tones that the plate takes, against the amplitudes of the voices that they are made of."""

import cmath
import math
import random

import pytest

from drivers.playback import Playback
from drivers.protocol.sets import Command, Envelope, LayerSet
from sim.amplifier.outputs import output_of
from sim.waveform import Output


def sample(output: Output, time: float) -> float:
    """The sum of sinusoids of an output at a time, by its definition."""
    sinusoids = [
        (
            tone.amplitude(time) * cmath.exp(2j * math.pi * tone.frequency * (time - tone.origin))
        ).imag
        for tone in output
        if tone.start <= time
    ]
    return float(sum(sinusoids))


@pytest.mark.parametrize("seed", range(4))
def test_tones_are_the_voices(seed: int) -> None:
    """Fades, kept phases, envelopes and jumps of random sets: the same samples within 1e-12."""
    random_ = random.Random(seed)
    playback, now = Playback(1, 8), 0.0
    for token in range(1, 40):
        knots = tuple((random_.randrange(5000), random_.randrange(-9000, 9000)) for _ in range(3))
        onset = Envelope(20, knots) if random_.random() < 0.4 else None
        command = Command(
            *(0, random_.choice((2000, 3000)), random_.choice((0, 3000, 5000)), 4500),
            keep_phase=random_.random() < 0.5,
            onset=onset,
            ending=Envelope(10, knots[:2]),
        )
        ramp = random_.choice((0, 5, 30))
        playback.commit([LayerSet(random_.randrange(2), ramp, 0, (command,))], token, now)
        output = output_of(playback.voices_of(0))
        for _ in range(5):
            now += random_.uniform(0.0005, 0.004)
            voices = playback.voices_of(0)
            expected = sum(
                (
                    voice.transition.at(now)
                    * cmath.exp(2j * math.pi * voice.frequency * (now - voice.origin))
                ).imag
                for voice in voices
            )
            assert sample(output, now) == pytest.approx(expected, abs=1e-12)
