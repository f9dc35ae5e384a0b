"""Bounds of one connection, to the byte and the request, in virtual time."""

import asyncio
from collections.abc import Callable
from typing import cast

from controller.api.connection import MAX_REQUEST_RATE, MAX_UNREAD_BYTES, Connection
from controller.api.hub import Hub
from controller.api.methods import METHODS
from controller.api.schema import MAX_RATE, Message
from controller.api.server import ApiServer
from controller.api.topics import ContactsEvent


class Wire(asyncio.Transport):
    """Transport of a client that reads nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.waiting = b""
        self.is_aborted = False

    def is_closing(self) -> bool:
        """Whether it was closed."""
        return self.is_aborted

    def is_reading(self) -> bool:
        """Whether it reads: always."""
        return True

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Keep the data as unread."""
        self.waiting += bytes(data)

    def get_write_buffer_size(self) -> int:
        """Size of the unread data."""
        return len(self.waiting)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Do nothing."""

    def abort(self) -> None:
        """Close."""
        self.is_aborted = True


async def iterate() -> None:
    """Run the event loop for a few iterations."""
    for _ in range(4):
        await asyncio.sleep(0)


def connect(now: Callable[[], float]) -> tuple[Connection, Wire]:
    """A connection and its transport."""
    connection = Connection(
        on_connect=lambda one: True,
        on_lines=lambda one: None,
        on_disconnect=lambda one: None,
        clock=now,
    )
    wire = Wire()
    connection.connection_made(wire)
    return connection, wire


def test_connection_closes_when_unread_responses_exceed_256_kib() -> None:
    """At 256 KiB and a byte; a single response may be longer."""
    connection, wire = connect(lambda: 0.0)
    connection.respond(b"x" * (MAX_UNREAD_BYTES - 1))
    connection.respond(b"\n")
    assert (len(wire.waiting), wire.is_aborted) == (1 << 18, False)
    connection.respond(b"\n")
    assert (len(wire.waiting), wire.is_aborted) == (1 << 18, True)
    connection, wire = connect(lambda: 0.0)
    connection.respond(b"x" * (4 * MAX_UNREAD_BYTES))
    assert (len(wire.waiting), wire.is_aborted) == (1 << 20, False)


async def test_server_limits_the_request_rate_except_for_stop_and_touch() -> None:
    """After 2000 requests at once the next is refused; stop and touch are served."""
    served: list[str] = []

    def handler(name: str) -> Callable[[Connection, Message], Message]:
        def handle(client: Connection, params: Message) -> Message:
            served.append(name)
            return METHODS[name].result.model_construct()

        return handle

    server = ApiServer(
        {name: handler(name) for name in METHODS},
        on_disconnect=lambda client: None,
        is_protected=lambda client: True,
        clock=lambda: 0.0,
    )
    connection = server._make_connection()
    connection.connection_made(Wire())

    async def send(method: str, params: str = "{}") -> None:
        line = f'{{"jsonrpc":"2.0","method":"{method}","params":{params}}}\n'
        connection.data_received(line.encode())
        await iterate()

    for _ in range(int(MAX_REQUEST_RATE) + 1):
        await send("disarm")
    assert served == ["disarm"] * 2000
    await send("stop")
    await send("touch", '{"source":"a","touches":[]}')
    await send("clear")
    assert served[2000:] == ["stop", "touch"]


async def test_hub_sends_a_coalesced_topic_at_most_sixty_times_per_second() -> None:
    """The flush after one at this moment is a sixtieth of a second later."""
    now = 100.0
    hub = Hub({}, clock=lambda: now)
    connection, wire = connect(lambda: now)
    hub.subscribe(connection, ["contacts"])
    loop = asyncio.get_running_loop()

    def publish() -> float:
        before = loop.time()
        hub.publish("contacts", lambda: ContactsEvent(contacts=[]))
        return cast(asyncio.TimerHandle, hub._flush).when() - before

    assert publish() < 1 / MAX_RATE
    await asyncio.sleep(0.01)
    assert wire.waiting
    assert publish() >= 1 / MAX_RATE - 1e-6
    cast(asyncio.TimerHandle, hub._flush).cancel()
    hub._flush = None
    now += 1.0
    assert publish() < 1 / MAX_RATE
    hub.close()
