"""Motion of bases by the voices of their channels, against the definition of a voice."""

import cmath
import math
import random

import numpy as np
import pytest

from driven_bases import motion_of as sampled
from drivers.playback import Playback, Voice
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.voices import Transition
from sim.plant.voiced_base import delayed, motion_of

STROKE = 1e-4


def defined(voices: tuple[Voice, ...], time: float) -> float:
    """Displacement [m] at a time [s]: the sum of sinusoids of the protocol."""
    return STROKE * sum(
        (
            voice.transition.at(time)
            * cmath.exp(2j * math.pi * voice.frequency * (time - voice.origin))
        ).imag
        for voice in voices
    )


@pytest.mark.parametrize("late", [0.0, 0.003])
@pytest.mark.parametrize("seed", range(3))
def test_base_moves_by_its_voices(seed: int, late: float) -> None:
    """Fades, kept phases, envelopes and jumps of random sets, delayed or not: within 1e-16 m."""
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
        motion = motion_of(delayed(playback.voices_of(0), late), stroke=STROKE)
        for _ in range(5):
            now += random_.uniform(0.0005, 0.004)
            moved = sampled(motion, np.array([now + late]))[0]
            assert moved == pytest.approx(defined(playback.voices_of(0), now), abs=1e-16)


@pytest.mark.parametrize("start", [0.0, 1000.1, 23193.384082])
def test_pieces_of_an_envelope_join(start: float) -> None:
    """One piece plays at any moment: there is no gap by rounding that a sample could fall into."""
    knots = tuple(0.01j * n for n in range(1, 19))
    way = Transition(start, 0.005, 0j, 0.19j, start + 0.095, knots)
    terms = motion_of([Voice(0, 80.0, start, way)], stroke=1e-4)
    assert [one.end for one in terms[:-1]] == [one.start for one in terms[1:]]
    assert (terms[0].start, terms[-1].end) == (start, math.inf)
