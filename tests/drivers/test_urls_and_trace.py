"""URLs of amplifiers on every wire, the trace of wires, and amplifiers of other editions.

An older or newer amplifier differs by one word of Status.
"""

import os
import re
import stat
import threading
from pathlib import Path
from unittest.mock import Mock

import pytest

import hand_written as hand
from amplifier_eds import eds_text
from drivers import trace
from drivers.by_hand.reaching import status_rows
from drivers.errors import CommandError
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import MESSAGES, QUANTITIES, STATUS
from drivers.protocol.records import Number, Record, Refusal, WireQuantity
from drivers.trace import Direction, TraceWriter, tracing
from drivers.wires.wire import address_of
from firmware_records import records_header
from hand_written import HALF, Talk
from interrupted import full_disk
from protocol_tables import records
from real_wires import LATER, WORD
from real_wires import age as age
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import ObjectServer, SdoAbort
from virtual_lines import KINDS, MemoryLine, group_of, in_virtual_time, judged

STATED = {"older": {"later_voltage": None}, "same": {"later_voltage": WORD}, "newer": {}}
"""Of what is added, by the age of the amplifier."""


@pytest.mark.parametrize("wire", KINDS)
@in_virtual_time
async def test_host_drives_an_amplifier_of_another_edition(wire: str, age: str) -> None:
    """It plays and stops; what is not stated is None, what is not known is ignored."""
    end = MemoryLine(wire, "a")
    group = await group_of(end)
    await group.apply({"a": [AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.001)]})
    await group.beat()
    status = await end.hosts["a"].read_status()
    assert end.levels("a") == [0.5, 0.0]
    assert {each: status[each] for each in status if each not in _FIRST} == STATED[age]
    assert status_rows(status | {"clock": 0x40000000})["clock_s"] == 5.0  # a quarter of 20 s
    shown = {"older": None, "same": 0.0, "newer": "no key"}[age]
    assert status_rows(status).get("later_voltage_v", "no key") == shown
    assert (await group.stop())["a"].is_confirmed


_FIRST = frozenset(STATUS.names)
_UNSTATED = [0] * sum(each.words for each in STATUS.added)
"""What the table has added, of an amplifier that states only what is later than the table."""
_OLDER = 11 + 4 + 8 + len(_UNSTATED)
"""Words of 4 channels and 8 layers."""


@pytest.mark.parametrize("kind", KINDS)
def test_conformance_takes_another_edition(kind: str, age: str) -> None:
    """Words behind those that are known, or fewer, break no rule."""
    checks = "capabilities", "starts_disarmed", "areas", "present_areas", "objects", "lengths"
    assert {each.result for each in judged(kind, checks)} == {"passed"}


def test_witness_takes_another_edition(age: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A conversation written by hand breaks no rule, with a word more of the amplifier or not."""
    status = hand.status
    words = [] if age == "older" else [*_UNSTATED, WORD]
    monkeypatch.setattr(hand, "status", lambda *given, **more: [*status(*given, **more), *words])
    assert Talk().armed().fed(2).playing().says(**HALF).found == []


def test_objects_are_as_many_as_the_amplifier_states(age: str) -> None:
    """Those of 4 channels and 8 layers, and the one that is added under the next subindex."""
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


@pytest.mark.parametrize("age", ["same"], indirect=True)
def test_pages_and_files_have_what_is_added(age: str) -> None:
    """At the end of its row, of the sheet, and of what the firmware sends."""
    assert " · later_voltage (added) |" in records()
    assert f"[2002sub{_OLDER + 1:X}]\nParameterName=later_voltage\n" in eds_text()
    readings, _, put = records_header().partition("put_status(")
    assert "readings.later_voltage);\n}" in put
    assert "uint16_t later_voltage; // 0.01 V; 1 is -12 V, " in readings
    assert "#define WORD_OF_LATER_VOLTAGE(value) ((value) * 100 + 1201)\n" in readings


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
    """Two are added, the first of two words; nothing behind them is looked at."""
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


def test_places_of_words_are_those_of_the_page() -> None:
    """Of protocol.md: eleven words before the levels, three before the stream of a set."""
    assert (STATUS.places["token"], STATUS.places["layers"], STATUS.words) == (9, 10, 11)
    part = MESSAGES["Set"].request
    assert (part.places["now"], part.words) == (2, 3)
    caps = MESSAGES["GetCaps"].reply
    assert (caps.places["envelope_step_max"], caps.words) == (17, 19)


def test_trace_has_time_direction_bytes_and_meaning(tmp_path: Path) -> None:
    """A line each, only while the context lasts; a frame that cannot be decoded is shown too."""
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
    assert all(time.match(line) for line in lines)
    assert [time.sub("", line) for line in lines] == [
        "wire serial:///dev/x > 2c 01  Ping()",
        "wire serial:///dev/x < ff  not decoded: no such type",
        "request Ping() -> 'Status' in 12.3 ms",
    ]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_slow_file_drops_and_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The caller never waits; the number of dropped records stands in the file."""
    monkeypatch.setattr(trace, "MAX_PENDING", 10)
    file, may_go_on, is_writing = Mock(), threading.Event(), threading.Event()
    file.write.side_effect = lambda text: is_writing.set() or may_go_on.wait(60)
    writer = TraceWriter(file)
    monkeypatch.setattr(trace, "_writers", [writer])
    trace.frame(Direction.OUT, b"", "first", str)
    assert is_writing.wait(60)
    for _ in range(25):
        trace.frame(Direction.OUT, b"", "later", str)
    assert writer.dropped == 15
    may_go_on.set()
    writer.close()
    text = "".join(each.args[0] for each in file.write.call_args_list)
    assert text.count("later") == 10
    assert text.endswith("trace: 15 records dropped\n")


def test_full_disk_ends_only_the_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No exception of its thread, which would be printed over the result of a command."""
    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    with full_disk(), tracing(tmp_path / "trace.txt"):
        trace.frame(Direction.OUT, bytes(500), "serial:///dev/x", str)
    assert raised == []


@pytest.mark.parametrize("kind", ["fifo", "directory", "missing folder"])
def test_unusable_trace_file_is_refused(tmp_path: Path, kind: str) -> None:
    """At once, also a FIFO that nothing reads."""
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
