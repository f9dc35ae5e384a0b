"""The samples that the firmware synthesizes, against the formulas of the wire page."""

from pathlib import Path

import numpy as np
import pytest

from firmware_programs import build_firmware
from firmware_script import (
    KEEP_PHASE,
    NAK,
    PER_MS,
    RATE,
    SESSION,
    Script,
    apply,
    arm,
    command,
    load,
    replay,
    request,
    stuffed,
    unstuffed,
)
from model.arrays import FloatArray

TOLERANCE = 6e-5  # of full stroke: two steps of a 16-bit sample, and phases over seconds
DISARM, GET_STATUS = 4, 9
BAD_TOKEN, STOP, FADING = 6, 8, 12


def seconds(count: int) -> FloatArray:
    """Times [s] of so many samples."""
    return np.arange(count) / RATE


def tone(times: FloatArray, frequency: float, level: float, phase: float = 0.0) -> FloatArray:
    """Level x sin(2 pi frequency t + phase)."""
    return np.asarray(level * np.sin(2 * np.pi * frequency * times + np.radians(phase)))


def falling(times: FloatArray, ramp: float) -> FloatArray:
    """(1 + cos(pi s)) / 2, with s from 0 to 1 over the ramp [s]."""
    return np.asarray((1 + np.cos(np.pi * np.clip(times / ramp, 0, 1))) / 2)


def test_channels_start_together_with_their_phases(replaying: Path) -> None:
    """Every channel plays the formula of the page, with t from the commit, for three seconds."""
    tones = [(110.0, 0.2, 0.0), (250.05, 1.0, -90.0), (20.0, 0.5, 179.99), (1999.95, 0.7, 12.34)]
    set_ = apply(513, *(command(n, *each) for n, each in enumerate(tones)))
    samples, _ = replay(
        replaying, [(10, arm()), (50, set_), (1900, request(2)), (1500, arm())], 3000
    )
    assert not samples[: 50 * PER_MS].any()
    playing = samples[50 * PER_MS :]
    for channel, each in enumerate(tones):
        expected = tone(seconds(len(playing)), *each)
        assert np.abs(playing[:, channel] - expected).max() < TOLERANCE


def test_frame_with_any_wrong_bit_is_not_answered(replaying: Path) -> None:
    """A CRC-32 finds every single one, be it in the frame or in the checksum."""
    frame = unstuffed(arm()[1:-1])
    damaged = [
        stuffed(frame[:at] + bytes([frame[at] ^ 1 << bit]) + frame[at + 1 :])
        for at in range(len(frame))
        for bit in range(8)
    ]
    _, replies = replay(replaying, [(10, each) for each in damaged], 20)
    assert replies == []


def test_sets_cross_fade_along_raised_cosines(replaying: Path) -> None:
    """An interrupted fade goes on from its present gain; one that ends sooner keeps its end."""
    script: Script = [
        (0, arm()),
        (0, apply(1, command(0, 100, 0.5))),
        (100, apply(2, command(0, 130, 0.4, 90), ramp_ms=40)),
        (120, apply(3, ramp_ms=100)),
    ]
    samples, _ = replay(replaying, script, 230)
    t = seconds(len(samples))
    first = tone(t, 100, 0.5) * falling(t - 0.1, 0.04)
    rising = np.where(t < 0.12, 1 - falling(t - 0.1, 0.04), 0.5 * falling(t - 0.12, 0.1))
    second = np.where(t >= 0.1, tone(t - 0.1, 130, 0.4, 90) * rising, 0)
    assert np.abs(samples[:, 0] - first - second).max() < TOLERANCE
    assert not samples[220 * PER_MS :].any()


