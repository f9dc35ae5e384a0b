"""Opens the line of an amplifier for its checks, by its URL."""

import contextlib
import random
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial

from drivers.errors import LinkError
from drivers.judge.asking.can_frames import CanClient
from drivers.judge.asking.client import Client, Late, Violation
from drivers.judge.asking.modbus_frames import ModbusClient
from drivers.judge.asking.serial_frames import SerialClient
from drivers.protocol.table import MAX_WORDS
from drivers.wires.known import address_of
from registry import clock

CLIENTS: Mapping[str, Callable[[int], Client]] = {
    "serial": SerialClient,
    "CAN": CanClient,
    "Modbus RTU": partial(ModbusClient, is_rtu=True),
    "Modbus TCP": partial(ModbusClient, is_rtu=False),
}
"""Clients by the protocol that a wire's settings name."""


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[Client]:
    """The client of an amplifier by its URL while its line is open, and its board has started.

    Raises CommandError for a URL that is none, LinkError for a line that cannot be opened.
    """
    address = address_of(url)
    protocol = str(address.settings["protocol"])
    if protocol not in CLIENTS:
        raise LinkError(f"{url}: wire must be {', '.join(CLIENTS)}, got {protocol}")
    client = CLIENTS[protocol](address.number)
    client.name = url
    client.port = port = await address.open_port(client.received, client.lost)
    try:
        boots_until = clock.now() + address.boot_time
        while clock.now() < boots_until:  # what a board says while it starts is no reply
            with contextlib.suppress(Violation, Late):
                await client.hello()
                break
        client.session = random.getrandbits(16)
        client.wire_time = address.make_wire().exchange_time
        client.transit = client.wire_time(0, MAX_WORDS)
        yield client
    finally:
        port.close()
        await port.wait_closed()
