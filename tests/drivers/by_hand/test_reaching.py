"""Reaching the amplifiers of a rig by their URLs: the check of a rig, clocks, and slcan adapters.

`era config check` tells how closely the clocks are held by the lines; an adapter is detected by two
characters, and by listening.
"""

import asyncio
import json
import math
from collections.abc import AsyncIterator, Callable
from dataclasses import replace

import pytest
import pytest_asyncio
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner

from drivers.by_hand import reaching
from drivers.by_hand.cli import app
from drivers.by_hand.reaching import (
    Arrangement,
    Candidate,
    arrangement_of,
    check_links,
    detect_slcan,
)
from drivers.urls import CLOCK_ERRORS, SIMULATED
from drivers.wires.can_frames import CanFrame
from registry.limits import GuardLimits
from sim.far_ends.can_amplifiers import CanBus, SlcanAdapter
from sim.transport.far_end import make_terminal
from sim.transport.simulated_line import LINE_KINDS, PROMPT

BUS = "can+socketcan://can0"
LIMITS = GuardLimits(40.0, 250.0, 1.0)


def checked(*urls: str, channels: int = 4) -> tuple[dict[str, str], list[str]]:
    """Amplifiers a, b, ... at these URLs, with so many channels each."""
    named = dict(zip("abcd", urls, strict=False))
    return check_links(named, channels=dict.fromkeys(named, channels), limits=LIMITS)


@pytest.mark.parametrize("frequencies", [(5.0, 250.0), (40.0, 5000.0)])
def test_check_links_warns_of_limits_beyond_the_ceilings(frequencies: tuple[float, float]) -> None:
    """10 Hz, and 65 535 steps of 1/20 Hz."""
    low, high = frequencies
    limits = replace(LIMITS, frequency_min=low, frequency_max=high)
    _, (warning,) = check_links({}, channels={}, limits=limits)
    assert "10 to 3276.75 Hz" in warning


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("serail:///dev/ttyUSB0", r"unknown wire 'serail://'; did you mean serial://\? known are"),
        ("carrier+pigeon://coop", "known are .*modbus.tcp://, serial://, .*sim://"),
        ("serial:///dev/ttyUSB0?baud=fast", "baud must be.*'fast'"),
        ("modbus+tcp://host/999", "unit must be.*'999'"),
        (f"{BUS}#300", "node must be.*'300'"),
        # The longest part of a set, of 120 words, and its reply: 282 bytes of 11 bits and four
        # silences of 3.5 of them at 19200 baud are 170 ms, beside three heartbeats of 50 ms.
        ("modbus+rtu:///dev/ttyS1?baud=19200#1", "at least 320 ms.*got 250 ms; use a faster"),
        ("serial:///dev/ttyUSB9?baud=115200&address=2", "baud must be 921600 .*got 115200"),
    ],
)
def test_check_links_names_an_unusable_url(url: str, message: str) -> None:
    """Unknown scheme, invalid part of a URL, too slow for the watchdog, another speed of a line."""
    wrong, warnings = checked("serial:///dev/ttyUSB9", url)
    assert list(wrong) == ["b"]
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(wrong["b"])
    assert warnings == []


def test_check_links_refuses_two_amplifiers_at_one_address() -> None:
    """However the URL is spelled; the error is on the second and names the first."""
    wrong, _ = checked(f"{BUS}#1", f"{BUS}#2", f"{BUS}?bitrate=500000#1")
    assert list(wrong) == ["c"]
    assert "amplifier a" in wrong["c"]


@pytest.mark.parametrize(
    ("urls", "times"),
    [
        # 282 bytes of 11 bits, four silences of 1.75 ms, 10 ms for the amplifier: twice each.
        ([f"modbus+rtu:///dev/ttyS1?baud=38400#{unit}" for unit in (1, 2)], ["441 ms"]),
        # At 115 200 baud the longest set is repeated once in 88 ms, a short one twice in 90 ms.
        ([f"modbus+rtu:///dev/ttyS1?baud=115200#{unit}" for unit in (1, 2)], ["230 ms"]),
        (["serial:///dev/ttyUSB0"], []),
        # Three times 30 ms each, after a heartbeat of 50 ms.
        (["serial:///dev/ttyUSB0?address=1", "serial:///dev/ttyUSB0?address=2"], ["230 ms"]),
        (["serial:///dev/ttyUSB0", "modbus+tcp://host/1"], []),
        (["modbus+tcp://host/1", "modbus+tcp://host/2", "modbus+tcp://host/3"], ["320 ms"]),
        ([f"{BUS}#1", f"{BUS}#5"], ["230 ms"]),
    ],
)
def test_check_links_warns_of_late_loss_detection(urls: list[str], times: list[str]) -> None:
    """Slow lines, and lines on which several amplifiers wait for each other; times by hand."""
    wrong, warnings = checked(*urls)
    assert wrong == {}
    late = [warning for warning in warnings if "later than 150 ms" in warning]
    assert len(late) == len(times)
    for warning, time in zip(late, times, strict=True):
        assert time in warning


