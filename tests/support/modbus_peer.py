"""A scripted Modbus server on a TCP port, with RTU or TCP frames."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import TypeAlias, cast

from sim.far_ends.modbus.frames import RequestAdu, RtuReader, TcpReader, rtu_frame, tcp_frame
from sim.far_ends.modbus.unit import ModbusUnit
from vendor_pages import ScriptedDevice

Answer: TypeAlias = bytes | None
"""A PDU, or none."""


class Peer(asyncio.Protocol):
    """The far side of a line, with one connection at a time.

    answer: returns the PDU of a response, None for none; by default from the registers of
    `device`, whatever the unit.
    """

    def __init__(self, *, is_rtu: bool) -> None:
        self.is_rtu = is_rtu
        self.device = ScriptedDevice()
        self.unit = ModbusUnit(self.device)
        self.requests: list[RequestAdu] = []
        self.connections = 0
        self.answer: Callable[[RequestAdu], Answer] = self.usual
        self.url = ""
        self._reader: RtuReader | TcpReader = TcpReader()
        self._transport: asyncio.Transport | None = None
        self._arrived = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._reader = RtuReader() if self.is_rtu else TcpReader()
        self.connections += 1

    def data_received(self, data: bytes) -> None:
        for request in self._reader.feed(data, time.monotonic()):
            self.requests.append(request)
            self._arrived.set()
            pdu = self.answer(request) if request.unit else None
            if pdu is not None:
                self.send(request, pdu)

    def usual(self, request: RequestAdu) -> bytes:
        """Return the response of the device's registers."""
        pdu = self.unit.reply(request.pdu)
        assert pdu is not None
        return pdu

    def send(self, request: RequestAdu, pdu: bytes) -> None:
        self.send_raw(self.frame(request, pdu))

    def frame(self, request: RequestAdu, pdu: bytes) -> bytes:
        return rtu_frame(request.unit, pdu) if self.is_rtu else tcp_frame(request, pdu)

    def send_raw(self, data: bytes) -> None:
        assert self._transport is not None
        self._transport.write(data)

    def hang_up(self) -> None:
        assert self._transport is not None
        self._transport.abort()

    async def count(self, number: int) -> None:
        async with asyncio.timeout(60):
            while len(self.requests) < number:
                self._arrived.clear()
                await self._arrived.wait()

    @property
    def functions(self) -> Sequence[int]:
        return [request.pdu[0] for request in self.requests]


@asynccontextmanager
async def peer(*, is_rtu: bool) -> AsyncIterator[Peer]:
    """A listening peer; over RTU like a serial server."""
    peer = Peer(is_rtu=is_rtu)
    server = await asyncio.get_running_loop().create_server(lambda: peer, "127.0.0.1", 0)
    host, port = server.sockets[0].getsockname()
    scheme, unit = ("modbus+rtu", "#1") if is_rtu else ("modbus+tcp", "/1")
    peer.url = f"{scheme}://{host}:{port}{unit}"
    try:
        yield peer
    finally:
        server.close()
        if peer._transport is not None:
            peer._transport.abort()
        await server.wait_closed()
