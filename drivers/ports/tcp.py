"""TCP connections as ports: of Modbus, of serial servers and of CAN adapters behind one."""

import asyncio
import ipaddress
import socket
from asyncio.staggered import staggered_race
from collections.abc import Callable
from functools import partial
from typing import cast

from drivers.errors import LinkError, LinkTimeout, system_message
from drivers.ports.port import Port
from registry.threads import in_thread

NETWORK_DELAY = 1.0
"""Time [s] after which a port gives up a connection that has not taken what was sent.

What a broken network delivers later than that is not accounted for.
"""
_CONNECT_TIMEOUT = 1.0  # s; a hundred times the delay within a building
_NEXT_AFTER = 0.25  # s; RFC 8305, section 5; an address that is refused is not waited for
_NUMERIC = socket.NI_NUMERICHOST | socket.NI_NUMERICSERV
_READ_MAX = 4096  # bytes at once; others have their turn between
_UNSENT_MAX = 4096  # bytes; sixteen unsent frames mean a blocked connection


async def open_connection(
    host: str, port: int, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> Port:
    """Connect to the first address of a host that accepts; LinkError with a remedy."""
    endpoint = f"{host}:{port}"
    try:
        async with asyncio.timeout(_CONNECT_TIMEOUT):
            return await _first_to_accept(host, port, _Connection(endpoint, on_data, on_loss))
    except TimeoutError:
        raise LinkError(
            f"{endpoint}: no connection within {_CONNECT_TIMEOUT:g} s; check the address, the "
            "network and that the amplifier is switched on"
        ) from None
    except OSError as error:
        raise LinkError(
            f"{endpoint}: connection refused; check the address and the port, and that the "
            f"amplifier is switched on (the system says: {system_message(error)})"
        ) from error


class _Connection(asyncio.BufferedProtocol):
    """A TCP connection."""

    def __init__(
        self, endpoint: str, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> None:
        self._endpoint = endpoint
        self._on_data = on_data
        self._buffer = bytearray(_READ_MAX)
        self._on_loss = on_loss
        self._is_closed = self.is_made = False
        self._transport: asyncio.Transport  # set when connected

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Send small frames at once, and give up the connection that does not take them in time.

        Without it a frame waits up to 40 ms for the acknowledgement of the one before, and what a
        broken network keeps may arrive minutes later.
        """
        self._transport, self.is_made = cast(asyncio.Transport, transport), True
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux
            timeout = round(1000 * NETWORK_DELAY)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, timeout)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        if not self._is_closed:
            self._on_data(bytes(self._buffer[:nbytes]))

    def connection_lost(self, exc: Exception | None) -> None:
        if not self._is_closed:
            self._is_closed = True
            why = str(exc) if exc else "closed by the other side"
            self._on_loss(
                f"the connection to {self._endpoint} was lost ({why}): check the amplifier and the "
                "network, then open the amplifier again"
            )

    @property
    def is_blocked(self) -> bool:
        return self._transport.get_write_buffer_size() > 0

    def poll(self) -> None:
        """Nothing to do: the loop reads before it runs timers that are due later."""

    def write(self, data: bytes) -> None:
        if self._transport.get_write_buffer_size() > _UNSENT_MAX:
            raise LinkTimeout(f"{self._endpoint}: write blocked; check the network")
        self._transport.write(data)

    def close(self) -> None:
        self._is_closed = True
        self._transport.abort()  # discards unsent bytes

    async def wait_closed(self) -> None:
        """Return at once: abort does not block."""


async def _first_to_accept(host: str, port: int, connection: _Connection) -> Port:
    """Connect to the first address of a host that accepts (RFC 8305); raises OSError."""
    connect = asyncio.get_running_loop().create_connection
    take = [connection].pop  # the first address that accepts has it, any other an IndexError
    attempts = [partial(connect, take, each, port) for each in await _addresses(host)]
    try:
        _, index, failures = await staggered_race(attempts, _NEXT_AFTER)
    except BaseException:
        if connection.is_made:  # given up just after it was accepted
            connection.close()
        raise
    if index is None and failures[-1] is not None:
        raise failures[-1]
    return connection


async def _addresses(host: str) -> list[str]:
    """Resolve a host name to at least one address; raises OSError."""
    try:
        return [str(ipaddress.ip_address(host))]
    except ValueError:
        # asyncio resolves in a thread that delays the end of the program.
        found = await in_thread(
            lambda: socket.getaddrinfo(host, None, type=socket.SOCK_STREAM), name=f"era-name {host}"
        )
        # With the zone of a link-local address.
        return [socket.getnameinfo(each, _NUMERIC)[0] for *_, each in found]