STATED = 5e-6 / math.sqrt(3)
"""5 us at most either way, all errors alike, are so much rms."""


def arranged(*urls: str) -> Arrangement | None:
    """Amplifiers a, b, ... at these URLs, with four channels each."""
    named = dict(zip("abcd", urls, strict=False))
    return arrangement_of(
        named, channels=dict.fromkeys(named, 4), stated=dict.fromkeys(named, 5e-6)
    )


@pytest.mark.parametrize(
    ("urls", "kinds", "has_remedy"),
    [
        (["serial:///dev/ttyUSB0", "serial:///dev/ttyUSB1"], ["ftdi-low-latency"] * 2, True),
        (["serial:///dev/ttyACM0", "serial:///dev/ttyAMA0"], ["usb-full-speed", "native"], True),
        (["modbus+rtu:///dev/serial/x#1", "can+slcan:///y#1"], ["usb-full-speed", "can-usb"], True),
        (["serial:///dev/ttyS0", "can+socketcan://can0#1"], ["native", "can"], False),
        (["serial+tcp://one:5000?baud=921600", "modbus+tcp://two/1"], ["ethernet"] * 2, True),
        (
            ["serial:///dev/ttyACM0?line=usb-high-speed", "modbus+rtu:///b?line=native#1"],
            ["usb-high-speed", "native"],
            False,
        ),
        ([f"serial:///dev/ttyS0?address={each}" for each in (1, 2, 3)], ["native"] * 3, False),
        (["modbus+tcp://host/1", "modbus+tcp://host/2"], ["ethernet"] * 2, True),
        (["sim://r?amplifier=a", "sim://r?amplifier=b&line=ftdi"], [SIMULATED, "ftdi"], True),
    ],
)
def test_clocks_are_held_as_closely_as_the_line_allows(
    urls: list[str], kinds: list[str], has_remedy: bool
) -> None:
    """By separate lines of each kind, named or not, one bus, simulated; sums of squares."""
    found = arranged(*urls)
    assert found is not None
    errors = [math.hypot(STATED, CLOCK_ERRORS[each]) for each in kinds]
    assert [*found.errors.values()] == pytest.approx(errors)
    assert bool(found.remedy) == has_remedy


def test_what_would_be_better_is_not_there_already() -> None:
    """One bus of full speed is held by Marks, whatever its adapter; 0.2 ms are of the clocks."""
    bus = [f"serial:///dev/ttyACM0?address={each}" for each in (1, 2)]
    found = arranged(*bus)
    assert found is not None
    assert found.remedy == ""
    assert found.errors["a"] == pytest.approx(math.hypot(STATED, 7e-6))
    named = {"a": "serial:///dev/ttyACM0", "b": "serial:///dev/ttyACM1"}
    wide = arrangement_of(named, channels={"a": 4, "b": 4}, stated={"a": 5e-6, "b": 2e-4})
    assert wide is not None
    assert "clock_error" in wide.remedy


def test_every_kind_of_line_that_is_simulated_has_an_error() -> None:
    """Under the same names: what the check says of one is measured with it."""
    assert CLOCK_ERRORS.keys() == {*LINE_KINDS, PROMPT}


def test_one_amplifier_with_eras_has_no_arrangement() -> None:
    """One alone, a second one without ERAs, a URL that is reported elsewhere."""
    pair = {"a": "serial:///dev/ttyUSB0", "b": "serial:///dev/ttyUSB1"}
    assert arranged(pair["a"]) is None
    stated = dict.fromkeys("ab", 5e-6)
    assert arrangement_of(pair, channels={"a": 4, "b": 0}, stated=stated) is None
    assert arranged(pair["a"], "serail:///dev/ttyUSB0") is None


