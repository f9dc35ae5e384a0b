"""Ports: opened, written without waiting, and lost."""

import asyncio
import errno
import os
import pty
import socket
import subprocess
import sys
import termios
import tty
from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock

import pytest
import serial

from drivers import ports
from drivers.errors import LinkError, LinkTimeout
from drivers.ports import Port, SerialPort, open_connection
from drivers.urls import Place
from virtual_lines import in_virtual_time


@pytest.mark.parametrize(
    ("device", "parity"), [("/dev/ttyUSB9", serial.PARITY_ODD), ("/dev/pts/9", serial.PARITY_NONE)]
)
def test_device_is_opened_alone_with_low_latency_and_its_settings(
    monkeypatch: pytest.MonkeyPatch, device: str, parity: str
) -> None:
    """A pseudo-terminal has no parity. DTR stays up afterwards: it restarts boards."""
    far, near = os.openpty()
    made = Mock()
    made.return_value.fileno.return_value = near
    monkeypatch.setattr(ports.serial, "Serial", made)
    ports._open_device(Place(device, baud=19_200, parity="O", stop=2))
    made.return_value.set_low_latency_mode.assert_called_once_with(True)
    settings = {key: made.call_args.kwargs[key] for key in ("baudrate", "parity", "stopbits")}
    assert settings == {"baudrate": 19_200, "parity": parity, "stopbits": 2}
    assert made.call_args.kwargs["exclusive"]
    assert not termios.tcgetattr(near)[2] & termios.HUPCL
    os.close(near)
    os.close(far)


