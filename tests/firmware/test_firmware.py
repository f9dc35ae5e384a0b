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
import re
import signal
import struct
import subprocess
import sys
import zlib
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

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
from kit.clock import judged
from kit.hand_frames import tone as command
from kit.wires import MASTERS, damage, drive
from model.arrays import FloatArray
from processes.firmware_machine import (
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
    replay,
    request,
    running_firmware,
    values_of,
)
from processes.firmware_machine import LINES as FIRMWARE_KINDS
from processes.typed_page import installed_program
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier as SimulatedEnd

ROOT = Path(__file__).parents[2]
WORD = WireQuantity("word", "u16", 1, "", 0, 0xFFFF)
SIGNED = WireQuantity("signed", "i16", 1, "", -100, 100)
LONG = WireQuantity("long", "u32", 1, "", 0, 0xFFFFFFFF)
MADE_UP = Record(
    *(Number("first", SIGNED), Bits((("count", 8), ("is_so", 1), ("many", 2)))),
    *(Numbers("levels", "count", WORD), Rows("pairs", "many", Record(Number("a", LONG)))),
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
    """In the order of the record, also behind what varies; of two words the high one goes first."""
    compiler = installed_program("cc", package="gcc")
    (tmp_path / "records.h").write_text(records_header({"made_up": MADE_UP}))
    (tmp_path / "sent.c").write_text(PROGRAM)
    options = ("-std=c99", "-Wall", f"-I{tmp_path}", f"-I{ROOT / 'firmware' / 'core'}")
    subprocess.run([compiler, *options, "sent.c"], cwd=tmp_path, check=True)
    *words, count = map(int, subprocess.check_output([tmp_path / "a.out"], text=True).split())
    assert words == [65436, 2 << 3 | 3, 11, 12, 0, 13, 2, 3, 0, 4, 1, 4464]
    assert count == len(words)


def problems(root: Path) -> list[str]:
    """What the check of sources finds in a checkout."""
    installed_program("gcc", package="gcc")
    command = [sys.executable, ROOT / "firmware" / "test" / "sources.py", root]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == bool(done.stdout.strip()), done.stderr
    return done.stdout.splitlines()


@pytest.mark.long
def test_sources_pass() -> None:
    """Those of firmware, example and kernels."""
    assert problems(ROOT) == []


def test_ranges_of_the_header_are_used() -> None:
    """A quantity that only a board or a host needs has none."""
    paths = [each for each in (ROOT / "firmware").rglob("*.[ch]") if each.name != "protocol.h"]
    used = "".join(each.read_text("utf-8") for each in paths)
    header = (ROOT / "firmware" / "core" / "protocol.h").read_text("utf-8")
    ranges = re.findall(r"\b(?:WIRE_\w+|\w+_PER_UNIT)\b", header)
    assert len(ranges) > 10
    assert [each for each in ranges if not re.search(rf"\b{each}\b", used)] == []


COUNT = int(os.environ.get("FRAMES", "1000"))
LINES = {"serial": SERIAL, "rtu": MODBUS, "tcp": TCP, "can": CAN}
OPERATIONAL = b"O\rt0002" + b"0100\r"

Bodies = Iterator[bytes]


def on_serial(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """A frame without its checksum."""
    yield struct.pack(f"<BBBH{len(words)}H", number, VERSION, 1, sequence % 65536, *words)


def on_modbus(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """PDUs of a write and of the read of its reply."""
    count = len(words) + 1
    head = struct.pack(">BHHB", 16, 256 * number, count, 2 * count)
    yield head + struct.pack(f">{count}H", sequence % 65536, *words)
    yield struct.pack(">BHH", 3, 256 * number + 128, 122)


def on_can(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """Frames of a message, with their identifiers."""
    for data in segments(sequence % 255 + 1, number, words):
        yield struct.pack("<H", REQUEST + 1) + data


def objects_and_management(draw: random.Random) -> Bodies:
    """A frame to the objects of a node, most of which are there, or of network management."""
    yield struct.pack("<HB", 0x601, draw.randrange(256)) + bytes(
        [draw.randrange(4), 0x20, draw.randrange(32), *draw.randbytes(4)]
    )
    yield struct.pack("<HBB", 0, draw.choice([1, 1, 1, 128, 129, 130]), 0)


WIRES: dict[str, tuple[Callable[..., Bodies], Callable[[bytes], bytes]]] = {
    "serial": (
        on_serial,
        lambda body: b"\0" + cobs.encode(body + struct.pack("<I", zlib.crc32(body))) + b"\0",
    ),
    "rtu": (on_modbus, lambda body: framed(1, body, is_rtu=True)),
    "tcp": (on_modbus, lambda body: struct.pack(">HHHB", 7, 0, len(body) + 1, 1) + body),
    "can": (
        on_can,
        lambda body: SLCAN.encode(CanFrame(int.from_bytes(body[:2], "little") & 0x7FF, body[2:10])),
    ),
}
"""The bodies of a request on each wire, and the frame of a body, with a good checksum."""


@pytest.mark.parametrize("wire", shortly(LINES, ["tcp", "can"]))
def test_damaged_frames_leave_a_valid_amplifier(wire: str, moved: Callable[..., Path]) -> None:
    """Half of the requests are whole, so that it plays; damaged ones have a good checksum mostly.

    Its states, levels, watchdog and high voltage keep what the protocol says of them. It plays: a
    set for at least 500 damaged frames, and for 30 to 50 of them where a request is one frame. On
    CAN a request is five frames, so that there are five times fewer requests, and nearly none of
    those that may be damaged is whole: of the three or four of a set 0.5 each, not 0.65.
    """
    draw, firmware = random.Random(wire), MovedFirmware(moved())
    host = RandomHost(draw, values_of(firmware, hand.GET_CAPS))
    bodies, frame_of = WIRES[wire]
    time, latch, clock, sequence, damaged, tokens = 0.0, 0, 0, 0, 0, set[int]()
    while damaged < COUNT:
        if wire == "can":
            firmware.receive(CAN, OPERATIONAL)
        for number, words in host.requests(latch, clock):
            sequence += 1
            sent = [*bodies(number, words, sequence)]
            if wire == "can" and draw.random() < 0.05:
                sent += objects_and_management(draw)
            may_be_damaged = draw.random() < 0.5
            for body in sent:
                is_whole = not may_be_damaged or draw.random() < 0.3
                frame = frame_of(body if is_whole else damage(body, draw)[:250])
                frame = damage(frame, draw) if not is_whole and draw.random() < 0.1 else frame
                damaged += not is_whole
                firmware.receive(LINES[wire], frame)
                if wire == "rtu":  # which ends its frames with silence
                    time += draw.choice([0.002, 0.002, 0.002, 0.021])
                    firmware.move(time)
        time += 0.3 if draw.random() < 0.02 else draw.choice([0.0, 0.001, 0.002, 0.01])
        firmware.move(time)
        status = values_of(firmware, hand.GET_STATUS)
        is_on = bool(status["flags"] & 1 << STATUS_FLAGS["high_voltage"])
        is_armed = status["state"] == STATES["OPERATION_ENABLED"]
        assert status["state"] in STATES.values()
        assert max(status["levels"]) <= 10_000 * is_on
        assert is_on or not is_armed
        assert (status["watchdog_left"] > 0) <= is_armed
        latch, clock = status["latch"], status["clock"]
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
def test_foreign_master_drives_it(name: str, firmware: Path) -> None:
    """Reads by both functions, writes, a set, and an exception; none of the host takes part."""
    line, make = MASTERS[name]
    with running_firmware(firmware, *options(f"--modbus-{line}")) as (url, _):
        assert drive(make, url) == "ERA haptics"


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize("line", URL_ENDS)
async def test_address_is_taken_and_kept_without_supply(
    line: str, firmware: Path, tmp_path: Path
) -> None:
    """It replies there after a restart; not to the name of another, and not while armed."""
    kept = tmp_path / "addresses"
    with running_firmware(firmware, *options(line, "--addresses", str(kept))) as (url, _):
        async with opened(url) as amplifier:
            with pytest.raises(CommandRefused):
                await move(amplifier, "FW-2")
            await amplifier.arm(7, 2.0)
            with pytest.raises(CommandRefused):
                await move(amplifier, "FW-1")
            await amplifier.disarm(0.0)
            await move(amplifier, "FW-1")
            async with asyncio.timeout(60):  # it is kept behind its reply
                while not (kept.is_file() and kept.stat().st_size):  # noqa: ASYNC110 - another process writes it
                    await asyncio.sleep(0.01)
    with running_firmware(firmware, *options(line, "--addresses", str(kept))) as (url, _):
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
    """It silences an armed amplifier, keeps it from being armed, and is cleared once closed."""
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
BOARDS_OWN = {each.name for each in READINGS}
BUILDS = {"-DSMALLEST": 4, **{f"-DCHANNELS={channels}": channels for channels in (4, 8, 16)}}
"""Options of the compiler, with the number of channels."""


def differences(made: Sent, expected: Sent) -> list[str]:
    """Names of what differs."""
    if made[:2] != expected[:2]:
        return [f"{made[:2]} for {expected[:2]}"]
    if made.number not in (30, 31, *BY_NUMBER):
        return []
    ours, theirs = made.values(), expected.values()
    # But for the flag `limited`: one is foreseen at a commit, the other seen in samples.
    ours["flags"], theirs["flags"] = (each.get("flags", 0) & ~4 for each in (ours, theirs))
    for row in (*ours.get("commands", []), *theirs.get("commands", [])):
        row["phase"] *= row["level"] > 0  # of no level there is none
    return [
        f"{name}: {ours[name]} for {theirs[name]}"
        for name in ours
        if name not in BOARDS_OWN and not agree(name, ours[name], theirs[name])
    ]


def agree(name: str, ours: object, theirs: object) -> bool:
    """Whether values of a name are the same, or as good as."""
    if isinstance(ours, list) and isinstance(theirs, list):
        pairs = zip(ours, theirs, strict=True)
        return len(ours) == len(theirs) and all(agree(name, *each) for each in pairs)
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return all(agree(each, ours[each], theirs[each]) for each in ours)
    if name in ("clock", *ROUNDED):
        assert isinstance(ours, int)
        assert isinstance(theirs, int)
        if name == "clock":  # its samples come out when they are due, one later
            return abs(ahead(theirs, ours) - 1 / RATE) < CLOCK_ERROR
        return abs(ours - theirs) <= ROUNDED[name]
    return ours == theirs


def value_at(amplifier: SimulatedEnd, channel: int, time: float) -> float:
    """What it plays at a time [s]: Im[A(t) exp(2 pi i f clock(t))], limited."""
    total, seconds = 0.0, amplifier.clock.seconds(time)
    for voice in amplifier.playback.all_voices[channel]:
        turned = cmath.exp(2j * math.pi * voice.frequency * seconds)
        total += (voice.transition.at(time) * turned).imag
    return min(max(total, -1.0), 1.0)


@pytest.mark.parametrize("build", shortly(BUILDS, ["-DSMALLEST"]))
@pytest.mark.parametrize("seed", shortly(range(4), [0]))
def test_random_requests_have_the_same_replies_and_samples(
    build: str, seed: int, moved: Callable[..., Path]
) -> None:
    """Sets in parts, commits, silence, stops and nonsense, every few milliseconds.

    What differs on other wires is their frames: see conformance, and damaged frames.
    """
    draw, channels = random.Random(seed), BUILDS[build]
    firmware = MovedFirmware(moved(build), channels=channels)
    amplifier = SimulatedEnd("a", channels=channels)
    stated = Pair(firmware, SimulatedEnd("b", channels=channels)).ask(2, [])[0][0]
    amplifier.capabilities = stated.values()
    amplifier.restart(0.0)
    pair = Pair(firmware, amplifier)
    host = RandomHost(draw, amplifier.capabilities)
    for _ in range(600):
        clock = amplifier.clock.reading(pair.moment)
        for number, words in host.requests(amplifier.latch, clock):
            made, expected = pair.ask(number, words)
            assert len(made) == len(expected), (made, expected)
            for ours, theirs in zip(made, expected, strict=True):
                assert differences(ours, theirs) == [], (pair.time, number, words)
        check_samples(pair, draw, draw.choice([0, 1, 1, 2, 5, 10, 30, draw.choice([30, 400])]))


def check_samples(pair: Pair, draw: random.Random, wait: int) -> None:
    """Let a time [ms] pass, and compare some samples of every channel."""
    pair.firmware.samples()
    first, begin = round(pair.time * RATE), pair.moment - pair.time
    expected = {}
    for index in sorted(draw.sample(range(wait * RATE // 1000), min(3, wait))):
        at = (first + index) / RATE + begin
        pair.amplifier.tick(at)
        for channel in range(pair.amplifier.playback.channels):
            expected[index, channel] = value_at(pair.amplifier, channel, at)
    pair.time = round(pair.time + wait / 1000, 3)
    pair.firmware.move(pair.time)
    samples = pair.firmware.samples()
    off = {place: samples[place] - value for place, value in expected.items()}
    assert {place: each for place, each in off.items() if abs(each) > TOLERANCE} == {}, pair.time


@pytest.mark.long
@pytest.mark.parametrize("kind", FIRMWARE_KINDS)
def test_firmware_passes_conformance(kind: str, replaying: Path) -> None:
    """Every check of its wire; nothing is skipped but what it has not."""
    results = judged(kind, far=partial(FirmwareEnd, kind, replaying))
    failed = [f"{each.check.name}: {each.reason}" for each in results if each.result == "failed"]
    assert not failed, failed
    skipped = {each.check.name for each in results if each.result == "skipped"}
    of_wire = {"events"} if kind in ("rtu", "tcp") else set()
    assert skipped == of_wire | {
        *("steps_as_stated", "measured", "limited"),
    }


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
    """No voltage before Arm, nor once it has fallen silent; between them the bias."""
    script: Script = [(10, arm(watchdog_ms)), (20, apply(1, command(0, 100, 0.9))), last]
    voltages, _ = replay(square_law, script, 200)
    assert not voltages[: 10 * PER_MS].any()
    silent = voltages[10 * PER_MS + 1 : 80 * PER_MS, 3]
    np.testing.assert_allclose(silent, np.sqrt(0.5), atol=SAMPLE_TOLERANCE)
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
    assert np.abs(samples - gain * tone(t + 0.1, 100, 0.5, 90)).max() < SAMPLE_TOLERANCE
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
