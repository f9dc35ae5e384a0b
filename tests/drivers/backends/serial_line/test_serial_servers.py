"""A serial line behind a server on the network that passes bytes on."""

import asyncio
import socket
from typing import Any

import pytest

from drivers.amplifier import Amplifier
from drivers.backends.serial_line.backend import SerialBackend
from drivers.errors import LinkError
from scripted_amplifier import FarEnd
from vendor_pages import ARMED, IDENTITY


async def test_connection_to_a_server_disables_nagle(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame must not wait for the acknowledgement of the one before."""
    made: list[socket.socket] = []
    connect = socket.create_connection

    def noted(*args: Any, **kwargs: Any) -> socket.socket:
        made.append(connect(*args, **kwargs))
        return made[-1]

    monkeypatch.setattr(socket, "create_connection", noted)
    with socket.create_server(("127.0.0.1", 0)) as server:
        backend = SerialBackend(f"serial+tcp://127.0.0.1:{server.getsockname()[1]}")
        await backend.open()
        assert made[0].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        await backend.close()


async def test_amplifier_behind_a_server(far_end: FarEnd) -> None:
    """It replies through it; a closed connection is a loss, found without a request."""
    clients: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        clients.append(writer)
        far_end.write = writer.write
        while data := await reader.read(4096):
            far_end.receive(data)
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        address = server.sockets[0].getsockname()[1]
        amplifier = Amplifier(SerialBackend(f"serial+tcp://127.0.0.1:{address}"), reply_timeout=5.0)
        await amplifier.open()
        assert amplifier.identity == IDENTITY
        assert await amplifier.heartbeat() == ARMED
        clients[0].close()
        async with asyncio.timeout(60):
            while True:
                if amplifier.is_lost:
                    break
                await asyncio.sleep(0.01)
        with pytest.raises(LinkError):
            await amplifier.heartbeat()
        await amplifier.close()