async def test_port_that_fails_amid_its_opening_is_released(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is opened exclusively: else this program could not open it again."""
    far, near = os.openpty()
    name = os.ttyname(near)

    async def open_it() -> Port:
        return await ports.open_port(Place(name, baud=9600), lambda data: None, lambda cause: None)

    def fail(port: serial.Serial) -> None:
        raise OSError(errno.EIO, "gone")

    with monkeypatch.context() as patch:
        patch.setattr(serial.Serial, "reset_input_buffer", fail)
        with pytest.raises(LinkError, match="gone"):
            await open_it()
    port = await open_it()
    port.close()
    await port.wait_closed()
    os.close(near)
    os.close(far)


TIMEOUT = 60.0  # s; for what is expected


@pytest.fixture
def ends() -> Iterator[tuple[serial.Serial, int]]:
    """A port, and the descriptor at its other end."""
    far, near = pty.openpty()
    tty.setraw(near)
    port = serial.Serial(os.ttyname(near), timeout=0)
    yield port, far
    port.close()
    os.close(near)
    os.close(far)


async def read_until(far: int, end: bytes) -> bytes:
    """Read from the other end until these bytes."""
    os.set_blocking(far, False)
    got = b""
    async with asyncio.timeout(TIMEOUT):
        while not got.endswith(end):
            try:
                got += os.read(far, 1 << 16)
            except BlockingIOError:
                await asyncio.sleep(0)
    return got


async def test_blocked_port_takes_the_newest_frame(ends: tuple[serial.Serial, int]) -> None:
    """Unsent bytes of an older one are dropped; the newest follows without another call."""
    port, far = ends
    watched = SerialPort(port, "/dev/ttyUSB9", lambda data: None, lambda what: None)
    watched.write(b"a" * (1 << 20))
    assert watched.is_blocked
    watched.write(b"b" * (1 << 20))
    watched.write(b"stop")
    got = await read_until(far, b"stop")
    assert got.count(b"b") < 1 << 20
    assert got.count(b"a") < 1 << 20
    assert not watched.is_blocked
    watched.close()
    await watched.wait_closed()


async def test_closed_port_is_a_link_error(ends: tuple[serial.Serial, int]) -> None:
    """And the loss is reported once."""
    port, far = ends
    losses: list[str] = []
    watched = SerialPort(port, "/dev/ttyUSB9", lambda data: None, losses.append)
    watched.write(b"a" * (1 << 20))
    os.close(os.dup(far))
    os.dup2(os.open(os.devnull, os.O_RDWR), far)  # hangs up
    with pytest.raises(LinkError, match="check the cable"):
        watched.write(b"stop")
    assert len(losses) == 1
    watched.close()
    await watched.wait_closed()


async def test_error_of_whoever_takes_the_data_is_no_loss(ends: tuple[serial.Serial, int]) -> None:
    """A LinkError is an OSError, as those of a port that is gone."""
    port, far = ends
    losses: list[str] = []

    def fail(data: bytes) -> None:
        raise LinkError("of another line")

    watched = SerialPort(port, "/dev/ttyUSB9", fail, losses.append)
    os.write(far, b"reply")
    with pytest.raises(LinkError, match="of another line"):
        watched.poll()
    assert not losses
    watched.close()
    await watched.wait_closed()


MEGABYTE = 1 << 20


async def test_connection_timeout_has_a_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The connection is neither accepted nor refused."""
    monkeypatch.setattr(ports, "_CONNECT_TIMEOUT", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        with pytest.raises(LinkError, match=rf"127.0.0.1:{port}: .*check the address"):
            await open_connection("127.0.0.1", port, lambda _: None, lambda _: None)


@pytest.mark.parametrize("first", ["hangs", "refuses"])
@in_virtual_time
async def test_next_address_of_a_host_is_tried(first: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """After 250 ms (RFC 8305), or at once where the first refuses; that one then has no effect."""
    loop, accepts = asyncio.get_running_loop(), asyncio.Event()
    server = await loop.create_server(asyncio.Protocol, port=502)
    connect, losses = loop.create_connection, list[str]()

    async def connecting(make: Any, address: str, port: int) -> Any:
        if address == "fd00::1" and first == "refuses":
            raise ConnectionRefusedError
        if address == "fd00::1":
            await accepts.wait()
        return await connect(make, address, port)

    async def found(host: str) -> list[str]:
        return ["fd00::1", "192.0.2.1"]

    monkeypatch.setattr(loop, "create_connection", connecting)
    monkeypatch.setattr(ports, "_addresses", found)
    began = loop.time()
    connection = await open_connection("amplifier.test", 502, lambda _: None, losses.append)
    assert loop.time() - began == pytest.approx(0.25 if first == "hangs" else 0.0, abs=0.01)
    accepts.set()
    await asyncio.sleep(1.0)
    assert losses == []
    connection.close()
    server.close()


async def test_connection_gives_up_what_is_not_taken_within_a_second() -> None:
    """RFC 5482: the kernel's option, in milliseconds; frames are sent at once."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        connection = await open_connection("127.0.0.1", port, lambda _: None, lambda _: None)
        taken, _ = listening.accept()
        endpoint = connection._transport.get_extra_info("socket")  # type: ignore[attr-defined]
        options = (socket.TCP_USER_TIMEOUT, socket.TCP_NODELAY)
        assert [endpoint.getsockopt(socket.IPPROTO_TCP, each) for each in options] == [1000, 1]
        taken.close()
        connection.close()
        await connection.wait_closed()


async def test_link_local_address_keeps_its_zone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """RFC 4007."""
    of_name = ("fe80::1", 0, 0, 4000), ("fd00::1", 0, 0, 0), ("192.0.2.1", 0)
    found = [(0, 0, 0, "", address) for address in of_name]
    monkeypatch.setattr(ports.socket, "getaddrinfo", lambda *args, **kwargs: found)
    assert await ports._addresses("amplifier.test") == ["fe80::1%4000", "fd00::1", "192.0.2.1"]


def test_unresolved_name_does_not_delay_the_end_of_the_program() -> None:
    """Even if the name server does not reply."""
    program = """
import asyncio, socket, threading
from drivers.ports import tcp
from drivers.errors import LinkError

socket.getaddrinfo = lambda *args, **kwargs: threading.Event().wait()
tcp._CONNECT_TIMEOUT = 0.05
try:
    asyncio.run(tcp.open_connection("amplifier.test", 502, lambda _: None, lambda _: None))
except LinkError as problem:
    print(problem)
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], check=True, timeout=60, capture_output=True, text=True
    )
    assert "amplifier.test:502: no connection" in ran.stdout


async def test_blocked_connection_is_a_timeout_before_memory_fills() -> None:
    """Closing discards unsent data."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        connection = await open_connection("127.0.0.1", port, lambda _: None, lambda _: None)
        connection.write(bytes(64 * MEGABYTE))
        with pytest.raises(LinkTimeout, match="check the network"):
            connection.write(b"x")
        connection.close()
        await connection.wait_closed()
        await asyncio.sleep(0)  # the transport reports the end
