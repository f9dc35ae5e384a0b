"""The firmware in this process, on the clock of a virtual loop: nothing of it takes real time."""

import asyncio
import ctypes
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from drivers import clock
from sim.transport.pseudo_terminal import make_terminal
from wires import patient

WIRES = ("serial", "modbus+rtu", "can+slcan", "modbus+tcp")
"""The firmware's lines in their order, and Modbus over TCP."""

_MODBUS = 1  # the line of its replies
_TURN = 0.001  # s; between two turns of its loop
_RING = 8192  # bytes


class MovedFirmware:
    """The library `era-moved.so` in a folder: one amplifier, whose clock begins now."""

    def __init__(self, folder: Path) -> None:
        self._library = ctypes.CDLL(str(folder / "era-moved.so"))
        self._library.moved_to.argtypes = [ctypes.c_uint64]
        self._sent = ctypes.create_string_buffer(_RING)
        self._began = clock.now()
        self._library.moved_begin()

    def follow(self) -> None:
        """Move its clock to that of the loop."""
        self._library.moved_to(round((clock.now() - self._began) * 1e6))

    def receive(self, line: int, data: bytes) -> None:
        """Take bytes that arrive on a line now."""
        self.follow()
        self._library.moved_receive(line, data, len(data))

    def receive_tcp(self, data: bytes) -> None:
        """Take bytes that arrive now over the connection of Modbus TCP."""
        self.follow()
        self._library.moved_receive_tcp(data, len(data))

    def sent(self, line: int) -> bytes:
        """Return what it has sent on a line since the last call."""
        length = self._library.moved_sent(line, self._sent)
        return self._sent.raw[:length]


class _Connection(asyncio.Protocol):
    """The only connection of Modbus TCP."""

    def __init__(self, firmware: MovedFirmware) -> None:
        self._firmware = firmware

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self._firmware.receive_tcp(data)
        if reply := self._firmware.sent(_MODBUS):
            self._transport.write(reply)


@asynccontextmanager
async def moved_firmware(folder: Path, wire: str) -> AsyncIterator[str]:
    """Run the firmware on a wire of a loop that lives in memory; yield its URL."""
    firmware, loop = MovedFirmware(folder), asyncio.get_running_loop()
    if wire == "modbus+tcp":
        server = await loop.create_server(lambda: _Connection(firmware), "127.0.0.1", 0)
        turning = loop.create_task(_turn(firmware, lambda: None))
        url = f"modbus+tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}/1"
    else:
        line = WIRES.index(wire)

        def receive(data: bytes) -> None:
            firmware.receive(line, data)
            send()

        def send() -> None:
            if data := firmware.sent(line):
                terminal.write(data)

        terminal = make_terminal(receive)
        turning = loop.create_task(_turn(firmware, send))
        url = patient(f"{wire}://{terminal.port}{'#1' if wire == 'can+slcan' else ''}")
    try:
        yield url
    finally:
        turning.cancel()


async def _turn(firmware: MovedFirmware, send: Callable[[], None]) -> None:
    """Let its loop turn each millisecond."""
    while True:
        await asyncio.sleep(_TURN)
        firmware.follow()
        send()
