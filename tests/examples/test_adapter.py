"""The adapter and its signal generator: a host, a pseudo-terminal, and the instrument over TCP."""

import asyncio
import os
import re
import signal
import sys
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from dataclasses import dataclass
from pathlib import Path
from subprocess import PIPE, Popen

import numpy as np
import pytest

import era_haptics
from drivers.errors import CommandRefused, LinkError
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import FAULTS, STATES
from processes.patient_daemon import LONG_WATCHDOG
from registry import threads
from registry.limits import GuardLimits

RANGES = {"FREQ": (1e-6, 30e6), "VOLT": (0.002, 20.0), "VOLT:OFFS": (-10.0, 10.0)}
"""Of frequency [Hz] and voltages [V] into an open circuit; phases are of any angle."""
NUMBERS = {"FREQ": "frequency", "VOLT": "amplitude", "VOLT:OFFS": "offset", "PHAS": "phase"}


@dataclass
class Output:
    """One channel; amplitude [V] peak to peak and offset [V] into an open circuit; phase [degrees].

    origin [s]: when its phase generator was at zero.
    """

    is_on: bool = False
    frequency: float = 1000.0
    amplitude: float = 0.2
    offset: float = 0.0
    phase: float = 0.0
    origin: float = 0.0


class Instrument:
    """The signal generator, which may stop replying; log: program messages, as they came."""

    def __init__(self) -> None:
        self.outputs = Output(), Output()
        self.errors: deque[tuple[int, str]] = deque()
        self.event_enable, self.is_mute = 0, False
        self.log: list[str] = []
        self._heard = asyncio.Event()

    @property
    def is_silent(self) -> bool:
        """Whether both outputs are off."""
        return not any(output.is_on for output in self.outputs)

    async def until_silent(self) -> None:
        """Wait until both outputs are off."""
        await self._until(lambda: self.is_silent)

    async def until_switched_on(self) -> None:
        """Wait until an output has been switched on, even if it is off again."""
        await self._until(lambda: any("OUTP1 ON" in line for line in self.log))

    async def _until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not condition():
                self._heard.clear()
                await self._heard.wait()

    def force(self, channel: int, frequency: float) -> complex:
        """Amplitude and phase at a frequency [Hz] of a channel's squared voltage, 1 for full.

        Channels are numbered from 1.
        """
        output = self.outputs[channel - 1]
        times = np.arange(10_000) / 10_000.0 + max(output.origin for output in self.outputs)
        angle = 2 * np.pi * output.frequency * (times - output.origin) + np.radians(output.phase)
        voltage = output.is_on * (output.offset + output.amplitude / 2 * np.sin(angle))
        wave = np.exp(-2j * np.pi * frequency * (times - times[0]))
        return complex(2 * np.mean(voltage**2 * wave) / (FULL**2 / 2) * 1j)

    def message(self, text: str) -> str | None:
        """Execute a program message unless mute; its response message, None without queries."""
        self._heard.set()
        if self.is_mute:
            return None
        self.log.append(text)
        answers = []
        for unit in text.split(";"):
            header, _, argument = unit.strip().lstrip(":").partition(" ")
            if header.endswith("?"):
                answers.append(self._asked(header))
            elif not self._told(header, argument):
                self.errors.append((-113, f"Undefined header or parameter; {unit}"))
                break  # a command error discards the rest of the message
        return ";".join(answers) if answers else None

    def _asked(self, header: str) -> str:
        if header == "SYST:ERR?":
            code, text = self.errors.popleft() if self.errors else (0, "No error")
            return f'{code:+d},"{text}"'
        if match := re.fullmatch(r"OUTP([12])\?", header):
            return str(int(self.outputs[int(match[1]) - 1].is_on))
        return {"*OPC?": "1", "*ESE?": f"{self.event_enable:+d}"}[header]

    def _told(self, header: str, argument: str) -> bool:
        """Whether a command is known, and carried out."""
        if header == "*ESE":
            self.event_enable = int(argument)
        elif header == "*CLS":
            self.errors.clear()
        elif header == "SOUR1:PHAS:SYNC":
            self.outputs[0].origin = self.outputs[1].origin = threads.now()
        elif match := re.fullmatch(r"(?:SOUR|OUTP)([12]):?(.*)", header):
            return self._set(self.outputs[int(match[1]) - 1], match[2], argument)
        else:
            return (header, argument) in (("*WAI", ""), ("UNIT:ANGL", "DEG"))
        return True

    def _set(self, output: Output, parameter: str, argument: str) -> bool:
        set_up = {"LOAD": "INF", "FUNC": "SIN", "VOLT:UNIT": "VPP"}
        if parameter in set_up:
            return argument == set_up[parameter]
        if parameter == "" and argument in ("ON", "OFF"):
            output.is_on = argument == "ON"
            return True
        low, high = RANGES.get(parameter, (-360.0, 360.0))
        value = low if argument == "MIN" else float(argument)
        if not low <= value <= high:
            self.errors.append((-222, "Data out of range; value clipped"))
        value = min(max(value, low), high)
        if parameter == "FREQ" and value != output.frequency:
            # The phase accumulator goes on: where it stands is not known.
            output.origin = threads.now() - 0.123 / value
        if parameter in NUMBERS:
            setattr(output, NUMBERS[parameter], value)
        return parameter in NUMBERS


