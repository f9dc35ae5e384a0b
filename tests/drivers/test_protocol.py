"""Messages of protocol 4 as words, URLs of amplifiers on every wire, and the trace of wires.

Messages, and sets of layers as streams of words, against rows and a stream that were written by
hand from their definition. An amplifier of an older or newer edition differs by one word of Status.
"""

import os
import random
import re
import stat
import threading
from itertools import permutations
from pathlib import Path
from unittest.mock import Mock

import pytest

from drivers import trace
from drivers.by_hand.rows import status_rows
from drivers.errors import CommandError
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import (
    BY_NUMBER,
    MESSAGES,
    QUANTITIES,
    STAGED_LIFE,
)
from drivers.protocol.definition import STATUS as STATUS_RECORD
from drivers.protocol.records import Number, Record, Refusal, Values, WireQuantity
from drivers.protocol.sets import Assembly, is_last, pack_layers, parts, unpack_layers
from drivers.trace import Direction, TraceWriter, tracing
from drivers.wires.wire import address_of
from kit.clock import KINDS, MemoryLine, group_of, in_virtual_time
from processes.interrupted import full_disk
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.canopen_objects import ObjectServer, SdoAbort
from tests.drivers.protocol_editions import LATER, WORD
from tests.drivers.protocol_editions import age as age

STATED = {"older": {"later_voltage": None}, "same": {"later_voltage": WORD}, "newer": {}}
"""The added readings that an amplifier of each age states."""


@pytest.mark.parametrize("wire", KINDS)
@in_virtual_time
async def test_host_drives_an_amplifier_of_another_edition(wire: str, age: str) -> None:
    """It plays and stops; a reading that it lacks is None, and an unknown word is ignored."""
    end = MemoryLine(wire, "a")
    group = await group_of(end)
    await group.apply({"a": [AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.001)]})
    await group.beat()
    status = await end.hosts["a"].read_status()
    assert end.levels("a") == [0.5, 0.0]
    assert {name: status[name] for name in status if name not in _FIRST} == STATED[age]
    assert status_rows(status | {"clock": 0x40000000})["clock_s"] == 5.0  # a quarter of 20 s
    temperature = {"older": None, "same": 0.0, "newer": "no key"}[age]
    assert status_rows(status).get("later_voltage_v", "no key") == temperature
    assert (await group.stop())["a"].is_confirmed


_FIRST = frozenset(STATUS_RECORD.names)
_UNSTATED = [0] * sum(entry.words for entry in STATUS_RECORD.added)
"""Words of the added readings of an amplifier that states only newer ones."""
_OLDER = 11 + 4 + 8 + len(_UNSTATED)
"""Words of 4 channels and 8 layers."""


def test_objects_are_as_many_as_the_amplifier_states(age: str) -> None:
    """The objects of 4 channels and 8 layers, and the added one under the next subindex."""
    objects = ObjectServer(SimulatedAmplifier("a", channels=4), 1)
    if age == "older":
        assert objects.read(0x2002, 0, 0.0) == bytes([_OLDER]), (
            "each row of READINGS has its value in sim/amplifier/readings.py"
        )
        with pytest.raises(SdoAbort):
            objects.read(0x2002, _OLDER + 1, 0.0)
    else:
        assert objects.read(0x2002, 0, 0.0) == bytes([_OLDER + 1])
        assert int.from_bytes(objects.read(0x2002, _OLDER + 1, 0.0), "little") == WORD


@pytest.mark.parametrize(
    ("word", "volts"), [(0, None), (1, -12.0), (1201, 0.0), (1202, 0.01), (7201, 60.0)]
)
def test_reading_that_is_added_may_be_zero_or_less(word: int, volts: float | None) -> None:
    """Steps count from the lowest value, which is 1; both ends agree."""
    assert LATER.in_unit(Record(LATER).unpack([word], is_strict=True)) == volts
    assert volts is None or LATER.quantity.to_wire(volts) == word
    with pytest.raises(CommandError, match="-12 to 60 V"):
        LATER.quantity.to_wire(-12.01)


