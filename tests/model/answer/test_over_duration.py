"""Levels over limited durations, against the plate in time sample by sample, and their limits."""

import math

import numpy as np
import pytest

from benchmarks.promise.clicks import clicks_on, given
from model.answer.answer import (
    DriveEnvelope,
    Limits,
    OverDuration,
    RingingUnderFingers,
    on_drawn_plates,
    pulse_ramp,
    shaped_gain,
)
from model.answer.plan import answer, query
from model.answer.promise import FingersOnPlate
from model.answer.stimulus import Finger, Placement, Stimulus
from model.ensemble.draws import JUDGING_DRAWS
from model.finger import detection_threshold, fingertip_points, fingertip_weights
from model.table.table_file import build_table
from model.transients.base_motion import ramped_onset, ramped_pulse
from model.transients.shaping import SAMPLE_RATE, Transients
from model.vibration import Excitation, Tone, base_amplitudes
from plates import contact_sets, small_table, smooth_rig, smooth_table

TARGET, QUIET = (0.09, 0.07), (0.24, 0.17)
ALONE = Placement((TARGET,))
STROKE = 100e-6  # m


def excitation(frequency: float, *, level: float = 0.2) -> Excitation:
    """Two ERAs, out of phase."""
    return {
        "SW": Tone(frequency, level * STROKE, 0.3),
        "NE": Tone(frequency, 0.5 * level * STROKE, -1.1),
    }


def over(drive: Excitation, duration: float, loads: tuple[float, ...] = ()) -> OverDuration:
    """What a finger at TARGET and one at QUIET feel of a drive over a duration [s]."""
    table, envelope = small_table(), DriveEnvelope.of_pulse(duration, pulse_ramp(duration))
    ringing = RingingUnderFingers(table, (TARGET, QUIET), loads, envelope)
    frequencies, bases = base_amplitudes(drive, table.eras)
    return ringing.over(zip(frequencies.tolist(), bases, strict=True))


@pytest.mark.parametrize("loads", [(), (2.5, 0.4)])
@pytest.mark.parametrize("frequency", [60.0, 110.0, 250.0])
@pytest.mark.parametrize("duration", [0.02, 0.04, 0.15])
def test_gain_is_that_of_the_plate_in_time(
    frequency: float, duration: float, loads: tuple[float, ...]
) -> None:
    """Root mean square of samples over the duration, relative to a second later, within 0.5 dB.

    Under a finger; and over as long at the loudest point of another one, both on the plate, at its
    strongest until all has rung out. A carrier of 60 Hz has little more than a
    period in 20 ms, where its own phase counts: 1.5 dB.
    """
    table = small_table()
    drive, ramp = excitation(frequency), pulse_ramp(duration)
    found = over(drive, duration, loads)
    points = [fingertip_points(*at, table.plate) for at in (TARGET, QUIET)]
    plate = Transients(table.in_time_under((TARGET, QUIET), loads))
    acceleration = plate.acceleration(
        ramped_onset(drive, table.eras, ramp=ramp), points[0], duration=2.0
    )
    pulse = ramped_pulse(drive, table.eras, ramp=ramp, duration=duration)
    beside = plate.acceleration(pulse, points[1], duration=duration + 0.2)
    weights = fingertip_weights(*TARGET, table.plate)
    count = round(duration * SAMPLE_RATE)
    first = np.sqrt((acceleration[:count] ** 2).mean(axis=0))
    steady = np.sqrt((acceleration[-round(0.5 * SAMPLE_RATE) :] ** 2).mean(axis=0))
    lag = 20 * math.log10(first @ weights / (steady @ weights))
    sums = np.vstack([np.zeros(len(points[1])), np.cumsum(beside**2, axis=0)])
    strongest = np.sqrt((sums[count:] - sums[:-count]).max() / count)
    quiet = math.sqrt(2) * strongest / detection_threshold(np.array(frequency))
    tolerance = 1.5 if frequency * duration < 2 else 0.5
    assert 20 * math.log10(found.gains[0]) == pytest.approx(lag, abs=tolerance)
    heard = 10 * math.log10(found.heard[1].max())
    assert heard == pytest.approx(20 * math.log10(quiet), abs=tolerance + 0.3)


