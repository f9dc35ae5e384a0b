"""Ports: settings of devices, writing without waiting, lost ports, connections to host names."""

import asyncio
import contextlib
import errno
import os
import pty
import socket
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
from drivers.urls import Endpoint
from kit.clock import in_virtual_time


@pytest.mark.parametrize(
    ("device", "parity"), [("/dev/ttyUSB9", serial.PARITY_ODD), ("/dev/pts/9", serial.PARITY_NONE)]
)
def test_open_device_is_exclusive_with_low_latency_and_the_settings_of_its_endpoint(
    monkeypatch: pytest.MonkeyPatch, device: str, parity: str
) -> None:
    """A pseudo-terminal has no parity. DTR stays up after closing, since it restarts boards."""
    far, near = os.openpty()
    serial_class = Mock()
    serial_class.return_value.fileno.return_value = near
    monkeypatch.setattr(ports.serial, "Serial", serial_class)

    ports.open_device(Endpoint(device, baud=19_200, parity="O", stop=2))

    serial_class.return_value.set_low_latency_mode.assert_called_once_with(True)
    settings = serial_class.call_args.kwargs
    assert settings["baudrate"] == 19_200
    assert settings["parity"] == parity
    assert settings["stopbits"] == 2
    assert settings["exclusive"]
    control_modes = termios.tcgetattr(near)[2]
    assert not control_modes & termios.HUPCL
    os.close(near)
    os.close(far)


async def _open(name: str) -> Port:
    return await ports.open_port(Endpoint(name, baud=9600), lambda data: None, lambda cause: None)


