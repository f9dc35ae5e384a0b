"""Opening the amplifier at a URL for checks."""

import random
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from functools import partial

from drivers.errors import LinkError
from drivers.protocol.definition import MAX_WORDS
from drivers.wires.wire import address_of
from era_haptics.lab.conformance.can_client import CanClient
from era_haptics.lab.conformance.judge_client import JudgeClient
from era_haptics.lab.conformance.modbus_client import ModbusClient
from era_haptics.lab.conformance.outcomes import ContractViolation, TooLate
from era_haptics.lab.conformance.serial_client import SerialClient
from registry import threads

CLIENTS: Mapping[str, Callable[[int], JudgeClient]] = {
    "serial": SerialClient,
    "CAN": CanClient,
    "Modbus RTU": partial(ModbusClient, is_rtu=True),
    "Modbus TCP": partial(ModbusClient, is_rtu=False),
}
"""Client classes by the protocol of a wire."""


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[JudgeClient]:
    """Open the amplifier at a URL within a context, and wait until its board has started.

    Raises CommandError for an invalid URL, LinkError for a line that cannot be opened.
    """
    address = address_of(url)
    protocol = str(address.settings["protocol"])
    if protocol not in CLIENTS:
        raise LinkError(f"{url}: wire must be {', '.join(CLIENTS)}, got {protocol}")
    client = CLIENTS[protocol](address.number)
    client.name = url
    port = await address.open_port(client.received, client.lost)
    client.transmit = port.write
    try:
        boots_until = threads.now() + address.boot_time
        while threads.now() < boots_until:  # ignore boot messages of the board
            with suppress(ContractViolation, TooLate):
                await client.hello()
                break
        client.session = random.getrandbits(16)
        client.wire_time = address.make_wire().exchange_time
        client.transit = client.wire_time(0, MAX_WORDS)
        yield client
    finally:
        port.close()
        await port.wait_closed()
