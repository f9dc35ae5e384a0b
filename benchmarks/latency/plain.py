"""The baseline: the same exchange with asyncio alone.

    python -m benchmarks.latency.plain URL ...

python-osc reads the touch, its position selects a pre-encoded set, and the set is sent to every
amplifier without waiting for a reply. It checks nothing and keeps no finger quiet. Prints the UDP
port.
"""

import asyncio
import contextlib
import gc
import socket
import sys
from collections.abc import Iterator

from pythonosc.osc_packet import OscPacket

from drivers.protocol.definition import MESSAGES, QUANTITIES, VERSION
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from drivers.wires.serial_frames import Frame, encode_frame, pack_words
from drivers.wires.serial_line import SerialAddress

SETS, CHANNELS = 100, 4
SESSION = 1
LEVEL = 0.2


class Panel(asyncio.DatagramProtocol):
    """Touches in, sets out."""

    def __init__(self, ports: list[socket.socket]) -> None:
        self._ports = ports
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
        frame = encode_frame(chosen._replace(sequence=token, payload=payload))
        for port in self._ports:
            with contextlib.suppress(BlockingIOError):  # no room: the touch is lost
                port.send(frame)


def _sets() -> Iterator[Values]:
    """Yield values of Set messages that play immediately, each at its own frequency."""
    level = QUANTITIES["level"].to_wire(LEVEL)
    for number in range(SETS):
        frequency = QUANTITIES["frequency"].to_wire(110.0 + number % 50)
        commands = tuple(Command(channel, frequency, level, 0) for channel in range(CHANNELS))
        stream = pack_layers([LayerSet(0, 0, 0, commands)])
        yield from parts(stream, session=SESSION, token=number + 1, now=True)


async def main() -> None:
    loop = asyncio.get_running_loop()
    ports = []
    for url in sys.argv[1:]:
        place = SerialAddress(url).place
        ports.append(socket.create_connection((place.host, place.port)))
        ports[-1].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        ports[-1].setblocking(False)
        loop.add_reader(ports[-1], ports[-1].recv, 4096)
    transport, _ = await loop.create_datagram_endpoint(
        lambda: Panel(ports), local_addr=("127.0.0.1", 0)
    )
    gc.collect()
    gc.freeze()
    print(transport.get_extra_info("sockname")[1], flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
