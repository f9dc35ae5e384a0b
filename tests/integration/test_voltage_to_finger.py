"""A pattern through an amplifier of voltage: its voltage, squared, moves the bases, and a finger
feels what the table promised.

The motion is found from samples of the amplifier's voltage and the differential equation of a
resonator; neither the conversion nor the simulated law takes part in it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.envelopes import RAMPS_ONLY
from controller.loop.intent import HapticIntent, Target
from controller.loop.routing import route
from controller.loop.selection import Selector
from controller.sources.contacts import Contact, ContactKey
from drivers import clock
from drivers.guard import Guard
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.keep_alive import keep_alive
from model.arrays import ComplexArray, FloatArray
from model.finger.contrast import contrast_db, mean_level_db_sl
from model.finger.perception import sensation_level
from model.table.build import build_table
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.second_harmonic import with_second_harmonic
from model.table.table import LocalizationTable
from model.vibration.peak import peak_acceleration
from paper_table import smooth_rig
from sim.bench.bench import Bench
from sim.plant.felt import Felt
from sim.waveform import Output
from virtual_loop import run_virtual
from voltage_rigs import BAND, LAWS, RESONANCES, moved, resonator, voltage_amplifier, voltage_rig

TARGET, QUIET = (0.10, 0.06), (0.22, 0.16)
FINGERS = {"target": TARGET, "quiet": QUIET}
SETTLING, MEASURED = 1.0, 0.25  # s
RATE = 20_000.0  # Hz


def sampled(output: Output, times: FloatArray) -> FloatArray:
    """A channel's voltage about its bias at times [s], by the definition of its tones."""
    voltage = np.zeros(len(times))
    for tone in output:
        amplitude = np.array([tone.amplitude(t) if t >= tone.start else 0j for t in times])
        phase = 2 * np.pi * tone.frequency * (times - tone.origin)
        voltage += (amplitude * np.exp(1j * phase)).imag
    return voltage


def fitted(times: FloatArray, samples: FloatArray, frequencies: Sequence[float]) -> ComplexArray:
    """Complex amplitudes of sines and cosines in samples, about a constant."""
    angles = 2 * np.pi * np.outer(times, frequencies)
    basis = np.hstack([np.sin(angles), np.cos(angles), np.ones((len(times), 1))])
    found = np.linalg.lstsq(basis, samples, rcond=None)[0]
    count = len(frequencies)
    return np.asarray(found[:count] + 1j * found[count : 2 * count])


@cache
def an_answer() -> tuple[LocalizationTable, Question, Pattern]:
    """A phased pattern for one quiet finger, at a multiple of 10 Hz."""
    question = Question(
        (TARGET,), (QUIET,), level_db_sl=45.0, drive_mode="phased", frequencies=BAND
    )
    table = build_table(smooth_rig(), frequencies=np.arange(BAND[0], BAND[1] + 1, 10.0))
    return table, question, table.query(question)


def played(
    bench: Bench, pattern: Pattern, fingers: Mapping[str, tuple[float, float]] = FINGERS
) -> tuple[float, Sequence[Output], dict[str, Felt]]:
    """Play a pattern through guard, conversion and amplifier.

    Returns when it was committed, the voltages, and what fingers feel once it has settled.
    """

    async def play() -> tuple[float, Sequence[Output], dict[str, Felt]]:
        amplifier = voltage_amplifier(bench)
        await amplifier.open()
        bench.place_fingers(fingers, now=clock.now())
        checked = CheckedAmplifier(amplifier)
        await checked.arm()
        guard = Guard(bench.rig.limits, amplifier.capabilities)
        sets = route(pattern.excitation, bench.rig, token=amplifier.next_token(), ramp=0.02)
        await checked.apply(guard.check(sets["main"]))
        committed = clock.now()
        outputs = bench.amplifiers["main"].outputs
        await keep_alive(checked, SETTLING + MEASURED, interval=0.05)
        bench.advance(clock.now())
        felt = bench.felt(clock.now() - MEASURED, clock.now())
        await amplifier.disarm()
        return committed, outputs, felt

    return run_virtual(play())


