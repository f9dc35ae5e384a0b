"""The far end of the latency benchmark: simulated amplifiers, a wire to each, and a clock.

    python -m benchmarks.latency.far_end RIG FILE WIRE

WIRE: `pty`, a pseudo-terminal, or `tcp`, as to a serial server. Prints the URLs of the amplifiers
in the order of the rig. On SIGUSR1 it writes a JSON line for each Set and Commit frame, with
arrival on CLOCK_MONOTONIC, amplifier, type, number and payload, and prints "written". There is no
plate.
"""

import asyncio
import gc
import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

from drivers.codec.serial_line.frame import Frame, FrameReader
from drivers.protocol.table import MESSAGES
from model.rig.file import load_rig
from sim.amplifier.contract import Amplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.pseudo_terminal import make_terminal

SETS = tuple(MESSAGES[name].number for name in ("Set", "Commit"))
BAUD = 921_600


class Wire(asyncio.Protocol):
    """A wire to the daemon; on_data: called with received bytes. `send` sends once it is open."""

    def __init__(self, on_data: Callable[[bytes], None]) -> None:
        self.write: Callable[[bytes], object] = len  # until it is open
        self._on_data = on_data

    async def open_terminal(self) -> str:
        """Open a pseudo-terminal and return its URL."""
        terminal = make_terminal(self._on_data)
        terminal.listen()
        self.write = terminal.write
        return f"serial://{terminal.port}?baud={BAUD}"

    async def open_server(self) -> str:
        """Open a TCP port on the loopback for one connection and return its URL."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: self, "127.0.0.1", 0)
        return f"serial+tcp://127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    def send(self, data: bytes) -> None:
        """Send bytes to the daemon."""
        self.write(data)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The daemon has connected."""
        self.write = cast(asyncio.Transport, transport).write

    def data_received(self, data: bytes) -> None:
        """Bytes of the daemon."""
        self._on_data(data)


async def open_amplifier(name: str, kind: str, seen: list[tuple[int, str, Frame]]) -> str:
    """Serve an amplifier on a wire of a kind, note its sets, and return its URL."""
    reader = FrameReader()

    def arrived(data: bytes) -> None:
        now = time.monotonic_ns()
        seen.extend((now, name, frame) for frame in reader.feed(data) if frame.kind in SETS)
        end.receive(data, now * 1e-9)

    wire = Wire(arrived)
    end = SerialAmplifiers({1: Amplifier(name, channels=4)}, wire.send)
    return await (wire.open_terminal() if kind == "pty" else wire.open_server())


async def main() -> None:
    seen: list[tuple[int, str, Frame]] = []
    names = load_rig(Path(sys.argv[1])).amplifiers
    urls = [await open_amplifier(name, sys.argv[3], seen) for name in names]

    def write() -> None:
        with Path(sys.argv[2]).open("w", encoding="utf-8") as stream:
            for when, name, frame in seen:
                line = json.dumps([when, name, frame.kind, frame.sequence, frame.payload.hex()])
                stream.write(f"{line}\n")
        print("written", flush=True)

    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, write)
    gc.collect()
    gc.freeze()
    gc.disable()  # nothing becomes garbage
    print(*urls, flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
