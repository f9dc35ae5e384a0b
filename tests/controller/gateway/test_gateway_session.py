"""Requests that are pending when a browser disconnects."""

import asyncio
import json
from typing import Any

import pytest

from controller.api.schema import Message
from controller.gateway.session import Session

PARAMS = {"arm": {"owner": "browser", "lease_s": 60}}


class Socket:
    """A WebSocket that sends one request and disconnects."""

    def __init__(self, method: str) -> None:
        params = PARAMS.get(method, {})
        request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        self._messages = [
            {"type": "websocket.receive", "text": json.dumps(request)},
            {"type": "websocket.disconnect"},
        ]

    async def receive(self) -> dict[str, Any]:
        """The next message."""
        return self._messages.pop(0)


class Daemon:
    """A daemon that responds when it may, and records its calls."""

    def __init__(self) -> None:
        self.is_called = asyncio.Event()
        self.may_respond = asyncio.Event()
        self.completed: list[str] = []

    async def call(self, method: str, params: Message) -> dict[str, Any]:
        """Complete when it may."""
        self.is_called.set()
        await self.may_respond.wait()
        self.completed.append(method)
        return {}


@pytest.mark.parametrize(
    ("method", "completed"), [("arm", ["arm", "disarm"]), ("stop", ["stop"]), ("clear", ["clear"])]
)
async def test_session_completes_pending_requests_after_a_disconnect(
    method: str, completed: list[str]
) -> None:
    """No stop is cancelled, and nothing stays armed by a lease that cannot be renewed."""
    daemon = Daemon()
    session = Session(
        Socket(method),  # type: ignore[arg-type]
        daemon,
        current=lambda topic: None,
        clock=asyncio.get_running_loop().time,
    )
    running = asyncio.create_task(session.run())
    async with asyncio.timeout(10):
        await daemon.is_called.wait()
        for _ in range(5):
            await asyncio.sleep(0)  # the session learns of the disconnect
        daemon.may_respond.set()
        await running
    assert daemon.completed == completed
