"""A two-channel signal generator that speaks SCPI, for tests.

Written from IEEE 488.2 (program message units, common commands, event status, error queue),
SCPI-99 (headers with long and short forms, optional nodes, numeric suffixes, units, error numbers)
and the Keysight 33500B/33600A Operating and Service Guide (words, ranges, conflicts, phases).

Not modelled: what else that guide has, the rise of outputs, and the time that relays take.
"""

import asyncio
import re
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import numpy as np

from drivers import clock
from model.arrays import FloatArray

QUEUE = 20  # errors
NO_ERROR = (0, "No error")
OVERFLOW = (-350, "Queue overflow")
UNITS = {"": 1.0, "V": 1.0, "VPP": 1.0, "MVPP": 1e-3, "MV": 1e-3, "HZ": 1.0, "KHZ": 1e3, "DEG": 1.0}
ANGLES = {"DEG": 1.0, "RAD": 180 / np.pi}


@dataclass
class Output:
    """One channel; amplitude [V] peak to peak and offset [V] into 50 ohm; phase [degrees].

    origin [s]: when its phase generator was at zero.
    """

    is_on: bool = False
    function: str = "SIN"
    frequency: float = 1000.0
    amplitude: float = 0.1
    offset: float = 0.0
    phase: float = 0.0
    unit: str = "VPP"
    load: float = 50.0
    origin: float = 0.0

    @property
    def scale(self) -> float:
        """Voltage into its load per voltage into 50 ohm."""
        return 2.0 if np.isinf(self.load) else 2 * self.load / (self.load + 50.0)


