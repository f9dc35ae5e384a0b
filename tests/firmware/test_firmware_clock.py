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
from processes.firmware_machine import (
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


def seconds(firmware: MovedFirmware) -> float:
    """The clock that its Status shows [s]."""
    return float(values_of(firmware, hand.GET_STATUS)["clock"] / 2**32 * TURN)


def apart(clock: float, other: float) -> float:
    """By how much a clock is ahead of another [s]."""
    return (clock - other + TURN / 2) % TURN - TURN / 2


def arm(shift: int = 0, *, watchdog_ms: int = 2000, session: int = SESSION) -> bytes:
    """An Arm that moves its clock on by steps of the high word."""
    return request(hand.ARM, session, watchdog_ms, shift)


def staged(token: int, *layers: Sequence[int]) -> bytes:
    """A set of one part, which waits for its commit."""
    return request(hand.SET, *hand.part(token, *layers, session=SESSION))


def commit(token: int, at: int) -> bytes:
    """A Commit for a moment."""
    return request(hand.COMMIT, SESSION, token, at % 65536)


def test_clock_is_read_between_samples(rate: int, built: Path) -> None:
    """At odd times it is a sample behind them, within what it states, and nothing is biased."""
    firmware = MovedFirmware(built)
    assert values_of(firmware, hand.GET_CAPS)["clock_error"] == round(CLOCK_ERROR * 1e7)
    off = []
    for number in range(1, 300):
        time = round(0.00271828 * number, 6)
        firmware.move(time)
        off.append(apart(seconds(firmware), time - 1 / rate))
    assert max(map(abs, off)) < CLOCK_ERROR
    assert abs(sum(off) / len(off)) < CLOCK_ERROR / 4


def test_clock_is_the_same_after_a_turn(built: Path) -> None:
    """20 s later, within its last bit of 5 ns: 6 hours add less than 5 us."""
    firmware = MovedFirmware(built)
    firmware.move(0.01)
    clock = seconds(firmware)
    firmware.move(0.01 + TURN)
    assert abs(apart(seconds(firmware), clock)) <= TURN / 2**32


@pytest.mark.parametrize("buffered", [1, 700])
def test_clock_is_that_at_the_output(built: Path, buffered: int) -> None:
    """Not that of samples which are made ahead, into a buffer: those are as many more."""
    clocks, made = [], []
    for ahead in (0, buffered):
        firmware = MovedFirmware(built, buffered=ahead)
        firmware.move(0.0987654)
        clocks.append(seconds(firmware))
        made.append(len(firmware.samples()))
    assert abs(apart(*clocks)) < CLOCK_ERROR
    assert made[1] - made[0] == buffered


@pytest.mark.parametrize(
    ("ping", "end"),
    [
        (32767, request(hand.DISARM, 0)),
        (-32768, request(hand.STOP, 0)),
        (1000, b""),  # its watchdog expires
        (1000, RESET_NODE),
    ],
    ids=["disarmed", "stopped", "fault", "reset"],
)
def test_ping_sets_the_rate_until_it_is_disarmed(
    built: Path, rate: int, ping: int, end: bytes
) -> None:
    """Of 4 s it is ahead by as many tenths of a millionth; one of another session sets nothing.

    Once it is not armed the rate is 0, and a Ping does not change that.
    """
    firmware = MovedFirmware(built)
    firmware.receive(CAN, OPERATIONAL)
    firmware.receive(SERIAL, arm())
    for time in range(4):
        firmware.move(time)
        firmware.receive(SERIAL, request(hand.PING, SESSION, ping))
        firmware.receive(SERIAL, request(hand.PING, SESSION + 1, -ping))
    firmware.move(4)
    ahead = 4 * ping * 1e-7
    assert apart(seconds(firmware), 4 + ahead) == pytest.approx(-1 / rate, abs=CLOCK_ERROR)
    firmware.receive(CAN if end == RESET_NODE else SERIAL, end)
    firmware.move(7)
    firmware.receive(SERIAL, request(hand.PING, SESSION, ping))
    since = seconds(firmware)
    firmware.move(8)
    assert apart(seconds(firmware), since) == pytest.approx(1, abs=CLOCK_ERROR)


def test_arm_moves_the_clock_on_once(built: Path) -> None:
    """By its shift of steps of 0.3 ms; the session that is held moves it no more."""
    firmware = MovedFirmware(built)
    before = seconds(firmware)
    for shift in (40_000, 7):
        firmware.receive(SERIAL, arm(shift))
        assert apart(seconds(firmware), before + 40_000 * STEP) == pytest.approx(0, abs=1e-9)


def test_voices_count_on_the_clock(rate: int, built: Path) -> None:
    """Level x sin(2 pi f clock + phase), over the end of a turn, whatever was committed when.

    The clock begins a step before it goes round.
    """
    firmware = MovedFirmware(built)
    firmware.receive(SERIAL, arm(65535))
    plays = [
        (0.0001, (333.35, 0.3, 0.0)),
        (0.01713, (100.0, 0.5, 90.0)),
        (0.0331, (333.35, 0.4, -45.0)),
    ]
    for token, (time, tone) in enumerate(plays, 1):
        firmware.move(time)
        firmware.receive(SERIAL, apply(token, hand.tone(0, *tone)))
    firmware.move(0.05)
    samples = firmware.samples()[:, 0]
    expected = np.zeros(len(samples))
    k = np.arange(len(samples))
    for time, (frequency, level, phase) in plays:
        first = math.floor(round(time * rate, 6))
        angle = 2 * np.pi * frequency * (k / rate - STEP) + np.radians(phase)
        expected[first:] = level * np.sin(angle[first:])
    np.testing.assert_allclose(samples, expected, atol=6e-5)


@pytest.mark.parametrize("ahead", [1, 2, 300, 1638])
def test_commit_starts_with_the_first_sample_of_its_moment(
    rate: int, built: Path, ahead: int
) -> None:
    """It counts as committed until then, and a repeated Commit changes nothing."""
    firmware, shift = MovedFirmware(built), 65_500
    firmware.receive(SERIAL, arm(shift))
    firmware.move(0.01234)
    firmware.receive(SERIAL, staged(1, hand.layer(0, TONE, ramp=0)))
    at = (values_of(firmware, hand.GET_STATUS)["clock"] >> 16) + ahead
    firmware.receive(SERIAL, commit(1, at))
    firmware.receive(SERIAL, commit(1, at + 50))
    status = values_of(firmware, hand.GET_STATUS)
    # The first sample at or behind the high word of the clock.
    first = max(math.ceil((at - shift) % 65536 * 20 * rate / 65536), math.floor(0.01234 * rate))
    assert (status["token"], status["tokens"][0]) == (1, 0 if ahead > 1 else status["tokens"][0])
    firmware.move(0.6)
    sounding = np.flatnonzero(firmware.samples()[:, 0])
    assert sounding[0] == first
    assert values_of(firmware, hand.GET_STATUS)["tokens"][0] == 1


@pytest.mark.parametrize("ahead", [0, 1639, -1, 32768])
def test_commit_of_no_moment_ahead_starts_at_once(rate: int, built: Path, ahead: int) -> None:
    """With the next sample: the present high word, one behind, and more than 0.5 s ahead."""
    firmware = MovedFirmware(built)
    firmware.receive(SERIAL, arm())
    firmware.move(0.01234)
    firmware.receive(SERIAL, staged(1, hand.layer(0, TONE, ramp=0)))
    at = (values_of(firmware, hand.GET_STATUS)["clock"] >> 16) + ahead
    firmware.receive(SERIAL, commit(1, at))
    firmware.move(0.02)
    assert np.flatnonzero(firmware.samples()[:, 0])[0] == math.floor(0.01234 * rate)


def test_set_starts_though_a_layer_ends_at_its_moment(replaying: Path) -> None:
    """Its voice goes on from its amplitude: keep phase, and 625 samples are 128 steps."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    firmware.move((625 * 4 - 32) / 16_000)
    first = hand.layer(0, TONE, ramp=0, valid_for=2)  # 32 samples
    firmware.receive(SERIAL, request(hand.SET, *hand.part(1, first, now=True)))
    kept = hand.tone(0, 100, 0.5, 90, keep_phase=True)
    firmware.receive(SERIAL, staged(2, hand.layer(0, kept, ramp=5)))
    firmware.receive(SERIAL, commit(2, 512))
    firmware.move(0.2)
    samples = firmware.samples()[2500 - 32 :, 0]
    k = np.arange(2500 - 32, 2500 - 32 + len(samples))
    np.testing.assert_allclose(samples, 0.5 * np.cos(2 * np.pi * 100 * k / 16_000), atol=6e-5)


_MODBUS = bytes([16]) + (256 * MARK).to_bytes(2, "big") + bytes([0, 1, 2, 0, 5])
MARKS = {
    SERIAL: hand.frame(MARK, sequence=1, address=0),
    MODBUS: framed(0, _MODBUS, is_rtu=True),
    CAN: f"t2008{0:02X}{0:02X}{MARK:02X}{0:02X}00000000\r".encode(),
}
"""The broadcast on each line."""


@pytest.mark.parametrize("line", MARKS)
def test_mark_keeps_the_clock_of_its_last_byte(replaying: Path, line: int) -> None:
    """The next Status has it, once; on RTU the silence behind the frame does not count."""
    firmware = MovedFirmware(replaying)
    assert MESSAGES["Mark"].number == MARK
    firmware.receive(CAN, OPERATIONAL)
    firmware.move(0.0123456)
    firmware.sent(line)
    firmware.receive(line, MARKS[line])
    firmware.move(0.05)
    said = [each for each in firmware.sent(line).split(b"\r") if not each.startswith(b"t701")]
    assert not any(said)  # but heartbeats
    assert apart(seconds(firmware), 0.0123456 - 1 / 16_000) == pytest.approx(0, abs=CLOCK_ERROR)
    assert apart(seconds(firmware), 0.05 - 1 / 16_000) == pytest.approx(0, abs=CLOCK_ERROR)