def test_shaped_gain_is_that_of_a_raised_cosine() -> None:
    """By quadrature: the mean square of ((1 - cos) / 2)^2 over 40 ms, then 1 up to the end."""
    times = (np.arange(100_000) + 0.5) / 100_000 * 0.2
    rise = (1 - np.cos(np.pi * np.minimum(times / 0.04, 1))) / 2
    assert shaped_gain(0.2) == pytest.approx(math.sqrt((rise**2).mean()), rel=1e-5)


def test_drive_is_raised_by_the_lag() -> None:
    """Felt as requested over the duration, along the ramp of it."""
    table = small_table()
    found = query(table, ALONE, 20.0, duration=0.04, drive_mode="phased")
    (layer,), (felt,) = found.layers, found.fingers
    frequencies, bases = base_amplitudes(layer.excitation, table.eras)
    envelope = DriveEnvelope.of_pulse(0.04, layer.ramp)
    ringing = RingingUnderFingers(table, (TARGET,), (), envelope)
    lag = ringing.over(zip(frequencies.tolist(), bases, strict=True)).gains[0]
    points = fingertip_points(*TARGET, table.plate)
    _, amplitudes = table.amplitudes(layer.excitation, points, contacts=(TARGET,))
    steady = amplitudes[0] @ fingertip_weights(*TARGET, table.plate)
    above = steady / detection_threshold(frequencies)[0]
    assert felt.level_db_sl == pytest.approx(20.0, abs=1e-3)
    assert 20 * math.log10(lag * above) == pytest.approx(20.0, abs=0.02)
    assert layer.ramp == pulse_ramp(0.04) == 0.01


@pytest.mark.parametrize("duration", [None, 0.04])
@pytest.mark.parametrize(
    "limits",
    [
        Limits(),
        Limits(amplitudes={"SW": 0.6 * STROKE, "SE": STROKE, "NE": STROKE, "NW": STROKE}),
        Limits(power=0.3125),
    ],
)
def test_drive_stays_within_its_limits(limits: Limits, duration: float | None) -> None:
    """Of 60 dB SL, too much for all, it gives what they allow, and says how much is felt."""
    table = small_table()
    finger = Finger(TARGET, Stimulus(60.0, duration=duration))
    found = answer(table, [finger], drive_mode="phased", limits=limits)
    strokes = table.full_levels
    assert limits.factor_within(found.layers, table) == pytest.approx(1.0, abs=1e-6)
    used = [
        amplitude / (limits.amplitudes or strokes)[name]
        for name, amplitude in found.amplitudes.items()
    ]
    power = sum((each / STROKE) ** 2 for each in found.amplitudes.values()) / limits.power
    assert max([*used, power]) == pytest.approx(1.0, rel=1e-3)
    (felt,), softer = found.fingers, query(table, ALONE, 20.0, drive_mode="phased")
    assert softer.fingers[0].level_db_sl < felt.level_db_sl < 60.0
    assert felt.lowered_db > 1.0


def test_ramp_is_as_long_as_the_rise_of_levels_allows() -> None:
    """Of an ERA at most 3 per second, which takes longer than the ramp of 10 ms."""
    table, finger = small_table(), Finger(TARGET, Stimulus(40.0, duration=0.04))
    free, slow = (
        answer(table, [finger], drive_mode="phased", limits=Limits(slew=slew))
        for slew in (math.inf, 3.0)
    )
    rise = max(free.amplitudes[name] / table.full_levels[name] for name in free.amplitudes) / 3.0
    assert slow.layers[0].ramp == pytest.approx(rise)
    assert slow.layers[0].ramp > 0.02
    assert slow.fingers[0].level_db_sl == pytest.approx(40.0, abs=0.1)
    assert max(slow.amplitudes.values()) > max(free.amplitudes.values())


