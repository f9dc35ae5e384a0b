"""A serial line behind a server on the network: RFC 2217, against pyserial's own server."""

import asyncio
import contextlib
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest
import serial
from serial.rfc2217 import PortManager

from drivers.amplifier import Amplifier
from drivers.backends.serial_line.backend import SerialBackend
from drivers.errors import LinkError
from scripted_amplifier import FarEnd
from vendor_pages import ARMED, IDENTITY

# pyserial 3.5 itself calls what Python deprecates.
pytestmark = pytest.mark.filterwarnings("ignore:set:DeprecationWarning")


class PtyPort(serial.Serial):
    """A pseudo-terminal, which has no modem lines."""

    cts = dsr = ri = cd = property(lambda self: False)

    def _update_rts_state(self) -> None:
        """There is none."""

    def _update_dtr_state(self) -> None:
        """There is none."""


class Redirector:
    """Serves one client of a serial port by RFC 2217, as pyserial's example does."""

    def __init__(self, path: str) -> None:
        self.port = PtyPort(path, timeout=0.02)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = self.listener.getsockname()[1]
        self._threads = [threading.Thread(target=self._serve)]
        self._threads[0].start()

    def write(self, data: bytes) -> None:
        self.client.sendall(data)

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            self.client, _ = self.listener.accept()
            self.manager = PortManager(self.port, self)
            reader = threading.Thread(target=self._read)
            self._threads.append(reader)
            reader.start()
            while data := self.client.recv(1024):
                self.port.write(b"".join(self.manager.filter(data)))

    def _read(self) -> None:
        with contextlib.suppress(OSError, TypeError):
            while True:
                data = self.port.read(self.port.in_waiting or 1)
                if data:
                    self.client.sendall(b"".join(self.manager.escape(data)))

    def hang_up(self) -> None:
        self.client.shutdown(socket.SHUT_RDWR)
        self.client.close()

    def close(self) -> None:
        self.listener.close()
        with contextlib.suppress(OSError, AttributeError):
            self.hang_up()
        self.port.close()
        for thread in self._threads:
            thread.join()


@pytest.fixture
def redirector(far_end: FarEnd) -> Iterator[Redirector]:
    """The far end's port on the network."""
    redirector = Redirector(far_end.path)
    yield redirector
    redirector.close()


async def test_connection_to_a_server_disables_nagle(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame must not wait for the acknowledgement of the one before."""
    made: list[socket.socket] = []
    connect = socket.create_connection

    def noted(*args: Any, **kwargs: Any) -> socket.socket:
        made.append(connect(*args, **kwargs))
        return made[-1]

    monkeypatch.setattr(socket, "create_connection", noted)
    with socket.create_server(("127.0.0.1", 0)) as server:
        backend = SerialBackend(f"socket://127.0.0.1:{server.getsockname()[1]}")
        await backend.open()
        assert made[0].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        await backend.close()


async def test_amplifier_behind_rfc2217(far_end: FarEnd, redirector: Redirector) -> None:
    """The speed is set at the server's port."""
    backend = SerialBackend(f"rfc2217://127.0.0.1:{redirector.address}?baud=115200")
    amplifier = Amplifier(backend, reply_timeout=5.0)
    await amplifier.open()
    assert amplifier.identity == IDENTITY
    assert await amplifier.heartbeat() == ARMED
    assert redirector.port.baudrate == 115200
    await amplifier.close()
    assert not [one for one in threading.enumerate() if one.name.startswith("era-serial")]


async def test_closed_server_is_a_loss(far_end: FarEnd, redirector: Redirector) -> None:
    """Detected without a request, and raised by the next."""
    backend = SerialBackend(f"rfc2217://127.0.0.1:{redirector.address}?baud=115200")
    amplifier = Amplifier(backend, reply_timeout=5.0)
    await amplifier.open()
    redirector.hang_up()
    async with asyncio.timeout(10):
        while True:
            if amplifier.is_lost:
                break
            await asyncio.sleep(0.01)
    with pytest.raises(LinkError, match="was lost"):
        await amplifier.heartbeat()
    await amplifier.close()
