"""How far magnets of the plate for a weekend move in onsets and endings, by another solution.

Voltages of envelopes, sample by sample, move the plate of `magnets`; what programs of content do is
in test_magnets_by_programs.py.
"""

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from controller.play.routing import RAMPS_ONLY, PlaybackCapabilities
from exciters import STEP, Magnets
from model.answer.answer import Answer, Limits
from model.answer.answer_report import Timing
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import ComplexArray, Point
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.transients.base_motion import Envelopes

ALLOWED = 0.5e-3
PLACES = (((0.1, 0.1), (0.3, 0.2)), ((0.3, 0.22), (0.15, 0.1)))


@cache
def rig() -> Rig:
    """The example's, from 45 Hz on."""
    path = Path(__file__).parents[3] / "examples/weekend/rig.yaml"
    return load_rig(path).replaced(limits={"frequency": [45, 300]})


@cache
def table() -> LocalizationTable:
    """Of frequencies near the magnets' resonances, and one above."""
    return build_table(rig(), frequencies=np.array([60.0, 70.0, 90.0, 120.0]), drive_mode="phased")


@cache
def magnets() -> Magnets:
    """Its plate and magnets."""
    return Magnets(rig())


def voltages(envelopes: Iterable[Envelopes]) -> ComplexArray:
    """What each exciter gets (n, eras) of envelopes that begin together, and 50 ms of the last."""
    times = STEP * np.arange(1600)
    found = np.zeros((len(times), len(table().eras)), dtype=complex)
    for number, era in enumerate(table().eras):
        for each in envelopes:
            if era.name in each:
                one = each[era.name]
                turning = np.exp(2j * np.pi * one.frequency * times)
                found[:, number] += one.amplitude(times) * turning
    return found


def furthest(volts: ComplexArray) -> float:
    """The largest motion [m] of a magnet from rest, in whichever phase."""
    return float(np.abs(magnets().moved(volts)).max())


def shaped(frequency: float) -> Iterable[Answer]:
    """Answers for one of two fingers with as much as exciters give, with envelopes."""
    for target, quiet in PLACES:
        fingers = [Finger(target, Stimulus(60.0, band_hz=(frequency, frequency))), Finger(quiet)]
        yield Timing(table()).shaped(answer(table(), fingers, drive_mode="phased", shaped=True))


@pytest.mark.parametrize("frequency", [60.0, 70.0, 90.0])
def test_onsets_keep_magnets_within_their_excursion(frequency: float) -> None:
    """At the most that is asked, along shaped onsets and along a jump, in either phase."""
    largest = []
    for found in shaped(frequency):
        (layer,) = found.layers
        assert layer.onset is not None
        largest.append(furthest(voltages([layer.onset])))
        full = np.array([layer.excitation[era.name].phasor for era in table().eras])
        largest.append(furthest(jump(full, frequency)))
    assert 0.6 * ALLOWED < max(largest) < 1.01 * ALLOWED


def jump(amplitudes: ComplexArray, frequency: float) -> ComplexArray:
    """Voltages (n, eras) of a tone that begins within a millisecond."""
    times = STEP * np.arange(1600)
    turning = np.exp(2j * np.pi * frequency * times) * np.minimum(times / 1e-3, 1)
    return np.asarray(turning[:, None] * amplitudes)


def test_contents_together_keep_magnets_within_their_excursion() -> None:
    """Of a tone at 70 Hz that takes half of it, and one at 90 Hz that wants all beside it."""
    largest, every = [], PlaybackCapabilities("phased", ("phased",), Limits(), RAMPS_ONLY)
    for first, second in PLACES:
        one = alone(first, 70.0, Limits(excursion=0.5))
        other = alone(second, 90.0, every.left_by(one.layers, table()).limits)
        onsets = [layer.onset for layer in (*one.layers, *other.layers) if layer.onset]
        assert len(onsets) == 2
        largest.append(furthest(voltages(onsets)))
    assert 0.3 * ALLOWED < max(largest) < 1.01 * ALLOWED


def alone(at: Point, frequency: float, limits: Limits) -> Answer:
    """All that one finger can have within limits."""
    finger = Finger(at, Stimulus(60.0, band_hz=(frequency, frequency)))
    found = answer(table(), [finger], drive_mode="phased", shaped=True, limits=limits)
    return Timing(table()).shaped(found)
