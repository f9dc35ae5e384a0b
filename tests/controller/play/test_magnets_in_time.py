"""How far magnets of the plate for a weekend move in onsets and endings, by another solution.

Voltages as they are played, sample by sample, move the matrices of plate and magnets, whose motion
is integrated numerically; a magnet's is its coordinate less the plate's at its coil.
"""

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete

from controller.play.capabilities import RAMPS_ONLY, PlaybackCapabilities
from model.answer.answer import Answer, Limits
from model.answer.fingers import Finger, Stimulus
from model.answer.plan import answer
from model.answer.timing import Timing
from model.arrays import ComplexArray, FloatArray, Point
from model.reduction.reduced_plate import ReducedPlate, modal_matrices
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.table.build import build_table
from model.table.table import LocalizationTable
from model.transients.base_motion import Envelopes

ALLOWED = 0.5e-3
STEP = 1e-4
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
def stepped() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Matrices of a step of the state by it and by forces, and by which magnets follow of it."""
    on = table()
    reduced = ReducedPlate(on.plate, on.omega, on.losses, at=on.shapes_at)
    shapes, eras = on.attachment_shapes, len(on.eras)
    M, C, K = modal_matrices(reduced, on.eras, loads=on.masses, attachment_shapes=shapes)
    r, inverse = len(K), np.linalg.inv(M)
    apart = np.hstack([shapes[:eras], -np.eye(eras)])
    A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K, -inverse @ C]])
    B = np.vstack([np.zeros((r, eras)), inverse @ apart.T])
    out = np.hstack([apart, np.zeros((eras, r))])
    a, b, *_ = cont2discrete((A, B, out, np.zeros((eras, eras))), STEP, "zoh")
    return a, b, out


def voltages(envelopes: Iterable[Envelopes], *, phase: complex) -> FloatArray:
    """What each exciter gets (n, eras) of envelopes that begin together, and 50 ms of the last."""
    times = STEP * np.arange(1600)
    found = np.zeros((len(times), len(table().eras)))
    for number, era in enumerate(table().eras):
        for each in envelopes:
            if era.name in each:
                one = each[era.name]
                turning = phase * np.exp(2j * np.pi * one.frequency * times)
                found[:, number] += (one.amplitude(times) * turning).imag
    return found


def furthest(volts: FloatArray) -> float:
    """The largest motion [m] of a magnet from rest, by Bl (u - L u' / R) / R."""
    a, b, out = stepped()
    parts = [era.in_time for era in table().eras]
    by_drive, by_rate = (np.array([getattr(p, k) for p in parts]) for k in ("by_drive", "by_rate"))
    forces = volts * by_drive + np.gradient(volts, STEP, axis=0) * by_rate
    state, largest = np.zeros(len(a)), 0.0
    for force in forces:
        state = a @ state + b @ force
        largest = max(largest, float(np.abs(out @ state).max()))
    return largest


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
        for phase in (1.0, 1j):
            largest.append(furthest(voltages([layer.onset], phase=phase)))
            full = np.array([layer.excitation[era.name].phasor for era in table().eras])
            largest.append(furthest(jump(full * phase, frequency)))
    assert 0.6 * ALLOWED < max(largest) < 1.01 * ALLOWED


def jump(amplitudes: ComplexArray, frequency: float) -> FloatArray:
    """Voltages (n, eras) of a tone that begins within a millisecond."""
    times = STEP * np.arange(1600)
    turning = np.exp(2j * np.pi * frequency * times) * np.minimum(times / 1e-3, 1)
    return np.asarray((turning[:, None] * amplitudes).imag)


def test_contents_together_keep_magnets_within_their_excursion() -> None:
    """Of a tone at 70 Hz that takes half of it, and one at 90 Hz that wants all beside it."""
    largest, every = [], PlaybackCapabilities("phased", ("phased",), Limits(), RAMPS_ONLY)
    for first, second in PLACES:
        one = alone(first, 70.0, Limits(excursion=0.5))
        other = alone(second, 90.0, every.left_by(one.layers, table()).limits)
        onsets = [layer.onset for layer in (*one.layers, *other.layers) if layer.onset]
        assert len(onsets) == 2
        largest += [furthest(voltages(onsets, phase=phase)) for phase in (1.0, 1j)]
    assert 0.3 * ALLOWED < max(largest) < 1.01 * ALLOWED


def alone(at: Point, frequency: float, limits: Limits) -> Answer:
    """All that one finger can have within limits."""
    finger = Finger(at, Stimulus(60.0, band_hz=(frequency, frequency)))
    found = answer(table(), [finger], drive_mode="phased", shaped=True, limits=limits)
    return Timing(table()).shaped(found)
