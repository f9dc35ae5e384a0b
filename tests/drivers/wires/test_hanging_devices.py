"""A device that hangs while it is opened, read or closed delays nothing else."""

import asyncio
import logging
import os
import threading
from collections.abc import Callable, Coroutine, Iterator
from functools import partial
from typing import Any

import can
import pytest

from drivers import ports
from drivers.ports import Port
from drivers.urls import Place
from drivers.wires import can_bus
from registry import threads


class _Hanging:
    """A port or adapter whose opening, reading and closing block until allowed."""

    def __init__(self) -> None:
        self.port = "/dev/ttyUSB9"
        self.may_open, self.may_read, self.may_close = (threading.Event() for _ in range(3))
        self.is_opening, self.is_closed = threading.Event(), threading.Event()
        self._pipe = os.pipe()

    def open(self, *_: object) -> "_Hanging":
        self.is_opening.set()
        self.may_open.wait(60)
        return self

    def fileno(self) -> int:
        return self._pipe[0]

    def recv(self, timeout: float) -> can.Message | None:
        if not self.may_read.wait(timeout):
            return None
        return can.Message(arbitration_id=0x701, is_extended_id=False, data=[5])

    def close(self) -> None:
        self.may_close.wait(60)
        for descriptor in self._pipe:
            os.close(descriptor)
        self.is_closed.set()

    shutdown = close


class _HangingRead(_Hanging):
    def recv(self, timeout: float) -> can.Message | None:
        return super().recv(20)


HEARD: list[bytes] = []
OPENINGS: dict[str, Callable[[], Coroutine[Any, Any, Port]]] = {
    "port": partial(
        ports.open_port,
        Place("/dev/ttyUSB9", baud=9600),
        lambda data: None,
        lambda what: None,
    ),
    "adapter": partial(
        can_bus.open_bus,
        "can+python-can://pcan/usb",
        {"interface": "pcan"},
        HEARD.append,
        lambda what: None,
    ),
}


@pytest.fixture(params=[_Hanging, _HangingRead])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[_Hanging]:
    """The device that is opened; released after the test."""
    device: _Hanging = request.param()
    monkeypatch.setattr(ports, "_open_device", device.open)
    monkeypatch.setattr(can, "Bus", lambda **how: device.open())
    monkeypatch.setattr(threads, "CLOSE_TIMEOUT", 0.05)
    HEARD.clear()
    yield device
    for event in (device.may_open, device.may_read, device.may_close):
        event.set()
    assert device.is_closed.wait(60)


@pytest.mark.parametrize("kind", OPENINGS)
async def test_close_does_not_wait_for_a_device_that_hangs(
    device: _Hanging, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    """It continues in its thread, with a log line; frames read then are discarded."""
    device.may_open.set()
    opened = await OPENINGS[kind]()
    opened.close()
    with caplog.at_level(logging.WARNING, "drivers"):
        await asyncio.wait_for(opened.wait_closed(), 30)
    assert not device.is_closed.is_set()
    assert "era-close" in caplog.text
    device.may_read.set()
    device.may_close.set()
    assert await asyncio.to_thread(device.is_closed.wait, 60)
    assert HEARD == []