SCRIPT = Path(era_haptics.__file__).parents[1] / "examples" / "adapter" / "scpi.py"
LIMITS = GuardLimits(20.0, 900.0, 1.0)
FULL = 5.0  # V
PATIENCE = 60.0  # s
pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("unhurried")]
PATIENT = f"""
import runpy, sys
import pytest
from processes.patient_daemon import allow_long_watchdogs
allow_long_watchdogs(pytest.MonkeyPatch())
sys.path[:0] = [{str(SCRIPT.parent)!r}]
import adapter
adapter.REPLY_TIMEOUT, adapter.STALL_TIMEOUT = 5.0, 10.0
runpy.run_path({str(SCRIPT)!r}, run_name="__main__")
"""
"""The adapter, which waits longer for its instrument, its host and its watcher for it."""


async def ended(running: Popen[bytes]) -> int:
    """Wait until a program has ended; its status."""
    return await asyncio.to_thread(running.wait, PATIENCE)


@asynccontextmanager
async def driven() -> AsyncIterator[tuple[Instrument, Popen[bytes], str]]:
    """The instrument on TCP, the adapter in front of it, and its URL."""
    instrument = Instrument()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with closing(writer):
            while line := await reader.readline():
                answer = instrument.message(line.decode("ascii").strip())
                if answer is not None:
                    writer.write(f"{answer}\n".encode("ascii"))

    with closing(await asyncio.start_server(serve, "127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
        program = [sys.executable, "-c", PATIENT, address]
        path = os.pathsep.join(sys.path)
        with Popen(program, stdout=PIPE, env=os.environ | {"PYTHONPATH": path}) as running:  # noqa: ASYNC220
            try:
                url = await asyncio.to_thread(running.stdout.readline)
                yield instrument, running, url.decode().strip()
            finally:
                instrument.is_mute = False
                running.send_signal(signal.SIGCONT)
                running.terminate()
                await ended(running)
                await instrument.until_silent()  # whatever became of it


@asynccontextmanager
async def armed(
    url: str, watchdog: float = LONG_WATCHDOG
) -> AsyncIterator[tuple[Group, Amplifier]]:
    """A host that has armed the adapter."""
    lines = Lines()
    try:
        host = await lines.amplifier(url, LIMITS, name="a", is_output=True)
        group = Group({"a": host}, watchdog=watchdog)
        async with asyncio.timeout(PATIENCE):
            while True:  # until the adapter has found the outputs off
                await group.open()
                try:
                    await group.arm()
                    break
                except CommandRefused:
                    continue
        yield group, host
    finally:
        await lines.close()


@asynccontextmanager
async def playing(
    watchdog: float = LONG_WATCHDOG,
) -> AsyncIterator[tuple[Instrument, Popen[bytes], Group, Amplifier]]:
    """The instrument and the adapter, driven by a host whose set is heard."""
    async with driven() as (instrument, program, url), armed(url, watchdog) as (group, host):
        await group.apply({"a": [layer(0.5)]})
        await instrument.until_switched_on()
        yield instrument, program, group, host


def layer(level: float, *, ramp: float = 0.0, keep_phase: bool = False) -> AmplifierLayer:
    """Two tones of 100 Hz, the second at full level and 120 degrees behind."""
    first = AmplifierTone(0, 100.0, level, 30.0, keep_phase=keep_phase)
    return AmplifierLayer(
        0, (first, AmplifierTone(1, 100.0, 1.0, -90.0, keep_phase=keep_phase)), ramp
    )


async def state(host: Amplifier, name: str) -> None:
    """Wait until a status has a state, and silence."""
    async with asyncio.timeout(PATIENCE):
        while True:
            status = await host.read_status()
            if status["state"] == STATES[name] and not any(status["levels"]):
                return


async def failing(group: Group, layer: AmplifierLayer) -> None:
    """Play until that fails."""
    async with asyncio.timeout(PATIENCE):
        await group.apply({"a": [layer]})
        while True:
            await group.beat()


async def test_force_is_that_of_the_set_and_follows_it() -> None:
    """A quarter of the force is half the voltage, at half the frequency; then along a ramp.

    A stop has switched the outputs off at the moment at which the host takes it for confirmed.
    """
    async with driven() as (instrument, _, url), armed(url) as (group, host):
        await group.apply({"a": [layer(0.25)]})
        async with asyncio.timeout(PATIENCE):
            while abs(instrument.force(2, 100.0)) < 0.9:
                await host.read_status()
        first, second = instrument.force(1, 100.0), instrument.force(2, 100.0)
        assert (abs(first), abs(second)) == pytest.approx((0.25, 1.0), rel=1e-3)
        assert np.degrees(np.angle(first / second)) == pytest.approx(120.0, abs=0.1)
        log_length = len(instrument.log)
        await group.apply({"a": [layer(0.64, ramp=1.0, keep_phase=True)]})
        async with asyncio.timeout(PATIENCE):
            while abs(instrument.force(1, 100.0)) < 0.6399:
                await host.read_status()
        followed = instrument.log[log_length:]
        assert sum("SOUR1:VOLT" in command for command in followed) > 2
        assert "PHAS:SYNC" not in "".join(followed)
        assert np.degrees(np.angle(instrument.force(1, 100.0) / second)) == pytest.approx(
            120.0, abs=0.1
        )
        assert (await group.stop())["a"].is_confirmed
        assert instrument.is_silent


async def test_watchdog_switches_the_outputs_off() -> None:
    """A second without a heartbeat."""
    async with playing(1.0) as (instrument, _, _group, host):
        await instrument.until_silent()
        await state(host, "FAULT")
        assert (await host.read_status())["fault"] == FAULTS["WATCHDOG"]


async def test_mute_instrument_is_never_reported_silent() -> None:
    """It trips, no stop is confirmed; once the instrument replies again it is switched off."""
    async with playing() as (instrument, _, group, _host):
        instrument.is_mute = True
        with pytest.raises((CommandRefused, LinkError)):
            await failing(group, layer(0.3))
        assert not (await group.stop())["a"].is_confirmed
        assert not instrument.is_silent
        with pytest.raises(CommandRefused):
            await group.arm()
        instrument.is_mute = False
        # By the adapter, or by its watcher if this machine has stalled the adapter.
        await instrument.until_silent()


@pytest.mark.parametrize("signal_number", [signal.SIGKILL, signal.SIGSTOP])
async def test_ended_or_stalled_adapter_is_silenced_by_its_watcher(
    signal_number: signal.Signals,
) -> None:
    """Killed or paused while it plays; one that was paused ends when it goes on."""
    async with playing() as (instrument, program, _group, _host):
        program.send_signal(signal_number)
        await instrument.until_silent()
        if signal_number is signal.SIGSTOP:
            program.send_signal(signal.SIGCONT)
        assert await ended(program) != 0


async def test_instrument_that_reports_an_error_is_switched_off() -> None:
    """An error in its queue, here one that a person at the front panel has caused."""
    async with playing() as (instrument, _, group, host):
        instrument.errors.append((-222, "Data out of range"))
        with pytest.raises((CommandRefused, LinkError)):
            await failing(group, layer(0.3))
        await state(host, "FAULT")
        assert instrument.is_silent
