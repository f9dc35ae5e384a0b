"""The firmware in C: its sources, its samples, and its programs with the host of protocol 4.

Structs go by the names of their fields and files have no circle; samples follow the formulas of
docs/reference/protocol.md; the firmware is compared with the simulated amplifier, judged by
conformance, and run as a program on terminals and TCP. Damaged frames meet it under sanitizers:
`make firmware-test` has 20 000 for each line, under the sanitizer of addresses as well, and
200 000 with --long.
"""

import asyncio
import cmath
import math
import os
import random
import signal
import struct
import subprocess
import sys
import zlib
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cobs import cobs

from cases import shortly
from drivers.errors import CommandRefused
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.host.requests import Priority
from drivers.opening import Lines
from drivers.protocol.definition import (
    BY_NUMBER,
    FAULTS,
    READINGS,
    STATES,
    STATUS_FLAGS,
    VERSION,
    ahead,
)
from drivers.protocol.records import Bits, Number, Numbers, Record, Rows, Values, WireQuantity
from drivers.wires.can_frames import REQUEST, SLCAN, CanFrame, segments
from drivers.wires.modbus_frames import framed
from firmware_records import records_header
from kit import hand_frames as hand
from kit.hand_frames import tone as command
from kit.judged_lines import judged
from kit.wires import damage
from model.arrays import FloatArray
from processes.installed import installed_program
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier as SimulatedEnd
from tests.firmware.firmware_machine import (
    CAN,
    MODBUS,
    PER_MS,
    RATE,
    SERIAL,
    TCP,
    FirmwareEnd,
    MovedFirmware,
    Pair,
    RandomHost,
    Script,
    Sent,
    apply,
    arm,
    build_firmware,
    replay,
    request,
    running_firmware,
    values_of,
)
from tests.firmware.firmware_machine import LINES as FIRMWARE_KINDS
from tests.firmware.modbus_masters import MASTERS, drive

ROOT = Path(__file__).parents[2]
WORD = WireQuantity("word", "u16", 1, "", 0, 0xFFFF)
SIGNED = WireQuantity("signed", "i16", 1, "", -100, 100)
LONG = WireQuantity("long", "u32", 1, "", 0, 0xFFFFFFFF)
PAIR = Record(Number("a", LONG))
MADE_UP = Record(
    Number("first", SIGNED),
    Bits((("count", 8), ("is_so", 1), ("many", 2))),
    Numbers("levels", "count", WORD),
    Rows("pairs", "many", PAIR),
    Number("behind", LONG),
)
PROGRAM = """
#include "records.h"
#include <stdio.h>
int main(void)
{
    uint16_t levels[] = {11, 12};
    struct wire_pair pairs[] = {{.a = 13}, {.a = 0x20003}, {.a = 4}};
    struct wire_made_up made_up = {
        .behind = 70000, .pairs = pairs, .levels = levels, .many = 3, .count = 2, .first = -100,
    };
    struct words words = {.count = 0};
    put_made_up(&words, &made_up);
    for (unsigned i = 0; i < words.count; i++)
        printf("%u ", words.words[i]);
    printf("%d", MADE_UP_WORDS(2, 3));
}
"""


def test_record_is_sent_by_the_names_of_its_fields(tmp_path: Path) -> None:
    """In the order of the record, also after varying fields; of two words the high one is first."""
    compiler = installed_program("cc", package="gcc")
    (tmp_path / "records.h").write_text(records_header({"made_up": MADE_UP}))
    (tmp_path / "sent.c").write_text(PROGRAM)
    core = ROOT / "firmware" / "core"
    options = ("-std=c99", "-Wall", f"-I{tmp_path}", f"-I{core}")
    subprocess.run([compiler, *options, "sent.c"], cwd=tmp_path, check=True)

    output = subprocess.check_output([tmp_path / "a.out"], text=True)

    *words, count = map(int, output.split())
    assert words == [65436, 2 << 3 | 3, 11, 12, 0, 13, 2, 3, 0, 4, 1, 4464]
    assert count == len(words)


