"""The API's server in memory: its methods only record their calls, its clients read nothing."""

import asyncio
import json
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import virtual_loop
from controller.api.connection import Connection
from controller.api.registered import METHODS
from controller.api.schema import Empty, Message
from controller.api.server import ApiServer


class Wire(asyncio.Transport):
    """Transport of a client that reads nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.waiting = b""
        self.is_aborted = False
        self.is_read = True

    def lines(self) -> list[dict[str, Any]]:
        """Take the lines that were written, as JSON."""
        lines, self.waiting = self.waiting.splitlines(), b""
        return [json.loads(line) for line in lines]

    def is_closing(self) -> bool:
        """Whether it was closed."""
        return self.is_aborted

    def resume_reading(self) -> None:
        """Note it."""
        self.is_read = True

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Keep the data as unread."""
        self.waiting += bytes(data)

    def get_write_buffer_size(self) -> int:
        """Size of the unread data."""
        return len(self.waiting)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Do nothing."""

    def pause_reading(self) -> None:
        """Note it."""
        self.is_read = False

    def abort(self) -> None:
        """Close."""
        self.is_aborted = True

    close = abort


def request(method: str, params: str = "{}", *, id: str | int | None = None) -> bytes:
    """A line with a request, without an id unless one is given."""
    head = "" if id is None else f'"id":{id},'
    return f'{{"jsonrpc":"2.0",{head}"method":"{method}","params":{params}}}\n'.encode()


def feed(client: Connection, data: bytes) -> None:
    """Let a client send bytes, whose reading takes no processor time."""
    virtual_loop.feed(client, data)
    client.reading_time = 0.0


class ServedApi:
    """A server whose methods take a processor time [s] each, as does a reading of it; clock [s].

    calls: name, parameters and time of each; is_busy: whether a touch is on its way to the wire;
    may_arm: what arming waits for; called: called with each name, and its exceptions are those of
    the method; stops: how often the server itself has stopped all.
    """

    def __init__(
        self,
        *,
        clock: Callable[[], float] = lambda: 0.0,
        costs: float = 0.0,
        reading_costs: float = 0.0,
    ) -> None:
        self.calls: list[tuple[str, Message, float]] = []
        self.is_busy = False
        self.may_arm = asyncio.Event()
        self.stops = 0
        self.called: Callable[[str], object] = lambda name: None
        self._processor_time = 0.0
        self.clock = clock
        self._costs, self._reading_costs = costs, reading_costs
        self._clients: list[Connection] = []
        self._server = ApiServer(
            {name: partial(self._handle, name) for name in METHODS},
            on_disconnect=lambda client: None,
            holds_lease=lambda client: False,
            is_busy=lambda: self.is_busy,
            stop_all=self._stop_all,
            clock=clock,
            processor_time=self._read_processor_time,
        )

    @property
    def names(self) -> list[str]:
        """Names of the methods called."""
        return [name for name, _, _ in self.calls]

    def times(self, method: str) -> list[float]:
        """When a method was called [s]."""
        return [time for name, _, time in self.calls if name == method]

    def client(self, *, process: int = 1) -> tuple[Connection, Wire]:
        """A client of a process."""
        client, wire = self._server._make_connection(process), Wire()
        client.connection_made(wire)
        self._clients.append(client)
        return client, wire

    async def takes(self, client: Connection, data: bytes) -> None:
        """Let a client send bytes, and serve what is to be served at once."""
        feed(client, data)
        await self.settle()

    async def settle(self) -> None:
        """Run the event loop until nothing is left to be served at once, and a little longer."""
        left = 8
        while left:
            await asyncio.sleep(0)
            left = 8 if any(client.has_lines for client in self._clients) else left - 1

    def _read_processor_time(self) -> float:
        self._processor_time += self._reading_costs
        return self._processor_time

    def _stop_all(self) -> None:
        self.stops += 1

    def _handle(
        self, name: str, client: Connection, params: Message
    ) -> Message | Awaitable[Message]:
        self._processor_time += self._costs
        self.calls.append((name, params, self.clock()))
        self.called(name)
        if name == "play":
            raise KeyError("a bug, with /a/path in it")
        return self._arm() if name == "arm" else METHODS[name].result.model_construct(state="FAULT")

    async def _arm(self) -> Message:
        await self.may_arm.wait()
        return Empty()


def serving() -> tuple[ServedApi, Connection, Wire]:
    """A server with one client."""
    served = ServedApi()
    return served, *served.client()
