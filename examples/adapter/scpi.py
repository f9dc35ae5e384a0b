"""Two ERAs behind a two-channel signal generator that speaks SCPI over TCP.

    python examples/adapter/scpi.py 192.168.1.20:5025 --full-voltage 5

It prints the URL of the amplifier. full voltage [V]: the peak at level 1, into an open circuit. The
force of an ERA is proportional to the square of the voltage, so half the frequency and the square
root of the level are played. The commands are those of the Keysight 33500B/33600A Operating and
Service Guide.
"""

import argparse
import asyncio
import math
import signal
import socket
import sys
from collections.abc import Callable

from adapter import REPLY, Adapter, Tone, watch

CHANNELS = (1, 2)
MIN_VPP, MAX_PEAK = 0.002, 10.0  # V, into an open circuit
OFF = ("OUTP1 OFF", "OUTP2 OFF", "OUTP1?", "OUTP2?")


class Generator:
    """The instrument at an address; full [V]: peak at level 1."""

    channels = len(CHANNELS)

    def __init__(self, host: str, port: int, full: float) -> None:
        if not MIN_VPP < full <= MAX_PEAK:
            raise ValueError(f"full voltage must be up to {MAX_PEAK:g} V, got {full:g} V")
        self._address, self._full = (host, port), full
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._requested: dict[int, Tone | None] = {}
        self._playing: dict[int, Tone | None] = {}
        self._number = 0

    def play(self, channel: int, tone: Tone | None) -> None:
        """Note the tone of a channel, None for silence."""
        self._requested[channel] = tone

    async def send(self) -> None:
        """Set frequencies, voltages and phases; tones start together unless one continues.

        PHAS:SYNC restarts both channels, so it is not sent while a tone continues.
        """
        words, starts = [], False
        for channel, tone in self._requested.items():
            source, before = f"SOUR{channel + 1}", self._playing.get(channel)
            if tone is None:
                words.append(f"OUTP{channel + 1} OFF")
                continue
            if before is None or before.frequency != tone.frequency:
                words.append(f"{source}:FREQ {tone.frequency / 2:.10g}")
                starts = True
            vpp = max(2 * self._full * math.sqrt(tone.amplitude), MIN_VPP)
            # U sin(x/2 + 45°) squared is half of U squared times 1 + sin x.
            angle = (tone.phase + 90) / 2
            words += [f"{source}:VOLT {vpp:.6g}", f"{source}:PHAS {angle:.6g}"]
            words.append(f"OUTP{channel + 1} ON")
        now = {**self._playing, **self._requested}
        goes_on = any(
            tone is not None
            and (old := self._playing.get(channel)) is not None
            and old.frequency == tone.frequency
            for channel, tone in now.items()
        )
        if starts and not goes_on:
            words += ["*WAI", "SOUR1:PHAS:SYNC"]
        await self._checked(*words)
        self._requested, self._playing = {}, now

    async def silence(self) -> None:
        """Connect, switch both outputs off, and set up sines in volts and degrees."""
        self.disconnect()
        self._streams = await asyncio.open_connection(*self._address)
        self._requested, self._playing = {}, {}
        if await self._request(*OFF) != ["0", "0"]:
            raise ValueError("the outputs must be off")
        words = ["*CLS", "UNIT:ANGL DEG"]
        for n in CHANNELS:
            words += [f"OUTP{n}:LOAD INF", f"SOUR{n}:FUNC SIN", f"SOUR{n}:VOLT:UNIT VPP"]
            words += [f"SOUR{n}:VOLT MIN", f"SOUR{n}:VOLT:OFFS 0"]
        await self._checked(*words)

    def silence_now(self) -> None:
        """Switch both outputs off over a connection of its own, without an event loop."""
        with socket.create_connection(self._address, REPLY) as line:
            line.sendall(f":{';:'.join(OFF)}\n".encode())
            if line.recv(64).split() != [b"0;0"]:
                raise ValueError("the outputs must be off")

    def disconnect(self) -> None:
        """End the connection."""
        if self._streams is not None:
            self._streams[1].close()
        self._streams = None

    async def _checked(self, *words: str) -> None:
        """Send commands; raises ValueError if the instrument reports an error, with outputs off."""
        error = (await self._request(*words, "*OPC?", "SYST:ERR?"))[-1]
        if int(error.split(",")[0]):
            await self._request("*CLS", *OFF)
            raise ValueError(f"the generator reports {error}")

    async def _request(self, *words: str) -> list[str]:
        """Send commands in one line; returns the replies to its queries.

        Replies have no number in IEEE 488.2: the register *ESE, which nothing else uses, identifies
        a late one.
        """
        if self._streams is None:
            raise ConnectionError("not connected")
        reader, writer = self._streams
        self._number = self._number % 255 + 1
        line = ";".join(word if word[0] == "*" else f":{word}" for word in words)
        writer.write(f"*ESE {self._number};*ESE?;{line}\n".encode())
        while reply := (await reader.readline()).decode("ascii"):
            number, *answers = reply.strip().split(";")
            if int(number) == self._number:
                return answers
        raise ConnectionError("the generator has closed the connection")


async def serve(name: str, generator: Generator, sign: Callable[[bytes], None]) -> None:
    """Run until Ctrl-C."""
    adapter = Adapter(name, generator, sign)
    print(f"serial://{adapter.port}", flush=True)
    running = asyncio.ensure_future(adapter.run())
    for ending in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(ending, running.cancel)
    await asyncio.wait([running])
    generator.disconnect()
    if not running.cancelled():
        running.result()


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description="An amplifier in front of a signal generator.")
    parser.add_argument("address", help="HOST:PORT of the generator")
    parser.add_argument("--full-voltage", type=float, default=5.0, help="peak at level 1 [V]")
    given = parser.parse_args()
    host, _, port = given.address.partition(":")
    try:
        generator = Generator(host, int(port or 5025), given.full_voltage)
    except ValueError as error:
        parser.error(str(error))
    try:
        asyncio.run(serve(given.address, generator, watch(generator.silence_now)))
    except OSError as error:
        sys.exit(f"ended: {error!r}; the other process goes on until the outputs are off")


if __name__ == "__main__":
    main()
