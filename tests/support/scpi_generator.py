"""A two-channel signal generator that speaks the words of SCPI that the adapter uses, for tests.

Written from IEEE 488.2 (program message units, common commands, error queue), SCPI-99 (numeric
suffixes, error numbers) and the Keysight 33500B/33600A Operating and Service Guide (words, ranges,
phases). Any other word is an error.
"""

import asyncio
import re
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import numpy as np

from drivers import clock
from model.arrays import FloatArray

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


@dataclass
class Generator:
    """The instrument; log: program messages, as they came."""

    outputs: tuple[Output, Output] = field(default_factory=lambda: (Output(), Output()))
    errors: deque[tuple[int, str]] = field(default_factory=deque)
    event_enable: int = 0
    log: list[str] = field(default_factory=list)

    def voltage(self, channel: int, times: FloatArray) -> FloatArray:
        """Open-circuit voltage [V] of a channel (from 1) at times [s]."""
        output = self.outputs[channel - 1]
        if not output.is_on:
            return np.zeros(len(times))
        angle = 2 * np.pi * output.frequency * (times - output.origin) + np.radians(output.phase)
        return output.offset + output.amplitude / 2 * np.sin(angle)

    def message(self, text: str) -> str | None:
        """Execute a program message; its response message, None without queries."""
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
        if found := re.fullmatch(r"OUTP([12])\?", header):
            return str(int(self.outputs[int(found[1]) - 1].is_on))
        return {"*OPC?": "1", "*ESE?": f"{self.event_enable:+d}"}[header]

    def _told(self, header: str, argument: str) -> bool:
        """Whether a command is known, and carried out."""
        if header == "*ESE":
            self.event_enable = int(argument)
        elif header == "*CLS":
            self.errors.clear()
        elif header == "SOUR1:PHAS:SYNC":
            self.outputs[0].origin = self.outputs[1].origin = clock.now()
        elif found := re.fullmatch(r"(?:SOUR|OUTP)([12]):?(.*)", header):
            return self._set(self.outputs[int(found[1]) - 1], found[2], argument)
        else:
            return (header, argument) in (("*WAI", ""), ("UNIT:ANGL", "DEG"))
        return True

    def _set(self, output: Output, what: str, argument: str) -> bool:
        set_up = {"LOAD": "INF", "FUNC": "SIN", "VOLT:UNIT": "VPP"}
        if what in set_up:
            return argument == set_up[what]
        if what == "" and argument in ("ON", "OFF"):
            output.is_on = argument == "ON"
            return True
        low, high = RANGES.get(what, (-360.0, 360.0))
        value = low if argument == "MIN" else float(argument)
        if not low <= value <= high:
            self.errors.append((-222, "Data out of range; value clipped"))
        value = min(max(value, low), high)
        if what == "FREQ" and value != output.frequency:
            # The phase accumulator goes on: where it stands is not known.
            output.origin = clock.now() - 0.123 / value
        if what in NUMBERS:
            setattr(output, NUMBERS[what], value)
        return what in NUMBERS


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
