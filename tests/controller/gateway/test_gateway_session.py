"""What a browser has asked for when it leaves."""

import asyncio
import json
from typing import Any

import pytest

from controller.api.schema import Message
from controller.gateway.session import Session


class Socket:
    """A browser that says these methods, one after the other, and leaves."""

    def __init__(self, *methods: str) -> None:
        self._says = [
            {"jsonrpc": "2.0", "id": 1, "method": method, "params": _PARAMS.get(method, {})}
            for method in methods
        ]

    async def receive(self) -> dict[str, Any]:
        """As of a WebSocket."""
        if self._says:
            return {"type": "websocket.receive", "text": json.dumps(self._says.pop(0))}
        return {"type": "websocket.disconnect"}


_PARAMS = {"arm": {"owner": "browser", "lease_s": 60}}


class Daemon:
    """Answers once it may, and notes what it was asked and has answered."""

    def __init__(self) -> None:
        self.may_answer = asyncio.Event()
        self.asked: list[str] = []
        self.answered: list[str] = []

    async def call(self, method: str, params: Message) -> dict[str, Any]:
        """As the way to the daemon."""
        self.asked.append(method)
        await self.may_answer.wait()
        self.answered.append(method)
        return {}


@pytest.mark.parametrize(
    ("method", "answered"), [("arm", ["arm", "disarm"]), ("stop", ["stop"]), ("clear", ["clear"])]
)
async def test_what_was_asked_before_it_left_is_seen_through(
    method: str, answered: list[str]
) -> None:
    """No stop is taken back, and nothing stays armed by a lease that nobody knows."""
    daemon = Daemon()
    session = Session(
        Socket(method),  # type: ignore[arg-type]
        daemon,
        current=lambda topic: None,
        clock=asyncio.get_running_loop().time,
    )
    running = asyncio.create_task(session.run())
    await asyncio.sleep(0.01)
    assert daemon.asked == [method]
    daemon.may_answer.set()
    await asyncio.wait_for(running, 10)
    assert daemon.answered == answered
