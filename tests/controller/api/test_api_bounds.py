"""Bounds of one connection to the daemon, to the byte and the request, on a clock of our own."""

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
    """A client that reads nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.waiting = b""
        self.is_aborted = False

    def is_closing(self) -> bool:
        """Whether it was left."""
        return self.is_aborted

    def is_reading(self) -> bool:
        """Always."""
        return True

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Keep it: nobody takes it."""
        self.waiting += bytes(data)

    def get_write_buffer_size(self) -> int:
        """All that was written."""
        return len(self.waiting)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Nothing to do."""

    def abort(self) -> None:
        """Be left."""
        self.is_aborted = True


async def turns() -> None:
    """Let the event loop run on."""
    for _ in range(4):
        await asyncio.sleep(0)


def made(now: Callable[[], float]) -> tuple[Connection, Wire]:
    """A connection to a client that reads nothing."""
    connection = Connection(
        on_connect=lambda one: True,
        on_lines=lambda one: None,
        on_disconnect=lambda one: None,
        clock=now,
    )
    wire = Wire()
    connection.connection_made(wire)
    return connection, wire


def test_answers_that_nobody_reads_are_bounded() -> None:
    """256 KiB of them may wait; one more byte, and the client is left. One long answer may go."""
    connection, wire = made(lambda: 0.0)
    connection.respond(b"x" * (MAX_UNREAD_BYTES - 1))
    connection.respond(b"\n")
    assert (len(wire.waiting), wire.is_aborted) == (1 << 18, False)
    connection.respond(b"\n")
    assert (len(wire.waiting), wire.is_aborted) == (1 << 18, True)
    connection, wire = made(lambda: 0.0)
    connection.respond(b"x" * (4 * MAX_UNREAD_BYTES))
    assert (len(wire.waiting), wire.is_aborted) == (1 << 20, False)


async def test_nobody_is_too_busy_to_stop() -> None:
    """After 2000 requests in a moment the next is refused, but a stop and a touch are not."""
    asked: list[str] = []

    def does(name: str) -> Callable[[Connection, Message], Message]:
        def handle(client: Connection, params: Message) -> Message:
            asked.append(name)
            return METHODS[name].result.model_construct()

        return handle

    server = ApiServer(
        {name: does(name) for name in METHODS},
        on_disconnect=lambda client: None,
        is_protected=lambda client: True,
        clock=lambda: 0.0,
    )
    connection = server._make_connection()
    connection.connection_made(Wire())

    async def ask(method: str, params: str = "{}") -> None:
        line = f'{{"jsonrpc":"2.0","method":"{method}","params":{params}}}\n'
        connection.data_received(line.encode())
        await turns()

    for _ in range(int(MAX_REQUEST_RATE) + 1):
        await ask("disarm")
    assert asked == ["disarm"] * 2000
    await ask("stop")
    await ask("touch", '{"source":"a","touches":[]}')
    await ask("clear")
    assert asked[2000:] == ["stop", "touch"]


async def test_the_next_telling_waits_for_its_time() -> None:
    """What was told at a moment is told again a sixtieth of a second later at the earliest."""
    now = 100.0
    hub = Hub({}, clock=lambda: now)
    connection, wire = made(lambda: now)
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
