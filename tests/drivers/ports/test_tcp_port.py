"""TCP connections with faults of the network or the server."""

import asyncio
import socket
import subprocess
import sys

import pytest

from drivers.errors import LinkError, LinkTimeout
from drivers.ports import tcp
from drivers.ports.tcp import open_connection

MEGABYTE = 1 << 20


async def test_connection_timeout_has_a_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The connection is neither accepted nor refused."""
    monkeypatch.setattr(tcp, "_CONNECT_TIMEOUT", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        with pytest.raises(LinkError, match=rf"127.0.0.1:{port}: .*check the address"):
            await open_connection("127.0.0.1", port, lambda _: None, lambda _: None)


async def test_first_address_that_accepts_is_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The amplifier listens on the second address only, such as IPv4."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        found = [(0, 0, 0, "", (address, 0)) for address in ("127.0.0.2", "127.0.0.1")]
        monkeypatch.setattr(tcp.socket, "getaddrinfo", lambda *args, **kwargs: found)
        connection = await open_connection("amplifier.test", port, lambda _: None, lambda _: None)
        taken, _ = listening.accept()
        taken.close()
        connection.close()
        await connection.wait_closed()
        await asyncio.sleep(0)


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
    of_name = ("fe80::1", 0, 0, 3), ("fd00::1", 0, 0, 0), ("192.0.2.1", 0)
    found = [(0, 0, 0, "", address) for address in of_name]
    monkeypatch.setattr(tcp.socket, "getaddrinfo", lambda *args, **kwargs: found)
    assert await tcp._addresses("amplifier.test") == ["fe80::1%3", "fd00::1", "192.0.2.1"]


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