@pytest.mark.parametrize("law", LAWS)
def test_voltage_moves_bases_and_fingers_as_promised(law: str) -> None:
    """Bases within 0.2 % of a full stroke, levels within 0.1 dB of the table's promise.

    The harmonic of a bias is compared with its formula, and taken away before fingers are.
    """
    rig = voltage_rig(smooth_rig(), law)
    _, _, pattern = an_answer()
    assert max(tone.amplitude for tone in pattern.excitation.values()) > 0.3e-4
    bench = Bench(rig, now=1000.0)
    committed, outputs, felt = played(bench, pattern)
    _, bias, gain = LAWS[law]
    times = committed + np.arange(0, SETTLING + MEASURED, 1 / RATE)
    late = times > committed + SETTLING
    assert len(pattern.excitation) >= 2
    for name, tone in pattern.excitation.items():
        output = outputs[rig.wiring[name].number]
        voltage = bias + sampled(output, times)
        force = voltage if law == "linear" else voltage**2 - bias**2
        base = moved(force, times, RESONANCES[name], gain)
        start = output[0].origin
        reached = fitted(times[late] - start, base[late], [tone.frequency, 2 * tone.frequency])
        wanted = tone.amplitude / rig.era(name).stroke * np.exp(1j * tone.phase)
        assert abs(reached[0] - wanted) < 0.002
        assert np.abs(voltage).max() <= 1.0
        if bias:  # of the force, U / (4 bias); then through the actuator
            strength = np.abs(sampled(output, times[late])).max() / (4 * bias)
            harmonic, fundamental = np.abs(
                resonator(np.array([2, 1]) * tone.frequency, RESONANCES[name], gain)
            )
            ratio = abs(reached[1] / reached[0])
            assert ratio == pytest.approx(strength * harmonic / fundamental, rel=0.01)
    driven = sorted({tone.frequency for tone in pattern.excitation.values()})
    found = {name: _only(one, driven) for name, one in felt.items()}
    level = mean_level_db_sl(*found["target"], felt["target"].weights, rig.threshold)
    quiet = sensation_level(*found["quiet"], rig.threshold).max()
    assert level == pytest.approx(pattern.level_db_sl, abs=0.1)
    assert level - quiet == pytest.approx(pattern.felt_contrast_db, abs=0.5)  # steps of the wire


def test_harmonic_is_in_the_promise() -> None:
    """With a bias, levels and contrast with harmonics are what fingers feel, within 0.3 dB.

    With actuators that respond at the harmonic as at the tone it costs 7 of 30 dB.
    """
    rig = voltage_rig(smooth_rig(), "quadratic with bias")
    flat = ((20.0, 2.0, 0.0), (1000.0, 2.0, 0.0))
    drives = {name: replace(drive, response=flat) for name, drive in rig.voltage.items()}
    rig = replace(rig, voltage=drives)
    table, question, pattern = an_answer()
    promised = with_second_harmonic(pattern, question, table, rig.voltage)
    _, _, felt = played(Bench(rig, now=1000.0), pattern)
    found = {name: (np.array(one.frequencies), one.amplitude) for name, one in felt.items()}
    assert set(found["quiet"][0]) == {
        factor * tone.frequency for tone in pattern.excitation.values() for factor in (1, 2)
    }
    level = mean_level_db_sl(*found["target"], felt["target"].weights, rig.threshold)
    quiet = sensation_level(*found["quiet"], rig.threshold).max()
    assert promised.level_db_sl == pytest.approx(level, abs=0.1)
    assert promised.quiet_level_db_sl == pytest.approx(quiet, abs=0.3)
    assert promised.felt_contrast_db == pytest.approx(level - quiet, abs=0.3)
    lost = pattern.felt_contrast_db - promised.felt_contrast_db
    assert 6 < lost < 8


def test_harmonic_is_in_the_prediction_of_each_target() -> None:
    """Levels and contrasts of two targets are what their fingers feel, within 0.1 and 0.3 dB.

    Levels are those that nine of ten plates reach, lower than here. Without the harmonic the
    contrast of the first would be 14 dB too high.
    """
    rig = voltage_rig(smooth_rig(), "quadratic with bias")
    flat = ((20.0, 2.0, 0.0), (1000.0, 2.0, 0.0))
    drives = {name: replace(drive, response=flat) for name, drive in rig.voltage.items()}
    rig = replace(rig, voltage=drives)
    table, _, _ = an_answer()
    places = {"1": TARGET, "2": (0.15, 0.05), "3": QUIET}
    keys = {name: ContactKey("test", int(name)) for name in places}
    contacts = [Contact(keys[name], *at, since=0.0) for name, at in places.items()]
    intent = HapticIntent((Target(keys["1"], 40.0), Target(keys["2"], 38.0)))
    able = PlaybackCapabilities(
        "phased", ("phased",), BAND, {era.name: era.stroke for era in rig.eras}, RAMPS_ONLY
    )
    selection = Selector(table, voltage=rig.voltage).select(contacts, intent, able)
    assert selection.pattern is not None
    assert selection.pattern.robust_level_db_sl is not None
    reserve = selection.pattern.level_db_sl - selection.pattern.robust_level_db_sl
    _, _, felt = played(Bench(rig, now=1000.0), selection.pattern, places)
    quiet = peak_acceleration(felt["3"].amplitude)
    for name, prediction in zip("12", selection.predictions, strict=True):
        one = felt[name]
        level = mean_level_db_sl(
            np.array(one.frequencies), one.amplitude, one.weights, rig.threshold
        )
        assert prediction.level_db_sl + reserve == pytest.approx(level, abs=0.1)
        contrast = contrast_db([peak_acceleration(one.amplitude)], quiet, [one.weights])
        assert prediction.contrast_db == pytest.approx(float(contrast), abs=0.3)


def _only(felt: Felt, frequencies: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Frequencies and amplitudes without harmonics."""
    rows = [felt.frequencies.index(frequency) for frequency in frequencies]
    return np.array(frequencies), felt.amplitude[rows]