def test_added_numbers_may_be_missing_and_zero_is_not_stated() -> None:
    """Two readings are added, the first of two words; later words are ignored."""
    code = Number("code", QUANTITIES["code"])
    long = Number("long", WireQuantity("long", "u32", 1, "", 1, 1 << 31), is_added=True)
    record = Record(code, long, LATER)
    for words, stated in {
        (7,): (None, None),
        (7, 1): (65536, None),
        (7, 0, 5): (5, None),
        (7, 0, 0, 2400): (None, 2400),
        (7, 1, 2, 2400, 9): (65538, 2400),
    }.items():
        values = dict(zip(("code", "long", LATER.name), (7, *stated), strict=True))
        assert record.unpack(words, is_strict=False) == values
        assert record.pack(values) == [*words[:4]]
    with pytest.raises(Refusal):
        record.unpack([7, 0x8001, 0], is_strict=False)
    with pytest.raises(ValueError, match=r"begin at 1.*got 0.*the zero 1,"):
        Number("flags", QUANTITIES["flags"], is_added=True)


def test_trace_has_time_direction_bytes_and_meaning(tmp_path: Path) -> None:
    """One line for each frame within the context, also for a frame that cannot be decoded."""
    path = tmp_path / "trace.txt"
    trace.frame(Direction.OUT, b"\x01", "before", lambda: "before")
    with tracing(path):
        trace.frame(Direction.OUT, b"\x2c\x01", "serial:///dev/x", lambda: "Ping()")
        trace.frame(
            Direction.IN, b"\xff", "serial:///dev/x", Mock(side_effect=ValueError("no such type"))
        )
        trace.request("Ping()", "Status", 0.0123)
    trace.frame(Direction.OUT, b"\x01", "after", lambda: "after")
    lines = path.read_text("utf-8").splitlines()
    time = re.compile(r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}\+00:00 ")
    assert [time.sub("<time> ", line) for line in lines] == [
        "<time> wire serial:///dev/x > 2c 01  Ping()",
        "<time> wire serial:///dev/x < ff  not decoded: no such type",
        "<time> request Ping() -> 'Status' in 12.3 ms",
    ]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_slow_file_drops_and_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The caller never waits; the file ends with the number of dropped records."""
    monkeypatch.setattr(trace, "MAX_PENDING_RECORDS", 10)
    file, may_go_on, is_writing = Mock(), threading.Event(), threading.Event()
    file.write.side_effect = lambda text: is_writing.set() or may_go_on.wait(60)
    writer = TraceWriter(file)
    writer.add("first", str)
    assert is_writing.wait(60)
    for _ in range(25):
        writer.add("later", str)
    assert writer.dropped == 15
    may_go_on.set()
    writer.close()
    text = "".join(call.args[0] for call in file.write.call_args_list)
    assert text.count("later") == 10
    assert text.endswith("trace: 15 records dropped\n")


def test_full_disk_ends_only_the_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its thread raises no exception, which would be printed over the result of a command."""
    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    with full_disk(), tracing(tmp_path / "trace.txt"):
        trace.frame(Direction.OUT, bytes(500), "serial:///dev/x", str)
    assert raised == []


@pytest.mark.parametrize("kind", ["fifo", "directory", "missing folder"])
def test_unusable_trace_file_is_refused(tmp_path: Path, kind: str) -> None:
    """Immediately, even a FIFO that no process reads."""
    path = tmp_path / "trace"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "directory":
        path.mkdir()
    else:
        path /= "file"
    with pytest.raises(CommandError, match="trace file"), tracing(path):
        pass


TCP, RTU = "modbus+tcp", "modbus+rtu"
EVEN = {"parity": "E", "stop": 1}


