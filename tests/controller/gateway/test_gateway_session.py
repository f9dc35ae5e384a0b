"""Requests of browsers: what is carried out after one has left, and how stops are merged."""

import asyncio
import json
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.datastructures import Address

from controller.api.methods import RequestedBy, TouchParams
from controller.api.schema import Message
from controller.gateway.daemon_link import DaemonLink
from controller.gateway.session import Session

ARM = {"owner": "page", "lease_s": 60}


class Socket:
    """A WebSocket that sends requests and disconnects when it may."""

    client = Address("127.0.0.1", 5000)

    def __init__(self, *methods: str, id: int | None = 1) -> None:
        head = {"jsonrpc": "2.0"} if id is None else {"jsonrpc": "2.0", "id": id}
        self._requests = [
            head | {"method": method, "params": ARM if method == "arm" else {}}
            for method in methods
        ]
        self.may_leave = asyncio.Event()
        self.sent: list[dict[str, Any]] = []

    def request(self, method: str, params: dict[str, Any]) -> None:
        """Have one more request sent, without an id."""
        self._requests.append({"jsonrpc": "2.0", "method": method, "params": params})

    async def receive(self) -> dict[str, Any]:
        """The next message."""
        if self._requests:
            return {"type": "websocket.receive", "text": json.dumps(self._requests.pop(0))}
        await self.may_leave.wait()
        return {"type": "websocket.disconnect"}

    async def send_text(self, frame: str) -> None:
        """Keep the frame."""
        self.sent.append(json.loads(frame))


class Daemon:
    """A daemon that responds when it may, and records its calls."""

    def __init__(self) -> None:
        self.may_respond = asyncio.Event()
        self.calls: list[tuple[str, Message]] = []

    async def call(self, method: str, params: Message) -> dict[str, Any]:
        """Complete when it may."""
        self.calls.append((method, params))
        await self.may_respond.wait()
        return {"lease": "a-lease"}


async def iterate() -> None:
    """Run everything that needs no further event."""
    for _ in range(50):
        await asyncio.sleep(0)


async def run_session(
    socket: Socket, *, leaves_at_once: bool = False
) -> Sequence[tuple[str, Message]]:
    """The calls of a session whose browser leaves before the daemon responds."""
    daemon = Daemon()
    session = Session(
        socket,  # type: ignore[arg-type]
        daemon,  # type: ignore[arg-type]
        current=lambda topic: None,
        clock=asyncio.get_running_loop().time,
    )
    if leaves_at_once:
        socket.may_leave.set()
    running = asyncio.create_task(session.run())
    await iterate()
    socket.may_leave.set()
    await iterate()
    daemon.may_respond.set()
    await asyncio.wait_for(running, 10)
    return daemon.calls


@pytest.mark.parametrize("method", ["stop", "clear"])
async def test_session_completes_pending_requests_after_a_disconnect(method: str) -> None:
    """No stop is cancelled; each names its browser for the log."""
    ((called, params),) = await run_session(Socket(method), leaves_at_once=True)
    assert called == method
    assert isinstance(params, RequestedBy)
    assert params.client is not None
    assert params.client.endswith(" 127.0.0.1:5000")


async def test_arm_of_a_browser_that_leaves_arms_nothing() -> None:
    """Not sent if it has left or wants no response; else ended, by its own lease alone."""
    assert await run_session(Socket("arm"), leaves_at_once=True) == []
    assert await run_session(Socket("arm", id=None)) == []
    (arm, _), (disarm, params) = await run_session(Socket("arm"))
    assert (arm, disarm) == ("arm", "disarm")
    assert params.lease == "a-lease"  # type: ignore[attr-defined]


async def test_fingers_that_come_and_go_during_a_round_trip_reach_the_daemon() -> None:
    """The newest frame, and before it each with a finger that the next one does not have."""
    socket, daemon = Socket(), Daemon()
    session = Session(
        socket,  # type: ignore[arg-type]
        daemon,  # type: ignore[arg-type]
        current=lambda topic: None,
        clock=asyncio.get_running_loop().time,
    )
    for ids in ((), (1,), (1, 2), (), (3,), (3, 4)):
        touches = [{"id": id, "x_m": 0.1, "y_m": 0.1} for id in ids]
        params = {"source": "page", "touches": touches}
        socket.request("touch", params)
    running = asyncio.create_task(session.run())
    await iterate()
    daemon.may_respond.set()
    await iterate()
    socket.may_leave.set()
    await asyncio.wait_for(running, 10)
    frames = [params for method, params in daemon.calls if method == "touch"]
    assert all(isinstance(params, TouchParams) for params in frames)
    sent = [[each.id for each in params.touches] for params in frames]  # type: ignore[attr-defined]
    assert sent[-3:] == [[1, 2], [3, 4], []]  # lifted at the end
    assert sent[0] in ([], [1, 2])


async def test_stops_of_browsers_are_merged_and_none_is_refused() -> None:
    """Of 200 stops during one, all get the result of the next; the daemon sees two."""
    link = DaemonLink(None, on_hello=print, on_event=print)  # type: ignore[arg-type]
    daemon = Daemon()
    link._channel = SimpleNamespace(request=daemon.call)  # type: ignore[assignment]
    stops: list[asyncio.Task[object]] = []
    for count in (1, 199):  # the others while the first is being carried out
        work = [link.call("stop", RequestedBy(client="a")) for _ in range(count)]
        stops += map(asyncio.create_task, work)
        await iterate()
    assert len(daemon.calls) == 1
    stops[150].cancel()  # a browser that leaves takes no other's stop with it
    daemon.may_respond.set()
    results = await asyncio.gather(*stops, return_exceptions=True)
    assert [each for each in results if each != {"lease": "a-lease"}] == [results[150]]
    assert len(daemon.calls) == 2


async def test_session_reads_on_only_while_few_stops_are_pending() -> None:
    """Thousands of stops make no thousands of tasks; none is lost."""
    calls = await run_session(Socket(*["stop"] * 1000))
    assert len(calls) == 1000
