"""Detection of slcan adapters by two characters, and listening."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable

import pytest
import pytest_asyncio
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner

from drivers.by_hand import reaching
from drivers.by_hand.cli import app
from drivers.by_hand.reaching import Candidate, detect_slcan
from drivers.wires.can_frames import CanFrame
from sim.far_ends.can_amplifiers import CanBus, SlcanAdapter
from sim.transport.far_end import make_terminal

SPOKEN = b"V\rC\rS6\rL\rC\r"
BEATS = ((0x701, b"\x05"), (0x77F, b"\x7f"), (0x700, b"\x05"), (0x181, b"\0"))
"""Heartbeats of nodes 1 and 127, and frames that are none of a node."""


class Adapter:
    """A serial port with a far end's adapter; said: to it; heard: on its bus."""

    def __init__(self) -> None:
        self.said, self.heard = b"", list[CanFrame]()
        bus = CanBus()
        self.terminal = make_terminal(self._read)
        adapter = SlcanAdapter(bus, self.terminal.write)
        self.receive: Callable[[bytes], None] = lambda data: adapter.receive(data, 0.0)
        bus.join(self.heard.append)
        self.terminal.listen()
        self._bus = bus

    async def beat(self) -> None:
        """Send what nodes send, for ever."""
        while True:
            for can_id, data in BEATS:
                self._bus.send(CanFrame(can_id, data), sender=lambda frame: None)
            await asyncio.sleep(0.05)

    def _read(self, data: bytes) -> None:
        self.said += data
        self.receive(data)

    async def detect(self) -> Candidate | None:
        """Detect it, in a thread."""
        return await asyncio.to_thread(detect_slcan, self.terminal.port)


@pytest_asyncio.fixture
async def adapter() -> AsyncIterator[Adapter]:
    """An adapter on its own port."""
    adapter = Adapter()
    beating = asyncio.create_task(adapter.beat())
    yield adapter
    beating.cancel()
    adapter.terminal.close()


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adapter is on a machine that may be busy: it is given time to reply."""
    monkeypatch.setattr(reaching, "_REPLY_TIMEOUT", 5.0)


async def test_other_device_receives_two_characters(adapter: Adapter) -> None:
    """V and CR, whatever it replies."""
    for reply in (b"", b"?\r", b"Version 2\r", b"V10"):
        adapter.said = b""
        adapter.receive = lambda data, reply=reply: adapter.terminal.write(reply)  # type: ignore[misc]
        assert await adapter.detect() is None
        assert adapter.said == b"V\r"


@pytest.mark.usefixtures("patient")
async def test_adapter_without_listen_only_mode_is_not_opened(adapter: Adapter) -> None:
    """O is never sent."""
    usual = adapter.receive
    adapter.receive = lambda data: usual(data.replace(b"L\r", b"nonsense\r"))
    found = await adapter.detect()
    assert found is not None
    assert found.urls == ()
    assert "listen-only" in found.description
    assert b"O" not in adapter.said


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("is_probed", [True, False])
async def test_discover_probes_adapters_on_request_only(
    adapter: Adapter, is_probed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --slcan the port is named with its version and the nodes that beat there.

    It is opened by L alone and closed at the end, with not a frame of ours on the bus, and no other
    protocol is tried on it; without the option no such command goes out.
    """
    port = adapter.terminal.port
    monkeypatch.setattr("drivers.by_hand.reaching.comports", lambda: [ListPortInfo(port)])
    options = ["--slcan"] if is_probed else ["--no-probe"]
    arguments = ["amp", "discover", "--json", *options]
    result = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    assert result.exit_code == 0, result.output
    (place,) = [one for one in json.loads(result.stdout)["places"] if one["place"] == port]
    url = f"can+slcan://{port}?bitrate=500000#"
    assert place["heard"] == ([f"{url}1", f"{url}127"] if is_probed else [])
    assert ("slcan adapter 1013, heartbeats of nodes: 1, 127" in place["description"]) == is_probed
    async with asyncio.timeout(60.0):
        while True:
            if adapter.said == (SPOKEN if is_probed else b""):
                break
            await asyncio.sleep(0)
    assert {frame.id for frame in adapter.heard} == {can_id for can_id, _ in BEATS}