@pytest.mark.parametrize(
    ("url", "line", "number", "settings"),
    [
        ("serial:///dev/ttyUSB0", "/dev/ttyUSB0", 1, {"baud": 921_600}),
        ("serial:///dev/ttyS1?baud=115200&address=7", "/dev/ttyS1", 7, {"baud": 115_200}),
        ("serial+tcp://box.local:4001", "box.local:4001", 1, {"baud": 0}),
        ("serial+tcp://box:4001?baud=19200&address=3", "box:4001", 3, {"baud": 19_200}),
        (f"{TCP}://10.0.0.7", "10.0.0.7:502", 1, {"baud": 0}),
        (f"{TCP}://amp:1502/247", "amp:1502", 247, {"baud": 0}),
        (f"{TCP}://[::1]:1502/2", "::1:1502", 2, {"baud": 0}),
        (
            f"{RTU}:///dev/ttyS1?baud=19200&parity=none&stop=2#9",
            *("/dev/ttyS1", 9, {"baud": 19_200, "parity": "N", "stop": 2}),
        ),
        (f"{RTU}:///dev/ttyS1", "/dev/ttyS1", 1, {"baud": 115_200, **EVEN}),
        ("serial:///dev/by-id/a_#1-if00?baud=9600", "/dev/by-id/a_#1-if00", 1, {"baud": 9600}),
        (f"{RTU}:///dev/by-id/a_#1-if00?stop=2#9", "/dev/by-id/a_#1-if00", 9, {"stop": 2}),
        (f"{TCP}://gw/3?baud=9600", "gw:502", 3, {"baud": 9600, **EVEN}),
        (f"{RTU}://srv:4001#2", "srv:4001", 2, {"baud": 0}),
        ("can+slcan:///dev/ttyACM0", "can+slcan:///dev/ttyACM0", 1, {"bitrate": 500_000}),
        ("can+slcan://10.0.0.7:4001#9", "can+slcan://10.0.0.7:4001", 9, {}),
        ("can+socketcan://can0#127", "can+socketcan://can0", 127, {"bitrate": 500_000}),
        ("can+socketcand://10.0.0.7:29536/can1#9", "can+socketcand://10.0.0.7:29536/can1", 9, {}),
        (
            "can+python-can://virtual/x?bitrate=250000#2",
            *("can+python-can://virtual/x", 2, {"bitrate": 250_000}),
        ),
    ],
)
def test_url_is_parsed(url: str, line: str, number: int, settings: dict[str, object]) -> None:
    """Line, address and options, with their defaults."""
    address = address_of(url)
    assert (address.line, address.number) == (line, number)
    assert settings.items() <= address.settings.items()


STREAM = [
    *(0x0002, 20, 500),  # layer 0, two commands
    *(0x0000, 2200, 2000, 0),
    *(0x003B, 5010, 10000, 0xDCD8),  # channel 3, keep phase, onset and ending
    *(2, 50, 1000, 9000, 10000, 0xFFFF),
    *(1, 20, 500, 0),
    *(0x0100, 10, 0),  # layer 2, silenced
    *(0x01A0, 0, 800),  # layer 3, renewed
]


@pytest.mark.parametrize(
    ("stream", "code", "channel"),
    [
        ([0x0002, 20, 500, 0x0000, 2200, 2000, 0], "BAD_LENGTH", None),
        ([0x0002, 20, 500, *(0x0030, 2200, 0, 0) * 2], "BAD_CHANNEL", 3),
        ([0x0000, 20, 500, 0x0000, 20, 500], "BAD_VALUE", None),
        ([0x0021, 20, 500, 0x0000, 2200, 2000, 0], "BAD_VALUE", None),
        ([0x0040, 20, 500], "BAD_VALUE", None),
        ([0x0060, 20, 500], "BAD_VALUE", None),
        ([0x1000, 20, 500], "BAD_VALUE", None),
        ([0x0001, 20, 500, 0x0000, 2200, 10001, 0], "BAD_VALUE", 0),
        ([0x0001, 20, 500, 0x0052, 2200, 1, 0, 33, 50, *(0, 0) * 33], "BAD_VALUE", 5),
        # The first of two flaws counts: length, layer, channel, then the channel's words.
        ([0x0001, 1001, 500, 0x0010, 2200, 0, 0, 9], "BAD_VALUE", None),
        ([0x0001, 1001, 500, 0x0012, 2200, 0, 0, 1, 50, 0], "BAD_LENGTH", None),
        ([0x0001, 20, 500, 0x0010, 2200, 0, 18000, 0x0000, 1001, 0], "BAD_VALUE", 1),
        ([0x0002, 20, 500, 0x0030, 2200, 10001, 0, 0x0030, 2200, 0, 0], "BAD_VALUE", 3),
        ([0x0002, 1001, 500, *(0x0030, 2200, 0, 0) * 2], "BAD_VALUE", None),
        ([0x0002, 20, 500, 0x0030, 2200, 0, 0, 0x0030, 2200, 10001, 0], "BAD_CHANNEL", 3),
    ],
)
def test_stream_that_no_host_may_send_is_refused(
    stream: list[int], code: str, channel: int | None
) -> None:
    """Cut short, a channel or layer twice, renew or after in vain, a level or knots too many."""
    with pytest.raises(Refusal) as caught:
        unpack_layers(stream)
    assert (caught.value.code, caught.value.channel) == (code, channel)


def test_set_is_whole_whatever_the_order_of_its_parts() -> None:
    """The parts but the last, in both orders and one again, give the stream that was cut."""
    stream = list(range(300))
    *first_parts, last = parts(stream, session=9, token=7, now=False)
    assert [len(MESSAGES["Set"].request.pack(part)) for part in (*first_parts, last)] == [
        120,
        120,
        69,
    ]
    assert [is_last(part) for part in (*first_parts, last)] == [False, False, True]
    for order in permutations(first_parts):
        assembly = Assembly()
        assert [assembly.keep(part, 0.1) for part in (*order, order[0])] == [True] * 3
        assert assembly.first_missing(last) is None
        assert assembly.stream(last) == stream


