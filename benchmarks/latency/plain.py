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
from collections.abc import Iterator
from pathlib import Path

import serial
from pythonosc.osc_packet import OscPacket

from drivers.codec.serial_line.frame import Frame, encode_frame, pack_words
from drivers.host.serial_wire import SerialWire
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from drivers.protocol.table import MESSAGES, QUANTITIES, VERSION
from drivers.urls import Place
from drivers.wires.serial_line import SerialAddress

SETS, CHANNELS = 100, 4
SESSION = 1
WATCHDOG = 2.0  # s; the longest
LEVEL = 0.2


class Panel(asyncio.DatagramProtocol):
    """Touches in, sets out."""

    def __init__(self, port: int) -> None:
        self._port = port
        message = MESSAGES["Set"]
        self._sets = [
            Frame(message.number, 1, 0, pack_words(message.request.pack(values)), VERSION)
            for values in _sets()
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
        chosen, token = self._sets[int(x * SETS) % SETS], number & 0xFFFF
        payload = chosen.payload[:2] + token.to_bytes(2, "little") + chosen.payload[4:]
        chosen = chosen._replace(sequence=token, payload=payload)
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


def _sets() -> Iterator[Values]:
    """The values of Set messages that play at once, each at a frequency of its own."""
    level = QUANTITIES["level"].to_wire(LEVEL)
    for number in range(SETS):
        frequency = QUANTITIES["frequency"].to_wire(110.0 + number % 50)
        commands = tuple(Command(channel, frequency, level, 0) for channel in range(CHANNELS))
        stream = pack_layers([LayerSet(0, 0, 0, commands)])
        yield from parts(stream, session=SESSION, token=number + 1, now=True)


def _opened(place: Place) -> serial.Serial | socket.socket:
    """Open the wire: a port, or a connection to a serial server."""
    if place.device:
        return serial.Serial(place.device, place.baud, timeout=0, exclusive=True)
    line = socket.create_connection((place.host, place.port))
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    line.setblocking(False)
    return line


async def main() -> None:
    loop = asyncio.get_running_loop()
    place = SerialAddress(sys.argv[2]).place
    with _opened(place) as port:
        watchdog = QUANTITIES["watchdog"].to_wire(WATCHDOG)
        arm: Values = {"session": SESSION, "watchdog": watchdog}
        os.write(port.fileno(), SerialWire(place.baud, sequence=0).request(1, "Arm", arm))
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
