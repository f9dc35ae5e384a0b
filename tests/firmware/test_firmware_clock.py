"""The firmware's clock and what counts on it, against the protocol page, at two sample rates.

Sample k since power-up has the clock k / rate [s], and is put out when it is due, a sample later:
so a reading is that much behind the time since then, and the same for all that run it.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from drivers.protocol.definition import MESSAGES
from drivers.wires.modbus_frames import framed
from kit import hand_frames as hand
from tests.firmware.firmware_machine import (
    CAN,
    MODBUS,
    SERIAL,
    SESSION,
    MovedFirmware,
    apply,
    request,
    values_of,
)

TURN = 20.0  # s
STEP = TURN / 2**16  # s; of the high word
CLOCK_ERROR = 1e-6  # s; that it states
LEVEL_ERROR = 1e-4  # a step
MARK = 19
OPERATIONAL, RESET_NODE = b"O\rt00020100\r", b"t00028100\r"
TONE = hand.tone(0, 100, 0.5, 90)


@pytest.fixture(
    params=[16_000, pytest.param(48_000, marks=pytest.mark.long)], ids=["16kHz", "48kHz"]
)
def rate(request: pytest.FixtureRequest) -> int:
    """Samples per second."""
    return int(request.param)


@pytest.fixture
def built(rate: int, moved: Callable[..., Path]) -> Path:
    """The firmware of that rate."""
    return moved() if rate == 16_000 else moved(f"-DSAMPLE_RATE={rate}")


def clock_of(firmware: MovedFirmware) -> float:
    """Return the clock that its Status shows [s]."""
    return float(values_of(firmware, hand.GET_STATUS)["clock"] / 2**32 * TURN)


def check_clock(firmware: MovedFirmware, expected: float, error: float = CLOCK_ERROR) -> None:
    """Check that its clock is as expected [s], within an error and a number of turns."""
    assert lead(clock_of(firmware), expected) == pytest.approx(0, abs=error)


def high_word_of(firmware: MovedFirmware) -> int:
    """Return the high word of its clock."""
    return int(values_of(firmware, hand.GET_STATUS)["clock"] >> 16)


def lead(clock: float, reference: float) -> float:
    """Return by how much a clock is ahead of a reference [s]."""
    return (clock - reference + TURN / 2) % TURN - TURN / 2


def arm(shift: int = 0) -> bytes:
    """Return an Arm that moves the clock on by steps of the high word."""
    return request(hand.ARM, SESSION, 2000, shift)


def stage(token: int, *layers: Sequence[int]) -> bytes:
    """Return a set of one part, which waits for its commit."""
    return request(hand.SET, *hand.part(token, *layers, session=SESSION))


def commit(token: int, at: int) -> bytes:
    """Return a Commit for a high word of the clock."""
    return request(hand.COMMIT, SESSION, token, at % 65536)


def first_sound(firmware: MovedFirmware) -> int:
    """Return the index of the first sample of the first channel that is not 0."""
    return int(np.flatnonzero(firmware.samples()[:, 0])[0])


def test_clock_is_read_between_samples(rate: int, built: Path) -> None:
    """At odd times it is a sample behind them, within its stated error and without bias."""
    firmware = MovedFirmware(built)
    capabilities = values_of(firmware, hand.GET_CAPS)
    assert capabilities["clock_error"] == round(CLOCK_ERROR * 1e7)
    errors = []
    for number in range(1, 300):
        time = round(0.00271828 * number, 6)
        firmware.move(time)
        clock = clock_of(firmware)
        errors.append(lead(clock, time - 1 / rate))

    np.testing.assert_allclose(errors, 0, atol=CLOCK_ERROR)
    assert np.mean(errors) == pytest.approx(0, abs=CLOCK_ERROR / 4)


def output_after(built: Path, *, buffered: int) -> tuple[float, int]:
    """Return the clock [s] and the number of samples after 0.0987654 s."""
    firmware = MovedFirmware(built, buffered=buffered)
    firmware.move(0.0987654)
    return clock_of(firmware), len(firmware.samples())


@pytest.mark.parametrize("buffered", [1, 700])
def test_clock_is_the_time_of_the_output(built: Path, buffered: int) -> None:
    """Samples that are made ahead into a buffer do not count."""
    clock, samples = output_after(built, buffered=0)
    buffered_clock, buffered_samples = output_after(built, buffered=buffered)

    assert lead(buffered_clock, clock) == pytest.approx(0, abs=CLOCK_ERROR)
    extra_samples = buffered_samples - samples
    assert extra_samples == buffered


def level_after(since: float, ramp: float) -> float:
    """Return the level while a tone of 0.5 ends and one of 0.25 starts along a raised cosine.

    since: time after their first sample [s]. ramp: length of the raised cosine [s].
    """
    way = min(max(since / ramp, 0.0), 1.0) if ramp else float(since >= 0)
    risen = 0.5 - 0.5 * math.cos(math.pi * way)
    return 0.5 * (1 - risen) + 0.25 * risen


@pytest.mark.parametrize("ramp", [0, 5])
def test_levels_are_those_of_the_output(rate: int, built: Path, ramp: int) -> None:
    """From the moment of a set to the last sample of its ramp, although samples are made ahead."""
    buffered = 40
    firmware = MovedFirmware(built, buffered=buffered)
    firmware.receive(SERIAL, arm())
    firmware.receive(SERIAL, stage(1, hand.layer(0, TONE, ramp=0)))
    firmware.receive(SERIAL, commit(1, 0))
    firmware.move(0.1)
    firmware.receive(SERIAL, stage(2, hand.layer(0, hand.tone(0, 130, 0.25, 0), ramp=ramp)))
    moment = high_word_of(firmware) + 50
    firmware.receive(SERIAL, commit(2, moment))
    start = math.ceil(moment * STEP * rate) / rate
    for number in range(400):
        firmware.move(0.11 + 0.0000625 * number)
        status = values_of(firmware, hand.GET_STATUS)
        since = lead(status["clock"] / 2**32 * TURN, start)
        limits = [level_after(since, ramp / 1000)]
        limits.append(level_after(since + 1 / rate + CLOCK_ERROR, ramp / 1000))
        level = status["levels"][0] / 10_000
        assert min(limits) - LEVEL_ERROR <= level <= max(limits) + LEVEL_ERROR, f"{since} s"


@pytest.mark.parametrize(
    ("ping", "ending"),
    [
        (32767, request(hand.DISARM, 0)),
        (-32768, request(hand.STOP, 0)),
        (1000, b""),  # its watchdog expires
        (1000, RESET_NODE),
    ],
    ids=["disarmed", "stopped", "fault", "reset"],
)
def test_ping_sets_the_rate_until_it_is_disarmed(
    built: Path, rate: int, ping: int, ending: bytes
) -> None:
    """In 4 s it gains so many tenths of a millionth; a Ping of another session sets nothing.

    Once disarmed, the rate is 0, and a Ping does not change it.
    """
    firmware = MovedFirmware(built)
    firmware.receive(CAN, OPERATIONAL)
    firmware.receive(SERIAL, arm())
    for time in range(4):
        firmware.move(time)
        firmware.receive(SERIAL, request(hand.PING, SESSION, ping))
        firmware.receive(SERIAL, request(hand.PING, SESSION + 1, -ping))
    firmware.move(4)
    gained = 4 * ping * 1e-7
    check_clock(firmware, 4 + gained - 1 / rate)

    firmware.receive(CAN if ending == RESET_NODE else SERIAL, ending)
    firmware.move(7)
    firmware.receive(SERIAL, request(hand.PING, SESSION, ping))
    clock = clock_of(firmware)
    firmware.move(8)

    check_clock(firmware, clock + 1)


def test_arm_shifts_the_clock_of_a_new_session_once(built: Path) -> None:
    """By its shift of steps of 0.3 ms; the same session again shifts nothing."""
    firmware = MovedFirmware(built)
    expected = clock_of(firmware) + 40_000 * STEP

    for shift in (40_000, 7):
        firmware.receive(SERIAL, arm(shift))
        check_clock(firmware, expected, error=1e-9)


def test_voices_follow_the_clock(rate: int, built: Path) -> None:
    """Level * sin(2 pi f clock + phase), across the end of a turn, whenever it was committed.

    The clock starts one step before the end of a turn.
    """
    firmware = MovedFirmware(built)
    firmware.receive(SERIAL, arm(65535))
    tones = [
        (0.0001, 333.35, 0.3, 0.0),
        (0.01713, 100.0, 0.5, 90.0),
        (0.0331, 333.35, 0.4, -45.0),
    ]
    for token, (time, frequency, level, phase) in enumerate(tones, 1):
        firmware.move(time)
        tone = hand.tone(0, frequency, level, phase)
        firmware.receive(SERIAL, apply(token, tone))
    firmware.move(0.05)
    samples = firmware.samples()[:, 0]

    clock = np.arange(len(samples)) / rate - STEP
    expected = np.zeros(len(samples))
    for time, frequency, level, phase in tones:
        first = math.floor(round(time * rate, 6))
        angle = 2 * np.pi * frequency * clock[first:] + np.radians(phase)
        expected[first:] = level * np.sin(angle)
    np.testing.assert_allclose(samples, expected, atol=6e-5)


@pytest.mark.parametrize("ahead", [1, 2, 300, 1638])
def test_commit_starts_with_the_first_sample_of_its_moment(
    rate: int, built: Path, ahead: int
) -> None:
    """It counts as committed until then, and a repeated Commit changes nothing."""
    firmware = MovedFirmware(built)
    shift = 65_500
    firmware.receive(SERIAL, arm(shift))
    firmware.move(0.01234)
    firmware.receive(SERIAL, stage(1, hand.layer(0, TONE, ramp=0)))
    moment = high_word_of(firmware) + ahead
    firmware.receive(SERIAL, commit(1, moment))
    firmware.receive(SERIAL, commit(1, moment + 50))
    status = values_of(firmware, hand.GET_STATUS)
    assert status["token"] == 1
    if ahead > 1:
        assert status["tokens"][0] == 0

    firmware.move(0.6)

    first_after_moment = math.ceil((moment - shift) % 65536 * 20 * rate / 65536)
    first_after_commit = math.floor(0.01234 * rate)
    assert first_sound(firmware) == max(first_after_moment, first_after_commit)
    assert values_of(firmware, hand.GET_STATUS)["tokens"][0] == 1


@pytest.mark.parametrize("ahead", [0, 1639, -1, 32768])
def test_commit_for_no_moment_ahead_starts_immediately(rate: int, built: Path, ahead: int) -> None:
    """With the next sample: the present high word, an earlier one, and more than 0.5 s ahead."""
    firmware = MovedFirmware(built)
    firmware.receive(SERIAL, arm())
    firmware.move(0.01234)
    firmware.receive(SERIAL, stage(1, hand.layer(0, TONE, ramp=0)))

    firmware.receive(SERIAL, commit(1, high_word_of(firmware) + ahead))

    firmware.move(0.02)
    assert first_sound(firmware) == math.floor(0.01234 * rate)


def test_set_starts_although_a_layer_ends_at_its_moment(replaying: Path) -> None:
    """With keep_phase its voice continues from its amplitude; 625 samples are 128 steps."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    firmware.move((625 * 4 - 32) / 16_000)
    ending = hand.layer(0, TONE, ramp=0, valid_for=2)  # 32 samples
    firmware.receive(SERIAL, request(hand.SET, *hand.part(1, ending, now=True)))
    continued = hand.tone(0, 100, 0.5, 90, keep_phase=True)
    firmware.receive(SERIAL, stage(2, hand.layer(0, continued, ramp=5)))
    firmware.receive(SERIAL, commit(2, 512))

    firmware.move(0.2)

    samples = firmware.samples()[:, 0]
    times = np.arange(len(samples)) / 16_000
    expected = 0.5 * np.cos(2 * np.pi * 100 * times)
    np.testing.assert_allclose(samples[2468:], expected[2468:], atol=6e-5)


MARKS = {
    SERIAL: hand.frame(MARK, sequence=1, address=0),
    MODBUS: framed(0, bytes.fromhex("10 13 00 00 01 02 00 05"), is_rtu=True),
    CAN: b"t20080000130000000000\r",
}
"""The broadcast of number 19 on each line."""


@pytest.mark.parametrize("line", MARKS)
def test_mark_keeps_the_clock_of_its_last_byte(replaying: Path, line: int) -> None:
    """The next Status shows it once; on RTU the silence behind the frame does not count."""
    firmware = MovedFirmware(replaying)
    assert MESSAGES["Mark"].number == MARK
    firmware.receive(CAN, OPERATIONAL)
    firmware.move(0.0123456)
    firmware.sent(line)
    firmware.receive(line, MARKS[line])
    firmware.move(0.05)

    replies = firmware.sent(line).split(b"\r")
    heartbeats = [reply for reply in replies if reply.startswith(b"t701")]
    assert b"".join(replies) == b"".join(heartbeats)
    sample = 1 / 16_000
    check_clock(firmware, 0.0123456 - sample)
    check_clock(firmware, 0.05 - sample)
