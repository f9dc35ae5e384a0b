"""The CAN amplifier from elsewhere on a bus of python-can, and on an slcan adapter in memory."""

import asyncio
import re
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

import can

from memory_machine import live_in_memory
from vendor_can import NODE, VendorAmplifier

_FRAME = re.compile(rb"t([0-9A-F]{3})([0-8])((?:[0-9A-F]{2})*)")
_TICK = 0.001  # s


@contextmanager
def on_a_bus(channel: str) -> Iterator[str]:
    """Its URL, while it runs in a thread of its own."""
    bus, ending = can.Bus(interface="virtual", channel=channel), threading.Event()

    def send(identifier: int, data: bytes) -> None:
        bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def run() -> None:
        amplifier = VendorAmplifier(send, time.monotonic)
        amplifier.boot()
        while not ending.is_set():
            message = bus.recv(timeout=_TICK)
            if message is not None and not message.is_extended_id:
                amplifier.take(message.arbitration_id, bytes(message.data))
            amplifier.tick()

    thread = threading.Thread(target=run, name="an amplifier from elsewhere")
    thread.start()
    try:
        yield f"can+python-can://virtual/{channel}?heartbeat=10000#{NODE}"
    finally:
        ending.set()
        thread.join()
        bus.shutdown()


@asynccontextmanager
async def in_virtual_time() -> AsyncIterator[str]:
    """Its URL, behind an slcan adapter in memory."""
    waiting = bytearray()

    def heard(data: bytes) -> None:
        waiting.extend(data)
        *lines, rest = waiting.split(b"\r")
        waiting[:] = rest
        for line in lines:
            found = _FRAME.fullmatch(line)
            if found:
                amplifier.take(int(found[1], 16), bytes.fromhex(found[3].decode()))

    def send(identifier: int, data: bytes) -> None:
        terminal.write(f"t{identifier:03X}{len(data)}{data.hex().upper()}\r".encode())

    async def run() -> None:
        while True:
            amplifier.tick()
            await asyncio.sleep(_TICK)

    terminal = live_in_memory().make_terminal(heard, unpluggable=False)
    amplifier = VendorAmplifier(send, asyncio.get_running_loop().time)
    running = asyncio.create_task(run())
    yield f"can+slcan://{terminal.port}?heartbeat=10000#{NODE}"
    running.cancel()
