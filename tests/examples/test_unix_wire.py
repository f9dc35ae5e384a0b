"""A wire behind a Unix socket, the example of a plug-in."""

import asyncio
import runpy
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from drivers import opening
from drivers.errors import LinkError
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

ROOT = Path(__file__).parents[2]
PLUGINS = ROOT / "examples" / "plugins"


LIMITS = GuardLimits(20.0, 1000.0, 1.0)


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class of the example, which opens all URLs."""
    module = runpy.run_path(str(PLUGINS / "wire" / "unix_wire.py"))["UnixAddress"]
    monkeypatch.setattr(opening, "address_of", module)
    return module


@asynccontextmanager
async def served_socket(path: Path) -> AsyncIterator[asyncio.Server]:
    """Two amplifiers at a socket, of which the server hears one host."""
    far = {number: SimulatedAmplifier(str(number), channels=1) for number in (1, 2)}
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        end = SerialAmplifiers(far, writer.write)
        while data := await reader.read(4096):
            end.receive(data, loop.time())
            if b"hang up" in data:
                break
        writer.close()
        ended.set()

    server = await asyncio.start_unix_server(serve, path)
    try:
        yield server
    finally:
        server.close()
        await ended.wait()
        await asyncio.sleep(0)


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_group_plays_behind_a_socket_until_it_is_closed(address: Any, tmp_path: Path) -> None:
    """Two amplifiers on one line, played by one commit, silent after a stop; then it is lost."""
    path = tmp_path / "line.sock"
    async with served_socket(path):
        lines = Lines()
        amplifiers = dict[str, Amplifier]()
        for name in ("1", "2"):
            url = f"example-unix://{path}#{name}"
            amplifiers[name] = await lines.amplifier(url, LIMITS, name=name)
        group = Group(amplifiers)
        await group.open()
        await group.arm()
        layers = [AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.0)]
        await group.apply(dict.fromkeys(amplifiers, layers))
        statuses = [await amplifier.read_status() for amplifier in amplifiers.values()]
        assert [status["levels"] for status in statuses] == [[5000], [5000]]
        outcomes = await group.stop()
        confirmed = {name: outcome.is_confirmed for name, outcome in outcomes.items()}
        assert confirmed == {"1": True, "2": True}
        amplifiers["1"].line._port.write(b"hang up")
        async with asyncio.timeout(60.0):
            with pytest.raises(LinkError, match="was lost"):
                await read_for_ever(amplifiers["2"])
        await lines.close()


async def read_for_ever(amplifier: Any) -> None:
    """Read the status until an error."""
    while True:
        await amplifier.read_status()
