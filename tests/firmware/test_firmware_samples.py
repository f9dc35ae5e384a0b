"""The firmware's samples against the formulas of docs/decisions/0088-protocol-4.md."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

import hand_written as hand
from firmware_machine import (
    PER_MS,
    RATE,
    SERIAL,
    MovedFirmware,
    Script,
    apply,
    arm,
    replay,
    request,
    values_of,
)
from hand_written import tone as command
from model.arrays import FloatArray

TOLERANCE = 6e-5  # of full level: two steps of a 16-bit sample, and phases over seconds


def seconds(count: int) -> FloatArray:
    """Times [s] of so many samples."""
    return np.arange(count) / RATE


def tone(times: FloatArray, frequency: float, level: float, phase: float = 0.0) -> FloatArray:
    """Level x sin(2 pi frequency t + phase)."""
    return np.asarray(level * np.sin(2 * np.pi * frequency * times + np.radians(phase)))


def falling(times: FloatArray, ramp: float) -> FloatArray:
    """(1 + cos(pi s)) / 2, with s from 0 to 1 over the ramp [s]."""
    return np.asarray((1 + np.cos(np.pi * np.clip(times / ramp, 0, 1))) / 2)


def test_frame_with_any_wrong_bit_is_not_answered(replaying: Path) -> None:
    """A CRC-32 finds every single one, be it in the frame or in the checksum."""
    frame = cobs.decode(arm()[1:-1])
    damaged = [
        b"\0" + cobs.encode(frame[:at] + bytes([frame[at] ^ 1 << bit]) + frame[at + 1 :]) + b"\0"
        for at in range(len(frame))
        for bit in range(8)
    ]
    _, replies = replay(replaying, [(10, each) for each in damaged], 20)
    assert replies == []


@pytest.fixture(scope="module")
def square_law(moved: Callable[..., Path]) -> Path:
    """The firmware of electrostatic actuators."""
    return moved("-DSQUARE_LAW=1")


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
        (2000, (60, request(hand.DISARM, 20))),
        (2000, (60, request(hand.STOP, 20))),
        (100, (60, request(hand.GET_STATUS))),  # its watchdog expires: a fault
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


def test_oldest_fade_ends_sooner_where_no_voice_is_free(replaying: Path) -> None:
    """With 16 voices, the 17th tone that lasts cuts the fade that began first, within 2 ms."""
    script: list[tuple[float, bytes]] = [(0, arm()), (1, apply(1, command(0, 100, 0.5)))]
    for token in range(2, 18):  # each a millisecond after the other, which fades over 100 ms
        script.append((token, apply(token, command(0, 100 + token, 0.001), ramp_ms=100)))
    samples, _ = replay(replaying, script, 30)
    t = seconds(len(samples))
    fading = falling(t - 0.002, 0.1)
    cut = fading[17 * PER_MS] * falling(t - 0.017, 0.002)
    level = np.where(t < 0.001, 0, np.where(t < 0.017, fading, cut))
    # The others rise to 0.001 at the most.
    assert np.abs(samples[:, 0] - level * tone(t, 100, 0.5)).max() < 0.002


@pytest.mark.parametrize("is_converter_still", [False, True])
def test_stalled_loop_is_silent_as_soon_as_it_runs(
    replaying: Path, *, is_converter_still: bool
) -> None:
    """A watchdog of 0.25 s and a stall of 1.2 s, with and without samples meanwhile.

    The watchdog is real time: samples that were due end 0.255 s after it was fed, and where the
    converter stood still no more than 5 ms are made.
    """
    firmware = MovedFirmware(replaying)
    for frame in (arm(250), apply(1, command(0, 100, 0.5, 90))):
        firmware.receive(SERIAL, frame)
    firmware.move(0.1)
    firmware.samples()
    firmware.stall(1.3, is_converter_still=is_converter_still)
    firmware.move(1.4)
    samples = firmware.samples()[:, 0]
    first = 0.0 if is_converter_still else 0.15
    t = seconds(len(samples))
    gain = falling(t - first, 0.005)
    assert np.abs(samples - gain * tone(t + 0.1, 100, 0.5, 90)).max() < TOLERANCE
    status = values_of(firmware, hand.GET_STATUS)
    assert (status["state"], status["fault"]) == (hand.FAULT, hand.WATCHDOG)


def test_watchdog_left_is_real_time_after_a_stall(replaying: Path) -> None:
    """Of 250 ms, 0.21 s after it was fed, 40 are left, though samples were made for 0.11 s only."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm(250))
    firmware.move(0.1)
    firmware.stall(0.2, is_converter_still=True)
    firmware.move(0.21)
    status = values_of(firmware, hand.GET_STATUS)
    assert status["state"] == hand.ENABLED
    assert status["watchdog_left"] == pytest.approx(40, abs=1)


def test_high_voltage_is_measured_as_soon_as_it_is_switched(replaying: Path) -> None:
    """Read every 0.1 ms amid a Disarm along 5 ms: never 1800 V beside a flag that says off."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    firmware.receive(SERIAL, apply(1, command(0, 100, 0.5)))
    firmware.move(0.0993)
    firmware.receive(SERIAL, request(hand.DISARM, 5))
    seen = set()
    for step in range(120):
        firmware.move(0.0993 + 1e-4 * step)
        status = values_of(firmware, hand.GET_STATUS)
        seen.add((status["flags"], status["high_voltage"]))
    assert seen == {(1, 1800), (0, 0)}