async def test_open_port_releases_a_device_when_opening_fails_halfway(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A device is opened exclusively, so this program could not open it again otherwise."""
    far, near = os.openpty()
    name = os.ttyname(near)

    with monkeypatch.context() as patch:
        failing = Mock(side_effect=OSError(errno.EIO, "gone"))
        patch.setattr(serial.Serial, "reset_input_buffer", failing)
        with pytest.raises(LinkError, match="gone"):
            await _open(name)

    port = await _open(name)
    port.close()
    await port.wait_closed()
    os.close(near)
    os.close(far)


@pytest.fixture
def terminal() -> Iterator[tuple[serial.Serial, int]]:
    """A port, and the descriptor at its other end."""
    far, near = pty.openpty()
    tty.setraw(near)
    port = serial.Serial(os.ttyname(near), timeout=0)
    yield port, far
    port.close()
    os.close(near)
    os.close(far)


async def test_port_that_is_blocked_sends_only_the_newest_frame(
    terminal: tuple[serial.Serial, int],
) -> None:
    """Unsent bytes of older frames are dropped; the newest follows without another call."""
    device, far = terminal
    port = SerialPort(device, "/dev/ttyUSB9", lambda data: None, lambda cause: None)
    port.write(b"a" * (1 << 20))
    assert port.is_blocked

    port.write(b"b" * (1 << 20))
    port.write(b"stop")

    received = b""
    os.set_blocking(far, False)
    async with asyncio.timeout(60.0):
        while not received.endswith(b"stop"):
            with contextlib.suppress(BlockingIOError):
                received += os.read(far, 1 << 16)
            await asyncio.sleep(0)
    assert received.count(b"a") < 1 << 20
    assert received.count(b"b") < 1 << 20
    assert not port.is_blocked
    port.close()
    await port.wait_closed()


async def test_port_reports_its_loss_once_when_the_device_hangs_up(
    terminal: tuple[serial.Serial, int],
) -> None:
    """The next write raises a LinkError with a remedy."""
    device, far = terminal
    losses: list[str] = []
    port = SerialPort(device, "/dev/ttyUSB9", lambda data: None, losses.append)
    port.write(b"a" * (1 << 20))

    os.close(os.dup(far))
    os.dup2(os.open(os.devnull, os.O_RDWR), far)  # hangs up
    with pytest.raises(LinkError, match="check the cable"):
        port.write(b"stop")

    assert len(losses) == 1
    port.close()
    await port.wait_closed()


async def test_port_is_not_lost_when_the_receiver_of_its_data_fails(
    terminal: tuple[serial.Serial, int],
) -> None:
    """A LinkError of the receiver is an OSError, like the errors of a lost port."""
    device, far = terminal
    receive = Mock(side_effect=LinkError("of another line"))
    note_loss = Mock()
    port = SerialPort(device, "/dev/ttyUSB9", receive, note_loss)

    os.write(far, b"reply")
    with pytest.raises(LinkError, match="of another line"):
        port.poll()

    note_loss.assert_not_called()
    port.close()
    await port.wait_closed()


@pytest.fixture
def server() -> Iterator[tuple[socket.socket, int]]:
    """A listening socket and its port."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening, listening.getsockname()[1]


async def _connect(port: int) -> Port:
    return await open_connection("127.0.0.1", port, lambda data: None, lambda cause: None)


async def test_connection_timeout_has_a_remedy(
    server: tuple[socket.socket, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The connection is neither accepted nor refused in time."""
    _, port = server
    monkeypatch.setattr(ports, "CONNECT_TIMEOUT", 0.0)

    with pytest.raises(LinkError, match=rf"127.0.0.1:{port}: .*check the address"):
        await _connect(port)


@pytest.mark.parametrize(("behavior", "delay"), [("hangs", 0.25), ("refuses", 0.0)])
@in_virtual_time
async def test_connection_tries_the_next_address_of_a_host(
    behavior: str, delay: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After 250 ms (RFC 8305), or immediately if the first refuses, which then has no effect."""
    loop = asyncio.get_running_loop()
    first_accepts = asyncio.Event()
    tcp_server = await loop.create_server(asyncio.Protocol, port=502)
    create_connection = loop.create_connection
    losses: list[str] = []

    async def connect(factory: Any, address: str, port: int) -> Any:
        if address == "fd00::1":
            if behavior == "refuses":
                raise ConnectionRefusedError
            await first_accepts.wait()
        return await create_connection(factory, address, port)

    async def resolve(host: str) -> list[str]:
        return ["fd00::1", "192.0.2.1"]

    monkeypatch.setattr(loop, "create_connection", connect)
    monkeypatch.setattr(ports, "host_addresses", resolve)

    began = loop.time()
    connection = await open_connection("amplifier.test", 502, lambda data: None, losses.append)

    assert loop.time() - began == pytest.approx(delay, abs=0.01)
    first_accepts.set()
    await asyncio.sleep(1.0)
    assert losses == []
    connection.close()
    tcp_server.close()


async def test_connection_times_out_when_the_network_takes_no_data(
    server: tuple[socket.socket, int],
) -> None:
    """The kernel's option (RFC 5482) ends it after 1000 ms, and frames are sent without delay.

    A blocked write fails before memory fills up; closing discards unsent data.
    """
    connection = await _connect(server[1])
    endpoint = connection._transport.get_extra_info("socket")  # type: ignore[attr-defined]
    assert endpoint.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 1000
    assert endpoint.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1

    connection.write(bytes(64 << 20))
    with pytest.raises(LinkTimeout, match="check the network"):
        connection.write(b"x")

    connection.close()
    await connection.wait_closed()
    await asyncio.sleep(0)  # the transport reports the end


async def test_host_addresses_keep_the_zone_of_a_link_local_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """RFC 4007."""
    addresses = [("fe80::1", 0, 0, 4000), ("fd00::1", 0, 0, 0), ("192.0.2.1", 0)]
    resolved = [(0, 0, 0, "", address) for address in addresses]
    monkeypatch.setattr(ports.socket, "getaddrinfo", lambda *args, **kwargs: resolved)

    names = await ports.host_addresses("amplifier.test")

    assert names == ["fe80::1%4000", "fd00::1", "192.0.2.1"]
