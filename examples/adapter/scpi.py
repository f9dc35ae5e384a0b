"""Two ERAs behind a two-channel signal generator that speaks SCPI over TCP.

    python examples/adapter/scpi.py 192.168.1.20:5025 --full-voltage 5

Prints the amplifier's URL. --full-voltage is the peak voltage at level 1, into an open circuit. The
force of an ERA is proportional to the square of its voltage, so the generator plays half the
frequency and the square root of the level. Commands: Keysight 33500B/33600A Operating and Service
Guide.
"""

import argparse
import asyncio
import math
import signal
import socket
import sys
from collections.abc import Callable

from adapter import REPLY_TIMEOUT, Adapter, Tone, watch

CHANNELS = (1, 2)
MIN_VPP, MAX_PEAK = 0.002, 10.0  # V, into an open circuit
OFF = ("OUTP1 OFF", "OUTP2 OFF", "OUTP1?", "OUTP2?")


class Generator:
    """A two-channel generator; full_voltage [V]: peak at level 1."""

    channels = len(CHANNELS)

    def __init__(self, host: str, port: int, full_voltage: float) -> None:
        if not MIN_VPP < full_voltage <= MAX_PEAK:
            raise ValueError(f"full voltage must be up to {MAX_PEAK:g} V, got {full_voltage:g} V")
        self._address = (host, port)
        self._full_voltage = full_voltage
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._requested: dict[int, Tone | None] = {}
        self._playing: dict[int, Tone | None] = {}
        self._number = 0

    def play(self, channel: int, tone: Tone | None) -> None:
        """Store the tone of a channel; None for silence."""
        self._requested[channel] = tone

    async def send(self) -> None:
        """Set frequencies, voltages and phases; tones start together unless one continues.

        PHAS:SYNC restarts both channels, so it is not sent while a tone continues.
        """
        commands: list[str] = []
        for channel, tone in self._requested.items():
            if tone is None:
                commands.append(f"OUTP{channel + 1} OFF")
            else:
                commands += self._commands_for(channel, tone)
        tones = {**self._playing, **self._requested}
        has_new_tone = any(self._is_new(*item) for item in self._requested.items())
        has_continuing_tone = any(self._continues(*item) for item in tones.items())
        if has_new_tone and not has_continuing_tone:
            commands += ["*WAI", "SOUR1:PHAS:SYNC"]
        await self._checked(*commands)
        self._requested = {}
        self._playing = tones

    def _commands_for(self, channel: int, tone: Tone) -> list[str]:
        """Return the commands that play a tone on a channel."""
        source = f"SOUR{channel + 1}"
        commands = []
        if self._is_new(channel, tone):
            commands.append(f"{source}:FREQ {tone.frequency / 2:.10g}")
        vpp = max(2 * self._full_voltage * math.sqrt(tone.amplitude), MIN_VPP)
        # The square of U sin(x/2 + 45°) is U²/2 (1 + sin x).
        angle = (tone.phase + 90) / 2
        commands.append(f"{source}:VOLT {vpp:.6g}")
        commands.append(f"{source}:PHAS {angle:.6g}")
        commands.append(f"OUTP{channel + 1} ON")
        return commands

    def _continues(self, channel: int, tone: Tone | None) -> bool:
        """Whether a channel already plays the frequency of a tone."""
        playing = self._playing.get(channel)
        if tone is None or playing is None:
            return False
        return playing.frequency == tone.frequency

    def _is_new(self, channel: int, tone: Tone | None) -> bool:
        """Whether a tone changes the frequency of its channel."""
        return tone is not None and not self._continues(channel, tone)

    async def silence(self) -> None:
        """Connect, switch both outputs off, and set up sines in volts and degrees."""
        self.disconnect()
        self._streams = await asyncio.open_connection(*self._address)
        self._requested = {}
        self._playing = {}
        if await self._request(*OFF) != ["0", "0"]:
            raise ValueError("the outputs must be off")
        commands = ["*CLS", "UNIT:ANGL DEG"]
        for n in CHANNELS:
            commands += [f"OUTP{n}:LOAD INF", f"SOUR{n}:FUNC SIN", f"SOUR{n}:VOLT:UNIT VPP"]
            commands += [f"SOUR{n}:VOLT MIN", f"SOUR{n}:VOLT:OFFS 0"]
        await self._checked(*commands)

    def silence_now(self) -> None:
        """Switch both outputs off over a separate connection, without an event loop."""
        with socket.create_connection(self._address, REPLY_TIMEOUT) as line:
            line.sendall(f":{';:'.join(OFF)}\n".encode())
            if line.recv(64).split() != [b"0;0"]:
                raise ValueError("the outputs must be off")

    def disconnect(self) -> None:
        """Close the connection."""
        if self._streams is not None:
            self._streams[1].close()
        self._streams = None

    async def _checked(self, *commands: str) -> None:
        """Send commands; if the generator reports an error, switch off and raise ValueError."""
        error = (await self._request(*commands, "*OPC?", "SYST:ERR?"))[-1]
        if int(error.split(",")[0]):
            await self._request("*CLS", *OFF)
            raise ValueError(f"the generator reports {error}")

    async def _request(self, *commands: str) -> list[str]:
        """Send commands in one line; return the replies to the queries among them.

        IEEE 488.2 does not number replies. Each line therefore sets and reads the otherwise unused
        register *ESE, so that a late reply to an earlier line is recognized.
        """
        if self._streams is None:
            raise ConnectionError("not connected")
        reader, writer = self._streams
        self._number = self._number % 255 + 1
        line = ";".join(name if name[0] == "*" else f":{name}" for name in commands)
        writer.write(f"*ESE {self._number};*ESE?;{line}\n".encode())
        while reply := (await reader.readline()).decode("ascii"):
            number, *answers = reply.strip().split(";")
            if int(number) == self._number:
                return answers
        raise ConnectionError("the generator has closed the connection")


async def serve(name: str, generator: Generator, heartbeat: Callable[[bytes], None]) -> None:
    """Run until Ctrl-C."""
    adapter = Adapter(name, generator, heartbeat)
    print(f"serial://{adapter.port}", flush=True)
    running = asyncio.ensure_future(adapter.run())
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, running.cancel)
    await asyncio.wait([running])
    generator.disconnect()
    if not running.cancelled():
        running.result()


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description="Use a signal generator as an amplifier.")
    parser.add_argument("address", help="HOST:PORT of the generator")
    parser.add_argument("--full-voltage", type=float, default=5.0, help="peak at level 1 [V]")
    options = parser.parse_args()
    host, _, port = options.address.partition(":")
    try:
        generator = Generator(host, int(port or 5025), options.full_voltage)
    except ValueError as error:
        parser.error(str(error))
    try:
        asyncio.run(serve(options.address, generator, watch(generator.silence_now)))
    except OSError as error:
        sys.exit(f"ended: {error!r}; the watchdog process continues until the outputs are off")


if __name__ == "__main__":
    main()