def test_quiet_fingers_limit_a_raise() -> None:
    """They are 6 dB below it on nine of ten plates, or the drive is that of what lasts."""
    table, lowered = smooth_table(), 0
    for target, *quiet in contact_sets(6, fingers=9, seed=8):
        placed = Placement((target,), tuple(quiet))
        found = query(table, placed, 20.0, duration=0.02, drive_mode="phased")
        felt = found.fingers[0]
        assert felt.level_db_sl <= 20.0 + 1e-3
        if felt.lowered_db:
            lowered += 1
            assert felt.promised_contrast_db is not None
            quiet_level = felt.level_db_sl - felt.promised_contrast_db
            assert quiet_level == pytest.approx(14.0, abs=0.01) or quiet_level > 14.0
            assert "quiet fingers" in found.applied[-1]
    assert lowered


def test_spectrum_has_the_energy_of_the_plate_in_time() -> None:
    """By samples until all has rung out, at two fingers, within half a decibel at 252 Hz.

    The steady vibration has 2 dB less at one and 2 dB more at the other.
    """
    table, duration, ramp, row = smooth_table(), 0.02, pulse_ramp(0.02), 12
    frequency, weights = float(table.frequencies[row]), np.array([0.2 + 0.06j, 0, 0.04 - 0.09j, 0])
    ringing = RingingUnderFingers(
        table, (TARGET, QUIET), (), DriveEnvelope.of_pulse(duration, ramp)
    )
    rows, tones = zip(*ringing.spectrum([(row, weights)]), strict=True)
    fingers = FingersOnPlate.of(table, (TARGET, QUIET), ())
    powers = fingers.powers(JUDGING_DRAWS, np.array(rows), np.array(tones))
    energies = powers.sum(axis=0)[:, :, 0].mean(axis=1)
    drive = {
        era.name: Tone.from_phasor(frequency, each * era.stroke)
        for era, each in zip(table.eras, weights.tolist(), strict=True)
    }
    points = [fingertip_points(*at, table.plate) for at in (TARGET, QUIET)]
    pulse = ramped_pulse(drive, table.eras, ramp=ramp, duration=duration)
    plate = Transients(table.in_time_under((TARGET, QUIET)))
    felt = plate.acceleration(pulse, np.concatenate(points), duration=0.4)
    squares = (felt**2).sum(axis=0).reshape(2, -1).mean(axis=1) / SAMPLE_RATE
    threshold = detection_threshold(np.array(frequency), table.threshold)
    expected = 2 * squares / duration / threshold**2
    assert 10 * np.log10(energies) == pytest.approx(10 * np.log10(expected), abs=0.5)


def test_spectrum_counts_as_much_where_a_table_has_more_frequencies() -> None:
    """It is even: half of what is beside 210 Hz is above it, in steps of 2 Hz from 230 Hz on."""
    frequencies = np.array([*range(60, 230, 10), *range(230, 342, 2)], dtype=float)
    table, row = build_table(smooth_rig(), frequencies=frequencies), 15
    envelope = DriveEnvelope.of_pulse(0.02, pulse_ramp(0.02))
    energies = RingingUnderFingers(table, (TARGET,), (), envelope).shares[row]
    beside = energies[row + 1 :].sum() / (energies.sum() - energies[row])
    assert beside == pytest.approx(0.5, abs=0.02)


def test_other_plates_are_felt_by_their_energy() -> None:
    """By hand: 4 heard, and a quarter of the 9 more and the 3 less that others have; 0 at least."""
    found = on_drawn_plates(
        np.array([[4.0, 13.0, 1.0], [9.0, 9.0, 1.0]]), np.array([4.0, 1.0]), 0.25
    )
    assert found == pytest.approx(np.array([[4.0, 6.25, 3.25], [1.0, 1.0, 0.0]]))


def test_promise_over_a_click_is_kept() -> None:
    """On 240 plates in time, of other thickness, springs, losses and drives: by nine of ten."""
    rig = smooth_rig()
    clicks = clicks_on(smooth_table(), 12, seed=3)
    promised = np.array([each.fingers[0].promised_contrast_db for each in clicks])
    found = given(smooth_table(), rig, clicks, 20, seed=4)
    assert 0.86 <= np.mean(found >= promised[:, None]) <= 0.94