def test_a_clock_that_cannot_be_steered_is_held_to_nothing() -> None:
    """Whatever the line; the other one is as before."""
    pair = {"a": "serial:///dev/ttyS0", "b": "serial:///dev/ttyS1"}
    stated = {"a": 2e-6, "b": math.inf}
    found = arrangement_of(pair, channels={"a": 4, "b": 4}, stated=stated)
    assert found is not None
    assert found.errors == {
        "a": pytest.approx(math.hypot(2e-6 / math.sqrt(3), CLOCK_ERRORS["native"])),
        "b": math.inf,
    }


SPOKEN = b"V\rC\rS6\rL\rC\r"
BEATS = ((0x701, b"\x05"), (0x77F, b"\x7f"), (0x700, b"\x05"), (0x181, b"\0"))
"""Heartbeats of nodes 1 and 127, and frames that are none of a node."""


class Adapter:
    """A serial port with a far end's adapter; said: to it; heard: on its bus."""

    def __init__(self) -> None:
        self.said, self.heard = b"", list[CanFrame]()
        bus = CanBus()
        self.terminal = make_terminal(self._read)
        adapter = SlcanAdapter(bus, self.terminal.write)
        self.receive: Callable[[bytes], None] = lambda data: adapter.receive(data, 0.0)
        bus.join(self.heard.append)
        self.terminal.listen()
        self._bus = bus

    async def beat(self) -> None:
        """Send what nodes send, for ever."""
        while True:
            for can_id, data in BEATS:
                self._bus.send(CanFrame(can_id, data), sender=lambda frame: None)
            await asyncio.sleep(0.05)

    def _read(self, data: bytes) -> None:
        self.said += data
        self.receive(data)

    async def detect(self) -> Candidate | None:
        """Detect it, in a thread."""
        return await asyncio.to_thread(detect_slcan, self.terminal.port)


@pytest_asyncio.fixture
async def adapter() -> AsyncIterator[Adapter]:
    """An adapter on its own port."""
    adapter = Adapter()
    beating = asyncio.create_task(adapter.beat())
    yield adapter
    beating.cancel()
    adapter.terminal.close()


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adapter is on a machine that may be busy: it is given time to reply."""
    monkeypatch.setattr(reaching, "_REPLY_TIMEOUT", 5.0)


async def test_other_device_receives_two_characters(adapter: Adapter) -> None:
    """V and CR, whatever it replies."""
    for reply in (b"", b"?\r", b"Version 2\r", b"V10"):
        adapter.said = b""
        adapter.receive = lambda data, reply=reply: adapter.terminal.write(reply)  # type: ignore[misc]
        assert await adapter.detect() is None
        assert adapter.said == b"V\r"


@pytest.mark.usefixtures("patient")
async def test_adapter_without_listen_only_mode_is_not_opened(adapter: Adapter) -> None:
    """O is never sent."""
    usual = adapter.receive
    adapter.receive = lambda data: usual(data.replace(b"L\r", b"nonsense\r"))
    found = await adapter.detect()
    assert found is not None
    assert found.urls == ()
    assert "listen-only" in found.description
    assert b"O" not in adapter.said


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("is_probed", [True, False])
async def test_discover_probes_adapters_on_request_only(
    adapter: Adapter, is_probed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --slcan the port is named with its version and the nodes that beat there.

    It is opened by L alone and closed at the end, with not a frame of ours on the bus, and no other
    protocol is tried on it; without the option no such command goes out.
    """
    port = adapter.terminal.port
    monkeypatch.setattr("drivers.by_hand.reaching.comports", lambda: [ListPortInfo(port)])
    options = ["--slcan"] if is_probed else ["--no-probe"]
    arguments = ["amp", "discover", "--json", *options]
    result = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    assert result.exit_code == 0, result.output
    (place,) = [one for one in json.loads(result.stdout)["places"] if one["place"] == port]
    url = f"can+slcan://{port}?bitrate=500000#"
    assert place["heard"] == ([f"{url}1", f"{url}127"] if is_probed else [])
    assert ("slcan adapter 1013, heartbeats of nodes: 1, 127" in place["description"]) == is_probed
    async with asyncio.timeout(60.0):
        while True:
            if adapter.said == (SPOKEN if is_probed else b""):
                break
            await asyncio.sleep(0)
    assert {frame.id for frame in adapter.heard} == {can_id for can_id, _ in BEATS}
