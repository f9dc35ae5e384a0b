"""Detection of slcan adapters by two characters, and listening."""

import asyncio
import json
import os
import pty
import threading
import tty
from collections.abc import Callable, Iterator
from functools import partial

import pytest
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner

from drivers.by_hand.cli import app
from drivers.codec.can_bus.canopen import CanFrame
from drivers.discovery import slcan
from drivers.discovery.slcan import SlcanAdapter, detect_slcan
from sim.far_ends.can_bus.bus import CanBus
from sim.far_ends.can_bus.slcan_adapter import SlcanAdapter as FarAdapter


class Adapter:
    """A serial port with a far end's adapter, in a thread; nodes 1 and 127 send heartbeats."""

    def __init__(self) -> None:
        self.said = b""
        self._came = threading.Condition()
        self.on_bus: list[CanFrame] = []
        self._far, near = pty.openpty()
        tty.setraw(near)
        self._near = near
        self.port = os.ttyname(near)
        self._bus = CanBus()
        self._bus.join(self.on_bus.append)
        self._adapter = FarAdapter(self._bus, lambda data: void(os.write(self._far, data)))
        self.receive: Callable[[bytes], None] = lambda data: self._adapter.receive(data, 0.0)
        self._loop = asyncio.new_event_loop()
        self._loop.add_reader(self._far, self._read)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self._loop.call_soon(self._beat)
        self._loop.run_forever()

    def _beat(self) -> None:
        for can_id, data in ((0x701, b"\x05"), (0x77F, b"\x7f"), (0x700, b"\x05"), (0x181, b"\0")):
            self._bus.send(CanFrame(can_id, data), sender=self.on_bus.append)
        self._loop.call_later(0.05, self._beat)

    def _read(self) -> None:
        data = os.read(self._far, 4096)
        with self._came:
            self.said += data
            self._came.notify()
        self.receive(data)

    def has_got(self, text: bytes) -> bool:
        """Whether exactly this was written to it."""
        with self._came:
            return self._came.wait_for(lambda: len(self.said) >= len(text), 5) and self.said == text

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        os.close(self._far)
        os.close(self._near)


def reply(adapter: Adapter, answer: bytes, data: bytes) -> None:
    """Reply with fixed bytes."""
    os.write(adapter._far, answer)


def void(_: object) -> None:
    """Discard a result."""


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    """An adapter on its own port."""
    adapter = Adapter()
    yield adapter
    adapter.close()


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adapter here is a thread on a machine that may be busy: it is given time to reply."""
    monkeypatch.setattr(slcan, "_REPLY_TIMEOUT", 5.0)


@pytest.mark.usefixtures("patient")
def test_adapter_listens_and_is_closed(adapter: Adapter) -> None:
    """Its version, and the amplifiers' nodes that beat there, and no node 0; L and no other
    opening, closed at the end, and not a frame of ours on the bus."""
    assert detect_slcan(adapter.port) == SlcanAdapter("1013", nodes=(1, 127))
    assert adapter.has_got(b"V\rC\rS6\rL\rC\r")
    assert {frame.id for frame in adapter.on_bus} == {0x701, 0x77F, 0x700, 0x181}


def test_other_device_receives_two_characters(adapter: Adapter) -> None:
    """V and CR, whatever it replies."""
    for answer in (b"", b"?\r", b"Version 2\r", b"V10"):
        adapter.said = b""
        adapter.receive = partial(reply, adapter, answer)
        assert detect_slcan(adapter.port) is None
        assert adapter.said == b"V\r"


@pytest.mark.usefixtures("patient")
def test_adapter_without_listen_only_mode_is_not_opened(adapter: Adapter) -> None:
    """O is never sent."""
    usual = adapter.receive
    adapter.receive = lambda data: usual(data.replace(b"L\r", b"nonsense\r"))
    found = detect_slcan(adapter.port)
    assert found is not None
    assert found.nodes == ()
    assert "listen-only" in (found.problem or "")
    assert b"O" not in adapter.said


@pytest.mark.parametrize("is_wanted", [True, False])
def test_discover_probes_adapters_on_request_only(
    adapter: Adapter, is_wanted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --slcan the port is named with the URLs of what was heard, and no other protocol is
    tried on it; without, no such command goes out."""
    monkeypatch.setattr("drivers.discovery.places.comports", lambda: [ListPortInfo(adapter.port)])
    options = ["--slcan"] if is_wanted else ["--no-probe"]
    result = CliRunner().invoke(app, ["amp", "discover", "--json", *options])
    assert result.exit_code == 0, result.output
    (place,) = [one for one in json.loads(result.stdout)["places"] if one["place"] == adapter.port]
    url = f"can+slcan://{adapter.port}?bitrate=500000#"
    assert place["heard"] == ([f"{url}1", f"{url}127"] if is_wanted else [])
    assert ("slcan adapter 1013, heartbeats of nodes: 1, 127" in place["description"]) == is_wanted
    assert adapter.has_got(b"V\rC\rS6\rL\rC\r" if is_wanted else b"")
