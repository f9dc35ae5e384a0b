"""The example amplifier on a virtual clock: watchdog, validity, damaged bytes, conformance."""

import asyncio
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from conformance_bench import results_at
from drivers.conformance import CheckResult, Result
from memory_machine import live_in_memory
from virtual_loop import run_virtual

ROOT = Path(__file__).parents[2]
WIRE_PAGE = (ROOT / "docs" / "reference" / "wire-protocol.md").read_text("utf-8")
WATCHDOG, SESSION = 250, 9
WRONG_STATE = 5


@pytest.fixture
def serial(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module of its serial end, imported from its folder."""
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "amplifier"))
    import on_a_serial_line

    yield on_a_serial_line
    for name in ("on_a_serial_line", "amplifier"):
        del sys.modules[name]


def frame_of(name: str) -> bytes:
    """The bytes of an example on the wire page."""
    (text,) = re.findall(rf"^{name}: `([0-9A-F ]+)`$", WIRE_PAGE, re.MULTILINE)
    return bytes.fromhex(text)


def amplifier_at(serial: ModuleType, now: list[float]) -> Any:
    """An amplifier with a clock at now [ms]."""
    return serial.Amplifier(clock=lambda: now[0])


def test_amplifier_is_silent_5_ms_after_its_watchdog_expired(serial: ModuleType) -> None:
    """Levels fall along a raised cosine from its expiry, however late read; the fault latches."""
    now = [1000.0]
    amplifier = amplifier_at(serial, now)
    amplifier.arm(WATCHDOG, SESSION)
    amplifier.apply(SESSION, 1, 0, 0, [(0, 0, 2200, 10000, 0), (3, 0, 2200, 5000, 0)])
    for after, share in ((-0.1, 1.0), (1.25, (1 + math.cos(math.pi / 4)) / 2), (2.5, 0.5)):
        now[0] = 1000.0 + WATCHDOG + after
        amplifier.update()
        assert amplifier.levels == [round(10000 * share), 0, 0, round(5000 * share)]
    now[0] = 1000.0 + WATCHDOG + 5
    amplifier.update()
    assert amplifier.levels == [0, 0, 0, 0]
    assert (amplifier.state, amplifier.fault) == (7, 1)
    assert not amplifier.high_voltage
    with pytest.raises(serial.Refused) as refused:
        amplifier.arm(WATCHDOG, SESSION + 1)
    assert refused.value.code == WRONG_STATE


def test_amplifier_ends_a_set_after_its_validity(serial: ModuleType) -> None:
    """valid_for counts from the commit, and the amplifier stays armed."""
    now = [0.0]
    amplifier = amplifier_at(serial, now)
    amplifier.arm(2000, SESSION)
    amplifier.apply(SESSION, 1, 10, 100, [(0, 0, 2200, 10000, 0)])
    now[0] = 105.0
    amplifier.update()
    assert amplifier.levels == [5000, 0, 0, 0]
    now[0] = 111.0
    amplifier.update()
    assert amplifier.levels == [0, 0, 0, 0]
    assert amplifier.state == 4


def test_serial_end_replies_to_the_frames_of_the_page(serial: ModuleType) -> None:
    """Whole and byte by byte; the refusal byte for byte."""
    end = serial.SerialEnd()
    assert end.take(frame_of("Commit request")) != b""
    reply = end.take(frame_of("Refused Apply request"))  # disarmed: WRONG_STATE
    assert serial.unstuff(reply[1:-1])[:8] == bytes.fromhex("9F 02 01 07 00 07 05 FF")
    assert end.take(frame_of("LoadEnvelope request")) != b""
    stop = frame_of("Stop request")
    assert b"".join(end.take(bytes([byte])) for byte in stop) != b""
    assert end.amplifier.state == 5


def test_serial_end_ignores_damaged_frames(serial: ModuleType) -> None:
    """A Stop with a byte changed or cut short, and overlong data; then a valid one works."""
    end = serial.SerialEnd()
    stop = frame_of("Stop request")
    for place in range(1, len(stop) - 1):
        for change in (0x01, 0x80, 0xFF):
            damaged = bytearray(stop)
            damaged[place] ^= change
            assert end.take(bytes(damaged)) == b""
        assert end.take(stop[:place] + b"\0") == b""
    assert end.take(b"\x07" * 10_000 + b"\0") == b""
    assert end.amplifier.state == 1
    assert end.take(stop) != b""
    assert end.amplifier.state == 5


def test_serial_end_obeys_only_stop_and_commit_as_broadcasts(
    serial: ModuleType,
) -> None:
    """Other requests to address 0 are dropped."""
    end = serial.SerialEnd()
    assert end.take(serial.framed(serial.ARM, 2, 0, 1, b"\xfa\0\x09\0")) == b""
    assert end.amplifier.state == 1
    assert end.take(serial.framed(serial.STOP, 2, 0, 1, bytes(2))) == b""
    assert end.amplifier.state == 5


@pytest.mark.long
def test_serial_end_passes_conformance(serial: ModuleType) -> None:
    """Every check on a line in memory; skipped are those of what it has not."""

    async def run() -> list[CheckResult]:
        clock = asyncio.get_running_loop().time
        end = serial.SerialEnd()
        end.amplifier = type(end.amplifier)(clock=lambda: 1000 * clock())
        terminal = live_in_memory().make_terminal(
            lambda data: terminal.write(end.take(data)), unpluggable=False
        )
        return await results_at(f"serial://{terminal.port}")

    results = run_virtual(run())
    assert {one.check.name: one.problem for one in results if one.problem} == {}
    assert sum(one.result is Result.PASSED for one in results) > 40
