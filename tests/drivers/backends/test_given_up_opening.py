"""A port or an adapter that takes its time to be opened, and is not wanted any more by then."""

import asyncio
import threading
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from drivers.backends.can_bus import adapter
from drivers.backends.ports import opening
from drivers.backends.urls.can_bus import CanUrl


class _Slow:
    """What is opened once it may be, and knows that it was closed."""

    def __init__(self) -> None:
        self.port = "/dev/ttyUSB9"
        self.begun, self.may_open = threading.Event(), threading.Event()
        self.closed = threading.Event()

    def make(self, *args: object) -> "_Slow":
        """As the libraries do; blocks."""
        self.begun.set()
        self.may_open.wait(20)
        return self

    def close(self) -> None:
        """As a port."""
        self.closed.set()

    shutdown = close  # as an adapter


def _open_port() -> Coroutine[Any, Any, object]:
    return opening.open_port(
        "/dev/ttyUSB9", baud=9600, on_data=lambda data: None, on_loss=lambda what: None
    )


def _open_adapter() -> Coroutine[Any, Any, object]:
    url = CanUrl.parse("can+socketcan://can0#1").bus
    return adapter.open_adapter(url, on_frame=lambda frame: None, on_loss=lambda what: None)


@pytest.mark.parametrize(
    ("place", "begin"),
    [
        (f"{opening.__name__}._open_port", _open_port),
        (f"{adapter.__name__}.open_bus", _open_adapter),
    ],
    ids=["port", "adapter"],
)
async def test_device_opened_after_a_cancellation_is_closed(
    monkeypatch: pytest.MonkeyPatch, place: str, begin: Callable[[], Coroutine[Any, Any, object]]
) -> None:
    """The cancelled task does not wait for it."""
    slow = _Slow()
    monkeypatch.setattr(place, slow.make)
    task = asyncio.create_task(begin())
    assert await asyncio.to_thread(slow.begun.wait, 20)
    task.cancel()
    await asyncio.wait({task})
    assert task.cancelled()
    assert not slow.closed.is_set()
    slow.may_open.set()
    assert await asyncio.to_thread(slow.closed.wait, 20)
