"""A device that hangs in close delays neither stopping, ending nor reopening."""

import asyncio
import logging
import os
import threading
from collections.abc import Awaitable, Callable, Iterator

import can
import pytest

from drivers import threads
from drivers.backends.can_bus import adapter
from drivers.backends.hardware import Adapter, Port
from drivers.backends.ports import opening
from drivers.backends.urls.can_bus import CanUrl
from drivers.codec.can_bus.frame import CanFrame


class _Hanging:
    """An open port or adapter that says nothing, and is closed once it may be."""

    def __init__(self) -> None:
        self.port = "/dev/ttyUSB9"
        self.may_close, self.is_closed = threading.Event(), threading.Event()
        self._read, self._write = os.pipe()

    def fileno(self) -> int:
        """Descriptor of a pipe without a writer."""
        return self._read

    def recv(self, timeout: float) -> None:
        """As an adapter."""
        threading.Event().wait(timeout)

    def close(self) -> None:
        """As a port; blocks."""
        self.may_close.wait(20)
        os.close(self._read)
        os.close(self._write)
        self.is_closed.set()

    shutdown = close  # as an adapter


@pytest.fixture
def hanging(monkeypatch: pytest.MonkeyPatch) -> Iterator[_Hanging]:
    """What is opened; it lets go when the test is over."""
    device = _Hanging()
    monkeypatch.setattr(opening, "_open_port", lambda *args: device)
    monkeypatch.setattr(adapter, "open_bus", lambda url: device)
    monkeypatch.setattr(threads, "CLOSE_TIMEOUT", 0.05)
    yield device
    device.may_close.set()
    assert device.is_closed.wait(20)


class _Late(_Hanging):
    """An adapter that hangs while it is read, and then has a frame after all."""

    def __init__(self) -> None:
        super().__init__()
        self.may_read = threading.Event()
        self.may_close.set()

    def recv(self, timeout: float) -> can.Message:  # type: ignore[override]
        """Block longer than the timeout."""
        self.may_read.wait(20)
        return can.Message(arbitration_id=0x701, is_extended_id=False, data=[5])


async def _port() -> Port | Adapter:
    return await opening.open_port(
        "/dev/ttyUSB9", baud=9600, on_data=lambda data: None, on_loss=lambda what: None
    )


async def _adapter() -> Port | Adapter:
    url = CanUrl.parse("can+socketcan://can0#1").bus
    return await adapter.open_adapter(url, on_frame=lambda frame: None, on_loss=lambda what: None)


@pytest.mark.parametrize("begin", [_port, _adapter])
async def test_close_does_not_wait_for_a_device_that_hangs(
    begin: Callable[[], Awaitable[Port | Adapter]],
    hanging: _Hanging,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It continues in its thread, with a log line."""
    opened = await begin()
    opened.close()
    with caplog.at_level(logging.WARNING, "drivers"):
        await asyncio.wait_for(opened.wait_closed(), 10)
    assert not hanging.is_closed.is_set()
    assert "still closing" in caplog.text


async def test_frames_after_close_are_discarded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A frame of an adapter that hung while the bus was reopened."""
    device, heard = _Late(), list[CanFrame]()
    monkeypatch.setattr(adapter, "open_bus", lambda url: device)
    monkeypatch.setattr(threads, "CLOSE_TIMEOUT", 0.05)
    url = CanUrl.parse("can+socketcan://can0#1").bus
    opened = await adapter.open_adapter(url, on_frame=heard.append, on_loss=lambda what: None)
    opened.close()
    await asyncio.wait_for(opened.wait_closed(), 10)
    assert not device.is_closed.is_set()
    device.may_read.set()
    assert await asyncio.to_thread(device.is_closed.wait, 20)
    assert heard == []
