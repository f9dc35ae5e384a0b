"""The amplifiers' side of Modbus in protocol 4, driven by masters that are not ours."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing

import pytest

from real_wires import MASTERS, drive
from registry import threads
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.transport.far_end import make_terminal


@asynccontextmanager
async def served(line: str) -> AsyncIterator[str]:
    """An amplifier of four channels as unit 1 on a pseudo-terminal or a TCP port; its URL."""
    amplifiers = {1: Amplifier("a", channels=4)}

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        end = ModbusAmplifiers(amplifiers, writer.write, is_rtu=False)
        while data := await reader.read(4096):
            end.receive(data, threads.now())
        writer.close()

    if line == "tcp":
        async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
            yield f"modbus+tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}/1"
        return
    terminal = make_terminal(lambda data: end.receive(data, threads.now()))
    end = ModbusAmplifiers(amplifiers, terminal.write, is_rtu=True)
    with closing(terminal):
        terminal.listen()
        yield f"modbus+rtu://{terminal.port}#1"


@pytest.mark.parametrize("name", MASTERS)
async def test_foreign_master_drives_it(name: str) -> None:
    """Reads by both functions, writes, a set, and an exception, over a real line."""
    line, make = MASTERS[name]
    async with served(line) as url:
        assert await asyncio.to_thread(drive, make, url) == "era-haptics"
