"""An slcan adapter behind a TCP port, such as a serial server or an emulator."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from drivers.amplifier import Amplifier
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierState
from drivers.registry import open_backend
from model.rig.rig import Rig
from wires import WIRES, far_side, tones

REPLY_TIMEOUT = 2.0  # s; a busy machine delays replies


@asynccontextmanager
async def served(path: str) -> AsyncIterator[int]:
    """Serve a terminal on a TCP port; its number."""
    terminal = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    loop = asyncio.get_running_loop()
    writers = []

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        loop.add_reader(terminal, lambda: writer.write(os.read(terminal, 4096)))
        while data := await reader.read(4096):
            os.write(terminal, data)
        loop.remove_reader(terminal)
        writer.close()

    server = await asyncio.start_server(connected, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for writer in writers:
            writer.close()
        loop.remove_reader(terminal)
        os.close(terminal)


async def read_for_ever(amplifier: Amplifier) -> None:
    """Read the status again and again."""
    while True:
        await amplifier.status()


@pytest.mark.real_time
async def test_amplifier_plays_behind_a_tcp_port_until_it_is_closed(coarse_rig: Rig) -> None:
    """It plays and stops; without the connection it is lost."""
    async with far_side(WIRES["can+slcan"], coarse_rig) as far:
        path = far.url.partition("://")[2].partition("?")[0].partition("#")[0]
        async with served(path) as port:
            url = f"can+slcan://127.0.0.1:{port}?heartbeat=10000#1"
            amplifier = Amplifier(open_backend(url), reply_timeout=REPLY_TIMEOUT)
            await amplifier.open()
            await amplifier.arm(2.0)
            await amplifier.apply(tones(amplifier, 0.2, 0.1))
            assert (await amplifier.status()).levels[:2] == pytest.approx((0.2, 0.1))
            stopped = await amplifier.stop(0.0)
            assert stopped.state is AmplifierState.QUICK_STOP_ACTIVE
            assert not any(far.amplifier.status(far.bench.time).levels)
        with pytest.raises(LinkError):
            await asyncio.wait_for(read_for_ever(amplifier), 10)
        await amplifier.close()
