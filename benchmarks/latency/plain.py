"""The baseline: the same exchange with asyncio alone.

    python -m benchmarks.latency.plain RIG URL SOCKET

python-osc reads the touch, its position selects a pre-encoded set, and the set is sent without
waiting for the reply to the one before. Nothing is checked, no finger is kept quiet. Lines of JSON
from the flood are parsed. Prints the UDP port; the sequence of a set is the number of its touch.
"""

import asyncio
import contextlib
import gc
import json
import os
import socket
import sys
from pathlib import Path
from urllib.parse import urlsplit

import serial
from pythonosc.osc_packet import OscPacket

from benchmarks.wires.bench import SESSION, make_sets
from drivers.codec.serial_line.exchanges import encode_request
from drivers.codec.serial_line.frame import encode_frame
from drivers.protocol.messages import Apply, Arm
from drivers.urls.serial_line import SerialUrl
from sim.amplifier.amplifier import capabilities

SETS = 100


class Panel(asyncio.DatagramProtocol):
    """Touches in, sets out."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._sets = [
            encode_request(Apply(safe, SESSION), address=1, sequence=0)
            for safe in make_sets(capabilities(4), SETS)
        ]

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Select a set and send it."""
        x = number = 0
        for timed in OscPacket(data).messages:
            match timed.message.params:
                case ["set", _, x, *_]:
                    pass
                case ["fseq", number]:
                    pass
        chosen = self._sets[int(x * SETS) % SETS]._replace(sequence=number & 0xFFFF)
        with contextlib.suppress(BlockingIOError):  # no room: the touch is lost
            os.write(self._port, encode_frame(chosen))


class Flooded(asyncio.Protocol):
    """Lines of JSON in."""

    def __init__(self) -> None:
        self._rest = b""

    def data_received(self, data: bytes) -> None:
        """Parse them."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            with contextlib.suppress(ValueError):
                json.loads(line)


def _opened(url: SerialUrl) -> serial.Serial | socket.socket:
    """Open the wire: a port, or a connection to a serial server."""
    if url.is_local:
        return serial.Serial(url.port, url.baud, timeout=0, exclusive=True)
    place = urlsplit(url.port)
    line = socket.create_connection((place.hostname or "", place.port or 0))
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    line.setblocking(False)
    return line


async def main() -> None:
    loop = asyncio.get_running_loop()
    with _opened(SerialUrl.parse(sys.argv[2])) as port:
        os.write(
            port.fileno(), encode_frame(encode_request(Arm(2.0, SESSION), address=1, sequence=0))
        )
        loop.add_reader(port.fileno(), os.read, port.fileno(), 4096)
        transport, _ = await loop.create_datagram_endpoint(
            lambda: Panel(port.fileno()), local_addr=("127.0.0.1", 0)
        )
        await loop.create_unix_server(Flooded, path=Path(sys.argv[3]))
        gc.collect()
        gc.freeze()
        print(transport.get_extra_info("sockname")[1], flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