@pytest.mark.long
def test_sources_pass_their_check() -> None:
    """The sources of firmware, example and kernels have no circles and follow the rules."""
    installed_program("gcc", package="gcc")
    check = ROOT / "firmware" / "test" / "sources.py"

    completed = subprocess.run([sys.executable, check, ROOT], capture_output=True, text=True)

    assert completed.stdout == ""
    assert completed.returncode == 0, completed.stderr


COUNT = int(os.environ.get("FRAMES", "1000"))
LINES = {"serial": SERIAL, "rtu": MODBUS, "tcp": TCP, "can": CAN}
OPERATIONAL = b"O\rt0002" + b"0100\r"

Bodies = Iterator[bytes]


def serial_bodies(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """Yield a frame without its checksum."""
    yield struct.pack(f"<BBBH{len(words)}H", number, VERSION, 1, sequence % 65536, *words)


def modbus_bodies(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """Yield the PDUs of a write and of the read of its reply."""
    count = len(words) + 1
    head = struct.pack(">BHHB", 16, 256 * number, count, 2 * count)
    yield head + struct.pack(f">{count}H", sequence % 65536, *words)
    yield struct.pack(">BHH", 3, 256 * number + 128, 122)


def can_bodies(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """Yield the frames of a message, with their identifiers."""
    for data in segments(sequence % 255 + 1, number, words):
        yield struct.pack("<H", REQUEST + 1) + data


def can_management(chance: random.Random) -> list[bytes]:
    """Return a frame to the objects of a node, most of which exist, and one that starts nodes."""
    command = chance.randrange(256)
    value = bytes([chance.randrange(4), 0x20, chance.randrange(32), *chance.randbytes(4)])
    management = chance.choice([1, 1, 1, 128, 129, 130])
    return [struct.pack("<HB", 0x601, command) + value, struct.pack("<HBB", 0, management, 0)]


def serial_frame(body: bytes) -> bytes:
    """Return a frame with a good checksum."""
    checksum = struct.pack("<I", zlib.crc32(body))
    return b"\0" + cobs.encode(body + checksum) + b"\0"


def rtu_frame(body: bytes) -> bytes:
    """Return a frame of unit 1 with a good checksum."""
    return framed(1, body, is_rtu=True)


def tcp_frame(body: bytes) -> bytes:
    """Return a frame of unit 1 with its length."""
    return struct.pack(">HHHB", 7, 0, len(body) + 1, 1) + body


def can_frame(body: bytes) -> bytes:
    """Return a frame as an SLCAN adapter takes it."""
    identifier = int.from_bytes(body[:2], "little") & 0x7FF
    return SLCAN.encode(CanFrame(identifier, body[2:10]))


BODIES = {
    "serial": serial_bodies,
    "rtu": modbus_bodies,
    "tcp": modbus_bodies,
    "can": can_bodies,
}
FRAMES = {"serial": serial_frame, "rtu": rtu_frame, "tcp": tcp_frame, "can": can_frame}


class DamagedLine:
    """Sends requests to the firmware, half of which may be damaged."""

    def __init__(self, wire: str, firmware: MovedFirmware, chance: random.Random) -> None:
        self.wire = wire
        self.firmware = firmware
        self.chance = chance
        self.time = 0.0
        self.sequence = 0
        self.damaged_frames = 0

    def send(self, number: int, words: Sequence[int]) -> None:
        """Send a request; 70 % of the frames of every second one are damaged."""
        self.sequence += 1
        bodies = [*BODIES[self.wire](number, words, self.sequence)]
        if self.wire == "can" and self.chance.random() < 0.05:
            bodies += can_management(self.chance)
        may_be_damaged = self.chance.random() < 0.5
        for body in bodies:
            if may_be_damaged and self.chance.random() < 0.7:
                self.damaged_frames += 1
                frame = self._damaged(body)
            else:
                frame = FRAMES[self.wire](body)
            self.firmware.receive(LINES[self.wire], frame)
            if self.wire == "rtu":  # silence ends a frame
                self.wait(self.chance.choice([0.002, 0.002, 0.002, 0.021]))

    def _damaged(self, body: bytes) -> bytes:
        """Return a frame that is damaged, in 90 % of the cases with a good checksum."""
        frame = FRAMES[self.wire](damage(body, self.chance)[:250])
        return damage(frame, self.chance) if self.chance.random() < 0.1 else frame

    def wait(self, duration: float) -> None:
        """Let time pass [s]."""
        self.time += duration
        self.firmware.move(self.time)


def check_status(status: Values) -> None:
    """Check that high voltage, levels and watchdog agree with the state."""
    assert status["state"] in STATES.values()
    is_on = bool(status["flags"] & 1 << STATUS_FLAGS["high_voltage"])
    is_armed = status["state"] == STATES["OPERATION_ENABLED"]
    if is_armed:
        assert is_on
    else:
        assert status["watchdog_left"] == 0
    assert max(status["levels"]) <= (10_000 if is_on else 0)


@pytest.mark.parametrize("wire", shortly(LINES, ["tcp", "can"]))
def test_damaged_frames_leave_a_valid_amplifier(wire: str, moved: Callable[..., Path]) -> None:
    """Its status stays valid, and a set plays for every 500 damaged frames at least.

    30 to 50 damaged frames for each set are usual if a request is one frame. On CAN a request is
    five frames, so that nearly every request that may be damaged is damaged.
    """
    chance = random.Random(wire)
    firmware = MovedFirmware(moved())
    host = RandomHost(chance, values_of(firmware, hand.GET_CAPS))
    line = DamagedLine(wire, firmware, chance)
    latch = clock = 0
    tokens = set()
    while line.damaged_frames < COUNT:
        if wire == "can":
            firmware.receive(CAN, OPERATIONAL)
        for number, words in host.requests(latch, clock):
            line.send(number, words)
        is_long_pause = chance.random() < 0.02
        line.wait(0.3 if is_long_pause else chance.choice([0.0, 0.001, 0.002, 0.01]))
        status = values_of(firmware, hand.GET_STATUS)
        check_status(status)
        latch = status["latch"]
        clock = status["clock"]
        tokens.add(status["token"])
    assert len(tokens) > COUNT / 500


LIMITS = GuardLimits(20.0, 1000.0, 1.0)
URL_ENDS = {
    "--serial": "?address=9",
    "--modbus-rtu": "#9",
    "--modbus-tcp": "/9",
    "--slcan": "#9",
}
"""Options of the program, and how the URL of each line ends with the new address."""


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let replies take 5 s: the firmware is another process, on a busy machine."""
    for method in (Amplifier.request, Line.submit):
        monkeypatch.setitem(method.__kwdefaults__, "timeout", 5.0)


def options(line: str, *others: str) -> list[str]:
    """Options of the program with a line."""
    return [*others, line, *(["0"] if line == "--modbus-tcp" else [])]


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[Amplifier]:
    """The amplifier of a URL, identified."""
    lines = Lines()
    amplifier = await lines.amplifier(url, LIMITS, name="a")
    try:
        await amplifier.open()
        yield amplifier
    finally:
        await lines.close()


@pytest.mark.real_time
@pytest.mark.parametrize("name", MASTERS)
def test_foreign_modbus_master_drives_the_firmware(name: str, firmware: Path) -> None:
    """Both read functions, writes, a set and an exception, without code of the host."""
    line, make = MASTERS[name]
    with running_firmware(firmware, *options(f"--modbus-{line}")) as (url, _):
        assert drive(make, url) == "ERA haptics"


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize("line", URL_ENDS)
async def test_address_is_taken_and_kept_without_supply(
    line: str, firmware: Path, tmp_path: Path
) -> None:
    """It replies there after a restart; it refuses while armed, and with another serial number."""
    addresses = tmp_path / "addresses"
    with running_firmware(firmware, *options(line, "--addresses", str(addresses))) as (url, _):
        async with opened(url) as amplifier:
            with pytest.raises(CommandRefused):
                await move(amplifier, "FW-2")
            await amplifier.arm(7, 2.0)
            with pytest.raises(CommandRefused):
                await move(amplifier, "FW-1")
            await amplifier.disarm(0.0)
            await move(amplifier, "FW-1")
            async with asyncio.timeout(60):  # it is kept behind its reply
                while not (addresses.is_file() and addresses.stat().st_size):  # noqa: ASYNC110 - another process writes it
                    await asyncio.sleep(0.01)
    with running_firmware(firmware, *options(line, "--addresses", str(addresses))) as (url, _):
        assert url.endswith(URL_ENDS[line])
        async with opened(url) as amplifier:
            assert amplifier.identity["serial_number"] == "FW-1"


async def move(amplifier: Amplifier, serial_number: str) -> Values:
    """Send SetAddress for an amplifier of a serial number."""
    values = {"address": 9, "serial_number": serial_number}
    return await amplifier.line.submit(amplifier, Priority.OTHER, "SetAddress", values)


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_open_interlock_is_a_fault_until_it_is_closed(firmware: Path) -> None:
    """It silences an armed amplifier, prevents arming, and can be cleared once closed."""
    with running_firmware(firmware, "--serial") as (url, process):
        async with opened(url) as amplifier:
            await amplifier.arm(7, 2.0)
            os.kill(process, signal.SIGUSR1)
            status = await status_with(amplifier, state=STATES["FAULT"])
            assert (status["fault"], status["flags"]) == (FAULTS["INTERLOCK"], 2)
            assert (await amplifier.clear())["state"] == STATES["FAULT"]
            os.kill(process, signal.SIGUSR1)
            await status_with(amplifier, flags=0)
            assert (await amplifier.clear())["state"] == STATES["SWITCH_ON_DISABLED"]
            os.kill(process, signal.SIGUSR1)
            await status_with(amplifier, flags=2)
            with pytest.raises(CommandRefused):
                await amplifier.arm(8, 2.0)


async def status_with(amplifier: Amplifier, **values: int) -> Values:
    """Read the status until it has these values."""
    async with asyncio.timeout(60):
        status = await amplifier.read_status()
        while any(status[name] != value for name, value in values.items()):
            status = await amplifier.read_status()
    return status


TOLERANCE = 3e-4  # of full level: 16-bit samples, and fixed point in up to 16 voices
ROUNDED = {"levels": 2, "watchdog_left": 1, "age": 2}
"""Where replies differ by rounding."""
CLOCK_ERROR = 1e-6  # s; that of config.h
BOARDS_OWN = {reading.name for reading in READINGS}
BUILDS = {"-DSMALLEST": 4, **{f"-DCHANNELS={channels}": channels for channels in (4, 8, 16)}}
"""Options of the compiler, with the number of channels."""


def comparable(sent: Sent) -> dict[str, Any]:
    """Return the values of a reply that firmware and simulation have in common.

    The flag `limited` is foreseen at a commit by one, and seen in samples by the other. A tone of
    no level has no phase.
    """
    if sent.number not in (30, 31, *BY_NUMBER):
        return {}
    values = sent.values()
    if "flags" in values:
        values["flags"] &= ~4
    for row in values.get("commands", []):
        if row["level"] == 0:
            row["phase"] = 0
    return {name: value for name, value in values.items() if name not in BOARDS_OWN}


def differences(reply: Sent, expected: Sent) -> list[str]:
    """Return the names and values of fields that differ."""
    if reply[:2] != expected[:2]:
        return [f"{reply[:2]} for {expected[:2]}"]
    expected_values = comparable(expected)
    texts = []
    for name, value in comparable(reply).items():
        if not agree(name, value, expected_values[name]):
            texts.append(f"{name}: {value} for {expected_values[name]}")
    return texts


def agree(name: str, value: Any, expected: Any) -> bool:
    """Return whether values of a name are the same, within rounding."""
    if isinstance(value, list):
        if len(value) != len(expected):
            return False
        return all(agree(name, *pair) for pair in zip(value, expected, strict=True))
    if isinstance(value, dict):
        return all(agree(key, value[key], expected[key]) for key in value)
    if name == "clock":  # its samples are put out when they are due, one later
        return abs(ahead(expected, value) - 1 / RATE) < CLOCK_ERROR
    if name in ROUNDED:
        return abs(value - expected) <= ROUNDED[name]
    return bool(value == expected)


def value_at(amplifier: SimulatedEnd, channel: int, time: float) -> float:
    """Return what it plays at a time [s]: Im[A(t) exp(2 pi i f clock(t))], limited."""
    total = 0.0
    clock = amplifier.clock.seconds(time)
    for voice in amplifier.playback.all_voices[channel]:
        rotation = cmath.exp(2j * math.pi * voice.frequency * clock)
        total += (voice.transition.at(time) * rotation).imag
    return min(max(total, -1.0), 1.0)


@pytest.mark.parametrize("build", shortly(BUILDS, ["-DSMALLEST"]))
@pytest.mark.parametrize("seed", shortly(range(4), [0]))
def test_random_requests_have_the_same_replies_and_samples(
    build: str, seed: int, moved: Callable[..., Path]
) -> None:
    """Sets in parts, commits, silence, stops and nonsense, every few milliseconds.

    Other wires differ in their frames, which conformance and damaged frames cover.
    """
    chance = random.Random(seed)
    channels = BUILDS[build]
    firmware = MovedFirmware(moved(build), channels=channels)
    amplifier = SimulatedEnd("a", channels=channels)
    (stated,), _ = Pair(firmware, SimulatedEnd("b", channels=channels)).ask(2, [])
    amplifier.capabilities = stated.values()
    amplifier.restart(0.0)
    pair = Pair(firmware, amplifier)
    host = RandomHost(chance, amplifier.capabilities)
    for _ in range(600):
        clock = amplifier.clock.reading(pair.moment)
        for number, words in host.requests(amplifier.latch, clock):
            replies, expected_replies = pair.ask(number, words)
            assert len(replies) == len(expected_replies), (replies, expected_replies)
            for reply, expected in zip(replies, expected_replies, strict=True):
                assert differences(reply, expected) == [], (pair.time, number, words)
        long_pause = chance.choice([30, 400])
        check_samples(pair, chance, chance.choice([0, 1, 1, 2, 5, 10, 30, long_pause]))


def check_samples(pair: Pair, chance: random.Random, pause: int) -> None:
    """Let a time [ms] pass, and compare some samples of every channel."""
    pair.firmware.samples()
    first = round(pair.time * RATE)
    start = pair.moment - pair.time
    expected = {}
    indices = chance.sample(range(pause * RATE // 1000), min(3, pause))
    for index in sorted(indices):
        time = (first + index) / RATE + start
        pair.amplifier.tick(time)
        for channel in range(pair.amplifier.playback.channels):
            expected[index, channel] = value_at(pair.amplifier, channel, time)
    pair.time = round(pair.time + pause / 1000, 3)
    pair.firmware.move(pair.time)
    samples = pair.firmware.samples()
    compared = {place: samples[place] for place in expected}
    assert compared == pytest.approx(expected, abs=TOLERANCE), pair.time


BUFFERED = ["ramps", "starts_at_its_moment", "voices"]
"""Checks of levels and tokens at exact times."""


@pytest.mark.long
@pytest.mark.parametrize("kind", FIRMWARE_KINDS)
def test_firmware_passes_conformance(kind: str, replaying: Path) -> None:
    """Every check of its wire; only features that it lacks are skipped."""
    results = judged(kind, far=partial(FirmwareEnd, kind, replaying))

    failures = {}
    skipped = set()
    for result in results:
        if result.result == "failed":
            failures[result.check.name] = result.reason
        elif result.result == "skipped":
            skipped.add(result.check.name)
    assert failures == {}
    expected = {"steps_as_stated", "measured", "limited"}
    if kind in ("rtu", "tcp"):
        expected.add("events")
    assert skipped == expected


@pytest.mark.parametrize("names", shortly([[], BUFFERED], [BUFFERED]))
def test_firmware_with_samples_ahead_passes_conformance(names: list[str], replaying: Path) -> None:
    """With 3 samples in the converter's buffer, Status shows levels and tokens of the output."""
    far = partial(FirmwareEnd, "serial", replaying, buffered=3)

    results = judged("serial", names, far=far)

    failures = {result.check.name: result.reason for result in results if result.result == "failed"}
    assert failures == {}


SAMPLE_TOLERANCE = 6e-5  # of full level: two steps of a 16-bit sample, and phases over seconds


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
    script: Script = []
    for index, bit in product(range(len(frame)), range(8)):
        damaged = bytearray(frame)
        damaged[index] ^= 1 << bit
        script.append((10, b"\0" + cobs.encode(bytes(damaged)) + b"\0"))

    _, replies = replay(replaying, script, 20)

    assert replies == []


@pytest.fixture(scope="module")
def square_law(moved: Callable[..., Path]) -> Path:
    """The firmware of electrostatic actuators."""
    return moved("-DSQUARE_LAW=1")


@pytest.mark.long
def test_square_of_voltages_is_the_summed_force(replaying: Path, square_law: Path) -> None:
    """With the square law two tones that cross-fade have neither harmonics nor beats.

    The square of a sample is half the full force plus half the force of the same script.
    """
    script: Script = [
        (0, arm()),
        (0, apply(1, command(0, 100, 0.9), command(1, 180, 0.5))),
        (60, apply(2, command(0, 130, 0.9, 90), command(1, 180, 0.1), ramp_ms=40)),
    ]
    forces, _ = replay(replaying, script, 150)
    voltages, _ = replay(square_law, script, 150)
    assert voltages.min() >= 0
    np.testing.assert_allclose(2 * voltages**2 - 1, forces, atol=2 * SAMPLE_TOLERANCE)
    assert voltages[0, 3] == pytest.approx(np.sqrt(0.5), abs=SAMPLE_TOLERANCE)  # a silent channel


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
    """No voltage before Arm and once it is silent again; the bias in between."""
    script: Script = [(10, arm(watchdog_ms)), (20, apply(1, command(0, 100, 0.9))), last]
    voltages, _ = replay(square_law, script, 200)
    assert not voltages[: 10 * PER_MS].any()
    silent = voltages[10 * PER_MS + 1 : 80 * PER_MS, 3]
    np.testing.assert_allclose(silent, np.sqrt(0.5), atol=SAMPLE_TOLERANCE)
    assert not voltages[130 * PER_MS :].any()


def test_oldest_fade_ends_sooner_where_no_voice_is_free(replaying: Path) -> None:
    """With 16 voices, the 17th tone that lasts cuts the fade that began first, within 2 ms."""
    script: Script = [(0, arm()), (1, apply(1, command(0, 100, 0.5)))]
    for token in range(2, 18):  # 1 ms after each other, each fading over 100 ms
        script.append((token, apply(token, command(0, 100 + token, 0.001), ramp_ms=100)))

    samples, _ = replay(replaying, script, 30)

    t = seconds(len(samples))
    fading = falling(t - 0.002, 0.1)
    cut = fading[17 * PER_MS] * falling(t - 0.017, 0.002)
    level = np.where(t < 0.017, fading, cut)
    level[t < 0.001] = 0
    others = 0.002  # the level of all other tones at most
    np.testing.assert_allclose(samples[:, 0], level * tone(t, 100, 0.5), rtol=0, atol=others)


@pytest.mark.parametrize("is_converter_still", [False, True])
def test_stalled_loop_is_silent_as_soon_as_it_runs(
    replaying: Path, *, is_converter_still: bool
) -> None:
    """A watchdog of 0.25 s and a stall of 1.2 s, with and without samples meanwhile.

    The watchdog is real time: samples that were due end 0.255 s after it was fed, and where the
    converter stood still at most 5 ms are made.
    """
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm(250))
    firmware.receive(SERIAL, apply(1, command(0, 100, 0.5, 90)))
    firmware.move(0.1)
    firmware.samples()
    firmware.stall(1.3, is_converter_still=is_converter_still)
    firmware.move(1.4)
    samples = firmware.samples()[:, 0]
    first = 0.0 if is_converter_still else 0.15
    t = seconds(len(samples))
    gain = falling(t - first, 0.005)
    expected = gain * tone(t + 0.1, 100, 0.5, 90)
    np.testing.assert_allclose(samples, expected, rtol=0, atol=SAMPLE_TOLERANCE)
    status = values_of(firmware, hand.GET_STATUS)
    assert status["state"] == hand.FAULT
    assert status["fault"] == hand.WATCHDOG


def test_high_voltage_is_measured_as_soon_as_it_is_switched(replaying: Path) -> None:
    """Read every 0.1 ms during a Disarm of 5 ms: 1800 V never occur with the flag off."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    firmware.receive(SERIAL, apply(1, command(0, 100, 0.5)))
    firmware.move(0.0993)
    firmware.receive(SERIAL, request(hand.DISARM, 5))
    readings = set()
    for step in range(120):
        firmware.move(0.0993 + 1e-4 * step)
        status = values_of(firmware, hand.GET_STATUS)
        readings.add((status["flags"], status["high_voltage"]))
    assert readings == {(1, 1800), (0, 0)}


@pytest.fixture(scope="module")
def in_real_time(compiled: Path) -> Path:
    """The firmware as configured for a board: 2 channels, samples at most 4 ms late."""
    return build_firmware(compiled / "in-real-time", "era-moved.so", "NOT_REAL_TIME=")


def playing(folder: Path) -> MovedFirmware:
    """Firmware that has played a tone on channel 0 for 0.1 s."""
    firmware = MovedFirmware(folder, channels=2)
    firmware.receive(SERIAL, arm(250))
    firmware.receive(SERIAL, apply(1, command(0, 100, 0.5)))
    firmware.move(0.1)
    firmware.samples()
    return firmware


@pytest.mark.parametrize("sample_time", [70e-6, 100e-6, 500e-6])
def test_overload_is_a_fault_and_silent(in_real_time: Path, sample_time: float) -> None:
    """Samples that take longer than 62.5 us: FAULT_INTERNAL within 0.1 s, before the watchdog."""
    firmware = playing(in_real_time)
    firmware.load(sample_time)
    firmware.move(0.2)
    firmware.samples()
    firmware.move(firmware.time + 0.01)
    samples = firmware.samples()
    firmware.load(0.0)
    firmware.move(firmware.time + 0.01)

    assert len(samples) > 0
    assert not samples.any()
    status = values_of(firmware, hand.GET_STATUS)
    assert status["state"] == hand.FAULT
    assert status["fault"] == FAULTS["INTERNAL"]
    firmware.receive(SERIAL, request(hand.CLEAR, status["latch"]))
    assert values_of(firmware, hand.GET_STATUS)["state"] == STATES["SWITCH_ON_DISABLED"]


def test_load_below_the_sample_time_is_no_fault(in_real_time: Path) -> None:
    """At 80 % load, after a request that has taken 3 ms, it catches up and plays every sample."""
    firmware = playing(in_real_time)
    firmware.load(50e-6)
    firmware.stall(0.103, is_converter_still=False)
    firmware.move(0.2)

    assert len(firmware.samples()) == pytest.approx(0.1 * RATE, abs=0.002 * RATE)
    assert values_of(firmware, hand.GET_STATUS)["state"] == hand.ENABLED


@pytest.mark.parametrize("sample_time", [50e-6, 70e-6, 500e-6])
def test_stop_takes_effect_within_10_ms_under_load(in_real_time: Path, sample_time: float) -> None:
    """While samples of 3.5 ms are late, bytes are read: the stop is latched and acknowledged."""
    firmware = playing(in_real_time)
    firmware.load(sample_time)
    firmware.stall(0.1035, is_converter_still=False)
    firmware.sent(SERIAL)

    firmware.receive(SERIAL, request(hand.STOP, 0))

    assert len(firmware.sent(SERIAL)) > 0
    assert firmware.time - 0.1035 < 0.01
    firmware.samples()
    firmware.move(firmware.time + 0.02)
    assert not firmware.samples().any()