@dataclass
class Generator:
    """The instrument; angle: unit of phases. log: program messages, as they came."""

    outputs: tuple[Output, Output] = field(default_factory=lambda: (Output(), Output()))
    angle: str = "DEG"
    errors: deque[tuple[int, str]] = field(default_factory=deque)
    event_status: int = 128  # power on
    event_enable: int = 0
    log: list[str] = field(default_factory=list)
    stuck_on: bool = False

    def voltage(self, channel: int, times: FloatArray) -> FloatArray:
        """Open-circuit voltage [V] of a channel (from 1) at times [s]."""
        output = self.outputs[channel - 1]
        if not output.is_on:
            return np.zeros(len(times))
        angle = 2 * np.pi * output.frequency * (times - output.origin) + np.radians(output.phase)
        return 2 * (output.offset + output.amplitude / 2 * np.sin(angle))

    def message(self, text: str) -> str | None:
        """Execute a program message; its response message, None without queries."""
        self.log.append(text)
        answers = []
        for unit in text.split(";"):
            answer = self._unit(unit.strip())
            if answer is not None:
                answers.append(answer)
            if self.errors and self.errors[-1][0] in range(-199, -99):
                break  # a command error discards the rest of the message
        return ";".join(answers) if answers else None

    def _unit(self, unit: str) -> str | None:
        header, _, argument = unit.partition(" ")
        argument = argument.strip().upper()
        for pattern, act in self._words():
            found = re.fullmatch(pattern, header.upper())
            if found:
                channel = int(found["n"] or 1) if "n" in found.groupdict() else 1
                if channel not in (1, 2):
                    self._fail(-114, "Header suffix out of range")
                    return None
                return act(self.outputs[channel - 1], argument)
        self._fail(-113, "Undefined header")
        return None

    def _words(self) -> list[tuple[str, Callable[[Output, str], str | None]]]:
        source = r":?(SOUR(CE)?(?P<n>\d*):)?"
        volt = rf"{source}VOLT(AGE)?(:LEV(EL)?)?(:IMM(EDIATE)?)?"
        output = r":?OUTP(UT)?(?P<n>\d*)(:STAT(E)?)?"
        load = r":?OUTP(UT)?(?P<n>\d*):LOAD"
        return [
            (
                r"\*IDN\?",
                lambda o, a: "Agilent Technologies,33522B,MY52800123,4.00-1.19-2.00-52-00",
            ),
            (r"\*CLS", self._clear),
            (r"\*RST", self._reset),
            (r"\*OPC\?", lambda o, a: "1"),
            (r"\*OPC", lambda o, a: self._event(1)),
            (r"\*WAI", lambda o, a: None),
            (r"\*ESR\?", self._read_events),
            (r"\*ESE", self._enable),
            (r"\*ESE\?", lambda o, a: f"{self.event_enable:+d}"),
            (r":?SYST(EM)?:ERR(OR)?(:NEXT)?\?", lambda o, a: self._next_error()),
            (rf"{output}", lambda o, a: self._switch(o, a)),
            (rf"{output}\?", lambda o, a: str(int(o.is_on))),
            (load, self._set_load),
            (rf"{load}\?", lambda o, a: "9.9E+37" if np.isinf(o.load) else f"{o.load:+.14E}"),
            (r":?UNIT:ANGL(E)?", self._set_angle),
            (rf"{source}FUNC(TION)?", self._set_function),
            (rf"{source}FUNC(TION)?\?", lambda o, a: o.function),
            (rf"{source}FREQ(UENCY)?", self._set_frequency),
            (rf"{source}FREQ(UENCY)?\?", lambda o, a: f"{o.frequency:+.14E}"),
            (rf"{volt}:UNIT", self._set_unit),
            (rf"{volt}:OFFS(ET)?", self._set_offset),
            (rf"{volt}(:AMPL(ITUDE)?)?", self._set_amplitude),
            (rf"{volt}(:AMPL(ITUDE)?)?\?", lambda o, a: f"{o.amplitude * o.scale:+.14E}"),
            (rf"{source}PHAS(E)?:SYNC(HRONIZE)?", lambda o, a: self._synchronize()),
            (rf"{source}PHAS(E)?", self._set_phase),
            (rf"{source}PHAS(E)?\?", lambda o, a: f"{o.phase / ANGLES[self.angle]:+.14E}"),
        ]

    def _fail(self, code: int, text: str) -> None:
        """Queue an error, and set its bit of the event status."""
        if len(self.errors) < QUEUE:
            self.errors.append((code, text))
        else:
            self.errors[-1] = OVERFLOW
        self._event({1: 32, 2: 16, 3: 8, 4: 4}[-code // 100])

    def _event(self, bit: int) -> None:
        self.event_status |= bit

    def _next_error(self) -> str:
        code, text = self.errors.popleft() if self.errors else NO_ERROR
        return f'{code:+d},"{text}"'

    def _clear(self, output: Output, argument: str) -> None:
        self.errors.clear()
        self.event_status = 0

    def _reset(self, output: Output, argument: str) -> None:
        self.outputs = (Output(), Output())
        self.angle = "DEG"

    def _read_events(self, output: Output, argument: str) -> str:
        found, self.event_status = self.event_status, 0
        return f"{found:+d}"

    def _enable(self, output: Output, argument: str) -> None:
        self.event_enable = int(argument)

    def _switch(self, output: Output, argument: str) -> None:
        if argument not in ("ON", "OFF", "1", "0"):
            return self._fail(-224, "Illegal parameter value")
        output.is_on = argument in ("ON", "1") or (output.is_on and self.stuck_on)
        return None

    def _set_load(self, output: Output, argument: str) -> None:
        is_infinite = argument in ("INF", "INFINITY")
        load = float("inf") if is_infinite else self._number(argument, 1.0, 10e3)
        if load is not None:
            output.load = load

    def _set_angle(self, output: Output, argument: str) -> None:
        if argument not in ANGLES:
            self._fail(-224, "Illegal parameter value")
        else:
            self.angle = argument

    def _set_function(self, output: Output, argument: str) -> None:
        if argument not in ("SIN", "SINUSOID"):
            self._fail(-224, "Illegal parameter value")

    def _set_unit(self, output: Output, argument: str) -> None:
        if argument not in ("VPP", "VRMS", "DBM"):
            return self._fail(-224, "Illegal parameter value")
        if argument == "DBM" and np.isinf(output.load):
            return self._fail(-221, "Settings conflict; dBm with infinite load")
        output.unit = argument
        return None

    def _set_frequency(self, output: Output, argument: str) -> None:
        found = self._number(argument, 1e-6, 30e6)
        if found is not None and found != output.frequency:
            # The phase accumulator goes on: where it stands is not known.
            output.frequency = found
            output.origin = clock.now() - 0.123 / found

    def _set_amplitude(self, output: Output, argument: str) -> None:
        if output.unit != "VPP":
            return self._fail(-221, "Settings conflict")
        most = min(10.0, 2 * (5.0 - abs(output.offset))) * output.scale
        found = self._number(argument, 1e-3 * output.scale, most)
        if found is not None:
            output.amplitude = found / output.scale
        return None

    def _set_offset(self, output: Output, argument: str) -> None:
        most = (5.0 - output.amplitude / 2) * output.scale
        found = self._number(argument, -most, most)
        if found is not None:
            output.offset = found / output.scale

    def _set_phase(self, output: Output, argument: str) -> None:
        most = 360.0 / ANGLES[self.angle]
        found = self._number(argument, -most, most)
        if found is not None:
            output.phase = found * ANGLES[self.angle]

    def _synchronize(self) -> None:
        """Reset the phase generators of both channels at one moment."""
        now = clock.now()
        for output in self.outputs:
            output.origin = now

    def _number(self, argument: str, low: float, high: float) -> float | None:
        """A decimal number with a unit, MIN or MAX, within its range; clipped beyond it."""
        if argument in ("MIN", "MINIMUM", "MAX", "MAXIMUM"):
            return low if argument.startswith("MIN") else high
        found = re.fullmatch(r"([+-]?\d*\.?\d+(?:E[+-]?\d+)?)\s*([A-Z]*)", argument)
        if found is None or found[2] not in UNITS:
            self._fail(-131 if found else -104, "Invalid suffix" if found else "Data type error")
            return None
        value = float(found[1]) * UNITS[found[2]]
        if value > high * (1 + 1e-12):
            self._fail(-222, "Data out of range; value clipped to upper limit")
            return high
        if value < low * (1 - 1e-12 if low > 0 else 1 + 1e-12):
            self._fail(-222, "Data out of range; value clipped to lower limit")
            return low
        return value


@asynccontextmanager
async def on_tcp(generator: Generator) -> AsyncIterator[int]:
    """Serve a generator over TCP; its port."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                answer = generator.message(line.decode("ascii").strip())
                if answer is not None:
                    writer.write(f"{answer}\n".encode("ascii"))
        finally:
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