def test_parts_of_another_set_or_too_late_are_not_mixed() -> None:
    """Another token, or the maximum duration of a set, discards the collected parts."""
    old, new = (parts([token] * 300, session=9, token=token, now=False) for token in (1, 2))
    assembly = Assembly()
    assert assembly.keep(old[0], 0.0)
    assert assembly.keep(new[1], 0.1)
    assert assembly.first_missing(new[2]) == 0
    assert assembly.keep(new[0], 0.1 + STAGED_LIFE + 0.01)
    assert assembly.first_missing(new[2]) == 1
    assert not assembly.keep({**new[1], "parts": 4}, 1.2)
    assert assembly.keep(new[1], 0.2 + STAGED_LIFE)
    assert assembly.stream(new[2]) == [2] * 300
    assert assembly.first_missing(old[2]) == 0


def test_damaged_streams_are_read_or_refused() -> None:
    """Random words are refused, or decoded to layers that encode to the same words."""
    chance = random.Random(3)
    read = 0
    for _ in range(5_000):
        stream = list(STREAM)
        for _ in range(chance.randrange(1, 4)):
            stream[chance.randrange(len(stream))] = chance.choice((0, 1, 2, 500, 0x3B, 0x3F, 65535))
        try:
            layers = unpack_layers(stream)
        except Refusal:
            continue
        read += 1
        assert pack_layers(layers) == stream
    assert read > 300


STATUS: Values = {
    **{"state": 4, "fault": 0, "flags": 1, "latch": 0, "watchdog_left": 250},
    **{
        "temperature": -53,
        "high_voltage": 1800,
        "clock": 65538,
        "token": 513,
        "channels": 4,
        "layers": 2,
    },
    **{"levels": [2000, 0, 0, 10000], "tokens": [513, 0]},
}


def test_reading_has_its_unit_in_its_names_and_the_decimals_of_its_step() -> None:
    """Steps of 0.05 rpm have two decimals; a unit without a name for keys is an error."""
    speed = Number("fan_speed", WireQuantity("fan_speed", "u16", 20, "rpm", 1, 65535))
    assert (speed.key, speed.metric, speed.label) == (*("fan_speed_rpm",) * 2, "fan speed")
    assert (speed.decimals, Number("count", QUANTITIES["count"]).decimals) == (2, 0)
    with pytest.raises(ValueError, match=r"unit of fan_speed .* rpm, got /min"):
        WireQuantity("fan_speed", "u16", 20, "/min", 1, 65535)


@pytest.mark.parametrize(
    ("name", "words", "code"),
    [
        ("Arm", [9, 250], "BAD_LENGTH"),
        ("Arm", [9, 250, 0, 0], "BAD_LENGTH"),
        ("Arm", [9, 99, 0], "BAD_VALUE"),
        ("Arm", [0, 250, 0], "BAD_VALUE"),
        ("Commit", [9, 0, 0], "BAD_TOKEN"),
        ("Set", [9, 1], "BAD_LENGTH"),
        ("SetAddress", [5, 33, *[0x4141] * 17], "BAD_LENGTH"),
        ("SetAddress", [5, 2, 0x0A41], "BAD_VALUE"),
        ("SetAddress", [5, 1, 0xFF00], "BAD_VALUE"),
    ],
)
def test_request_that_no_host_may_send_is_refused(name: str, words: list[int], code: str) -> None:
    """Too short, too long or out of range: each has its own code."""
    with pytest.raises(Refusal) as caught:
        MESSAGES[name].request.unpack(words, is_strict=True)
    assert caught.value.code == code


def test_random_words_are_read_or_refused() -> None:
    """Random words are refused, or decoded to values that encode to the same words."""
    random_words = random.Random(5)
    read = 0
    for _ in range(5_000):
        message = BY_NUMBER[random_words.choice(list(BY_NUMBER))]
        values = [
            random_words.choice((0, 1, 2, 9, 300, 65535)) for _ in range(random_words.randrange(24))
        ]
        for record in (message.request, message.reply):
            try:
                unpacked = record.unpack(values, is_strict=True)
            except Refusal:
                continue
            read += 1
            packed = record.pack(unpacked)
            assert [*packed, *[0] * (len(values) - len(packed))] == values
    assert read > 300