@pytest.fixture(scope="module")
def square_law(replaying: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The firmware of electrostatic actuators; skipped where `replaying` is."""
    folder = tmp_path_factory.mktemp("square_law")
    return build_firmware(folder, "era-replay", "CFLAGS=-O0 -DSQUARE_LAW=1")


@pytest.mark.long
def test_square_of_voltages_is_the_summed_force(replaying: Path, square_law: Path) -> None:
    """With the square law two tones that cross-fade have neither harmonics nor beats.

    The square of a sample is half the full force plus half of what the same script plays as forces.
    """
    script: Script = [
        (0, arm()),
        (0, apply(1, command(0, 100, 0.9), command(1, 180, 0.5))),
        (60, apply(2, command(0, 130, 0.9, 90), command(1, 180, 0.1), ramp_ms=40)),
    ]
    forces, _ = replay(replaying, script, 150)
    voltages, _ = replay(square_law, script, 150)
    assert voltages.min() >= 0
    np.testing.assert_allclose(2 * voltages**2 - 1, forces, atol=2 * TOLERANCE)
    assert voltages[0, 3] == pytest.approx(np.sqrt(0.5), abs=TOLERANCE)  # a silent channel


@pytest.mark.parametrize(
    ("watchdog_ms", "last"),
    [
        (2000, (60, request(DISARM, bytes([20, 0])))),
        (2000, (60, request(STOP, bytes([20, 0])))),
        (100, (60, request(GET_STATUS))),  # its watchdog expires: a fault
    ],
    ids=["disarmed", "stopped", "fault"],
)
@pytest.mark.long
def test_bias_is_there_only_under_high_voltage(
    square_law: Path, watchdog_ms: int, last: tuple[int, bytes]
) -> None:
    """No voltage before Arm, nor once it has fallen silent; between them the bias."""
    script: Script = [(10, arm(watchdog_ms)), (20, apply(1, command(0, 100, 0.9))), last]
    voltages, _ = replay(square_law, script, 200)
    assert not voltages[: 10 * PER_MS].any()
    silent = voltages[10 * PER_MS + 1 : 80 * PER_MS, 3]
    np.testing.assert_allclose(silent, np.sqrt(0.5), atol=TOLERANCE)
    assert not voltages[130 * PER_MS :].any()


def test_third_voice_is_refused_and_changes_nothing(replaying: Path) -> None:
    """A set that comes while a channel cross-fades is refused with FADING; silence is not."""
    script: Script = [
        (0, arm()),
        (0, apply(1, command(0, 100, 0.5))),
        (100, apply(2, command(0, 130, 0.4), ramp_ms=40)),
    ]
    third = (120, apply(3, command(0, 160, 0.4), command(1, 160, 0.4), ramp_ms=10))
    samples, replies = replay(replaying, [*script, third], 200)
    assert replies[-1] == (NAK, bytes([7, FADING, 0]))
    assert np.array_equal(samples, replay(replaying, script, 200)[0])
    _, replies = replay(replaying, [*script, (120, apply(3, ramp_ms=10))], 200)
    assert replies[-1][0] == 0x87


def test_keep_phase_changes_the_level_alone(replaying: Path) -> None:
    """The channel keeps its own t, which began with the first set."""
    script: Script = [
        (0, arm()),
        (7, apply(1, command(0, 123.45, 0.5))),
        (100, apply(2, command(0, 123.45, 0.25, flags=KEEP_PHASE), ramp_ms=20)),
    ]
    samples, _ = replay(replaying, script, 200)
    t = seconds(len(samples))
    level = 0.25 + 0.25 * falling(t - 0.1, 0.02)
    expected = np.where(t >= 0.007, level * tone(t - 0.007, 123.45, 1), 0)
    assert np.abs(samples[:, 0] - expected).max() < TOLERANCE


def test_channel_that_falls_silent_keeps_no_phase(replaying: Path) -> None:
    """Its next voice counts t from its own commit, while the one before still fades."""
    script: Script = [
        (0, arm()),
        (7, apply(1, command(0, 123.45, 0.5))),
        (100, apply(2, ramp_ms=40)),
        (110, apply(3, command(0, 123.45, 0.25, flags=KEEP_PHASE), ramp_ms=40)),
    ]
    samples, _ = replay(replaying, script, 200)
    t = seconds(len(samples))
    first = np.where(t >= 0.007, tone(t - 0.007, 123.45, 0.5) * falling(t - 0.1, 0.04), 0)
    second = np.where(t >= 0.11, tone(t - 0.11, 123.45, 0.25) * (1 - falling(t - 0.11, 0.04)), 0)
    assert np.abs(samples[:, 0] - first - second).max() < TOLERANCE


def test_interrupted_ending_ends_when_it_would(replaying: Path) -> None:
    """By a set with a longer ramp, silent or not; a silent one plays no ending again."""
    for others in ((), (command(1, 110, 0.2),)):
        script: Script = [
            (0, load(6, 10, (0.4, 0.0))),
            (0, arm()),
            (0, apply(1, command(0, 90, 0.4, ending=6))),
            (50, apply(2)),
            (60, apply(3, *others, ramp_ms=100)),
        ]
        samples, _ = replay(replaying, script, 100)
        t = seconds(len(samples))
        expected = tone(t, 90, 0.4) * falling(t - 0.06, 0.01)
        assert np.abs(samples[:, 0] - expected).max() < TOLERANCE


def test_ending_plays_amid_an_onset_to_level_zero(replaying: Path) -> None:
    """From the present amplitude along straight lines, whatever the ramp of the silent set."""
    script: Script = [
        (0, load(5, 10, (0.4, 0.0), (0.4, 0.0))),
        (0, load(6, 10, (0.2, 0.0))),
        (0, arm()),
        (0, apply(1, command(0, 90, 0.0, onset=5, ending=6))),
        (15, apply(2, ramp_ms=100)),
    ]
    samples, _ = replay(replaying, script, 60)
    t = seconds(len(samples))
    level = np.interp(t, [0, 0.01, 0.015, 0.025, 0.035], [0, 0.4, 0.4, 0.2, 0])
    assert np.abs(samples[:, 0] - tone(t, 90, 1) * level).max() < TOLERANCE


def test_same_token_with_another_order_or_ending_is_another_set(replaying: Path) -> None:
    """An Apply with active_token is refused with BAD_TOKEN then, and confirmed otherwise."""
    first, second = command(0, 100, 0.5, ending=1), command(1, 130, 0.4)
    other_ending = command(0, 100, 0.5, ending=2)
    script = [(0, arm()), (0, load(1, 1, (0.4, 0))), (0, load(2, 1, (0.3, 0)))]
    sets = ((first, second), (first, second), (second, first), (other_ending, second))
    _, replies = replay(replaying, [*script, *((10, apply(1, *each)) for each in sets)], 30)
    refused = (NAK, bytes([7, BAD_TOKEN, 255]))
    assert [kind for kind, _ in replies[-4:-2]] == [0x87, 0x87]
    assert replies[-2:] == [refused, refused]


def test_envelopes_move_along_straight_lines(replaying: Path) -> None:
    """An onset from zero over two knots to the level, the ending to silence by valid_for."""
    onset, ending = [(0.1, 90.0), (1.0, -0.01)], [(0.3, -120.0)]
    script: Script = [
        (0, load(5, 12.5, *onset)),
        (0, load(6, 7.3, *ending)),
        (0, arm()),
        (3, apply(1, command(2, 110, 0.2, 30, onset=5, ending=6), valid_for_ms=60)),
    ]
    samples, _ = replay(replaying, script, 100)
    t = seconds(len(samples)) - 0.003
    steps = [0, 0.0125, 0.025, 0.0375, 0.06, 0.0673, 0.0746]
    knots = [(0, 0), *onset, (0.2, 30), (0.2, 30), *ending, (0, 0)]
    values = [level * np.exp(1j * np.radians(phase)) for level, phase in knots]
    amplitude = np.interp(t, steps, values, left=0)
    expected = (amplitude * np.exp(2j * np.pi * 110 * t)).imag
    assert np.abs(samples[:, 2] - expected).max() < TOLERANCE
    assert not samples[:, [0, 1, 3]].any()


@pytest.mark.parametrize("ramp_ms", [0, 100])
def test_brake_goes_on_from_the_present_amplitude(replaying: Path, ramp_ms: int) -> None:
    """With keep phase, an onset to level 0 begins where the vibration is, on its own t.

    Amid a ramp of 100 ms that is half of its level.
    """
    script: Script = [
        (0, load(1, 10, (0.5, -180.0))),
        (0, arm()),
        (0, apply(1, command(0, 90, 0.4, 20), ramp_ms=ramp_ms)),
        (50, apply(2, command(0, 90, 0, flags=KEEP_PHASE, onset=1), ramp_ms=500)),
    ]
    samples, _ = replay(replaying, script, 100)
    t = seconds(len(samples))
    full = 0.4 * np.exp(1j * np.radians(20))
    rising = 1 - falling(t, ramp_ms / 1000) if ramp_ms else np.ones(len(t))
    braking = np.interp(t, [0.05, 0.06, 0.07], [full / 2 if ramp_ms else full, -0.5, 0])
    amplitude = np.where(t < 0.05, full * rising, braking)
    expected = (amplitude * np.exp(2j * np.pi * 90 * t)).imag
    assert np.abs(samples[:, 0] - expected).max() < TOLERANCE


def test_watchdog_silences_to_the_sample(replaying: Path) -> None:
    """It trips at its time after the last request of the session, and fades over 5 ms."""
    ping = request(12, SESSION.to_bytes(2, "little"))
    script: Script = [
        (0, arm(100)),
        (0, apply(1, command(3, 200, 1.0, 90))),
        (60, ping),
        (90, request(9)),
        (100, request(12, bytes([1, 0]))),
    ]
    samples, _ = replay(replaying, script, 200)
    t = seconds(len(samples))
    expected = tone(t, 200, 1.0, 90) * falling(t - 0.16, 0.005)
    assert np.abs(samples[:, 3] - expected).max() < TOLERANCE
    assert not samples[165 * PER_MS :].any()


def test_shorter_stop_ends_sooner_and_a_longer_one_changes_nothing(replaying: Path) -> None:
    """From the present amplitude along the ramp that ends first."""
    script: Script = [
        (0, arm()),
        (0, apply(1, command(0, 150, 0.8))),
        (100, request(STOP, bytes([100, 0]))),
        (140, request(STOP, bytes([20, 0]))),
        (150, request(STOP, bytes([200, 0]))),
    ]
    samples, _ = replay(replaying, script, 200)
    t = seconds(len(samples))
    at_140 = falling(np.array([0.04]), 0.1)[0]
    gain = np.where(t < 0.14, falling(t - 0.1, 0.1), at_140 * falling(t - 0.14, 0.02))
    assert np.abs(samples[:, 0] - gain * tone(t, 150, 0.8)).max() < TOLERANCE
