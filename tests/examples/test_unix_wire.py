"""The example of a wire: amplifiers behind a Unix socket."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import util
from pathlib import Path
from typing import Any

import pytest

from drivers import opening
from drivers.errors import CommandError, LinkError
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import Layer, Tone
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

MODULE = Path(__file__).parents[2] / "examples" / "plugins" / "wire" / "unix_wire.py"
LIMITS = GuardLimits(20.0, 1000.0, 1.0)


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class of the example, which opens all URLs."""
    spec = util.spec_from_file_location("unix_wire", MODULE)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(opening, "address_of", module.UnixAddress)
    monkeypatch.setattr("drivers.host.dialogue.COMMIT_DELAY", 10.0)  # on a busy machine
    return module.UnixAddress


@asynccontextmanager
async def served(path: Path) -> AsyncIterator[asyncio.Server]:
    """Two amplifiers at a socket, of which the server hears one host."""
    far = {number: Amplifier(str(number), channels=1) for number in (1, 2)}
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
async def test_group_plays_behind_a_socket_until_it_is_closed(address: Any, tmp_path: Path) -> None:
    """Two amplifiers on one line, played by one commit, silent after a stop; then it is lost."""
    path = tmp_path / "line.sock"
    async with served(path):
        lines = Lines()
        amplifiers = {
            str(number): await lines.amplifier(
                f"serial+unix://{path}#{number}", LIMITS, name=str(number)
            )
            for number in (1, 2)
        }
        group = Group(amplifiers, watchdog=2.0)
        await group.open()
        await group.arm()
        layers = [Layer(0, (Tone(0, 100.0, 0.5),), 0.0)]
        await group.apply(dict.fromkeys(amplifiers, layers))
        statuses = [await each.read_status() for each in amplifiers.values()]
        assert [status["levels"] for status in statuses] == [[5000], [5000]]
        assert all(each.is_confirmed for each in (await group.stop()).values())
        line = amplifiers["1"].line
        line._port.write(b"hang up")
        async with asyncio.timeout(60.0):
            with pytest.raises(LinkError, match="was lost"):
                await read_for_ever(amplifiers["2"])
        await lines.close()


async def read_for_ever(amplifier: Any) -> None:
    """Read the status until an error."""
    while True:
        await amplifier.read_status()


async def test_url_and_socket_must_be_there(address: Any, tmp_path: Path) -> None:
    """An address that cannot be, a path that is none."""
    for url in ("serial+unix://host/x", "serial+unix:///x#300", "serial+unix:///", "x:///y?z"):
        with pytest.raises(CommandError):
            address(url)
    with pytest.raises(LinkError, match="no connection"):
        await Lines().amplifier(f"serial+unix://{tmp_path / 'none'}", LIMITS, name="a")
