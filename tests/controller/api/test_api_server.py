"""The API's server under clients that do not behave: bounds, turns, and what is told to whom."""

import asyncio
import contextlib
import json
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from controller.api.connection import MAX_UNREAD_BYTES, Connection
from controller.api.hub import Hub
from controller.api.methods import METHODS, EffectsResult, TouchParams
from controller.api.schema import Empty, Message
from controller.api.server import MAX_CONNECTIONS, ApiServer
from controller.api.topics import LogEvent
from daemon_bench import until


@dataclass
class Served:
    """A server whose methods do next to nothing, and what it was asked."""

    path: Path
    hub: Hub
    asked: list[str] = field(default_factory=list)
    touched: list[tuple[str, float]] = field(default_factory=list)  # source, and first finger's x
    gate: asyncio.Event = field(default_factory=asyncio.Event)
    left: list[Connection] = field(default_factory=list)
    clients: set[Connection] = field(default_factory=set)
    wires: "list[Wire]" = field(default_factory=list)

    async def connect(self) -> "Wire":
        """A raw connection."""
        wire = Wire(*await asyncio.open_unix_connection(str(self.path), limit=1 << 22))
        self.wires.append(wire)
        return wire


@dataclass
class Wire:
    """A client that writes what it likes."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    def send(self, line: bytes) -> None:
        """Bytes as they are."""
        self.writer.write(line)

    def ask(self, method: str, params: str = "{}", *, id: int = 1) -> None:
        """A request."""
        said = f'{{"jsonrpc":"2.0","id":{id},"method":"{method}","params":{params}}}\n'
        self.send(said.encode())

    async def line(self) -> dict[str, object]:
        """The next line of the server; {} at its end."""
        line = await asyncio.wait_for(self.reader.readline(), 20)
        return json.loads(line) if line else {}

    async def error(self) -> object:
        """The code of the next line, which is an error."""
        error = (await self.line())["error"]
        assert isinstance(error, dict)
        return error["code"]

    async def close(self) -> None:
        """Hang up."""
        self.writer.close()
        with contextlib.suppress(OSError):
            await self.writer.wait_closed()


@asynccontextmanager
async def serving(folder: Path) -> AsyncIterator[Served]:
    """A server on a socket of its own."""
    hub = Hub({"state": lambda: None}, clock=time.monotonic)
    made = Served(folder / "s", hub)

    def does(name: str) -> Callable[[Connection, Message], Message | Awaitable[Message]]:
        async def later() -> Message:
            await made.gate.wait()
            return Empty()

        def handle(client: Connection, params: Message) -> Message | Awaitable[Message]:
            made.asked.append(name)
            made.clients.add(client)
            if isinstance(params, TouchParams) and params.touches:
                made.touched.append((params.source, params.touches[0].x_m))
            if name == "subscribe":
                hub.subscribe(client, ["log"])
            if name == "play":
                raise KeyError("a bug, with /a/path in it")
            return later() if name == "arm" else METHODS[name].result.model_construct()

        return handle

    server = ApiServer(
        {
            **{name: does(name) for name in METHODS},
            "effects": lambda client, params: EffectsResult(effects=[]),
        },
        left=made.left.append,
        keeps=hub.is_subscribed,
    )
    bound = socket.socket(socket.AF_UNIX)
    bound.bind(str(made.path))
    await server.open(bound)
    try:
        yield made
    finally:
        made.gate.set()
        for wire in made.wires:
            await wire.close()
        hub.close()
        await server.close()


@pytest.fixture
async def served(tmp_path: Path) -> AsyncIterator[Served]:
    """A server for one test."""
    async with serving(tmp_path) as made:
        yield made


ARM = '{"owner":"me","lease_s":5}'


async def test_a_bad_line_spoils_no_other(served: Served) -> None:
    """Garbage, no request and an unknown method are answered, and the next line is served."""
    wire = await served.connect()
    wire.send(b"garbage\n\n\xff\n[]\n")
    wire.ask("no_such_method")
    wire.ask("disarm", '{"level": 2}')
    wire.ask("disarm", id=9)
    codes = [await wire.error() for _ in range(6)]
    assert codes == [-32700, -32700, -32700, -32600, -32601, -32602]
    assert (await wire.line()) == {"jsonrpc": "2.0", "id": 9, "result": {}}
    assert served.asked == ["disarm"]


async def test_a_request_in_pieces_and_several_in_one(served: Served) -> None:
    """How bytes arrive does not matter."""
    wire = await served.connect()
    line = b'{"jsonrpc":"2.0","id":1,"method":"disarm"}\n'
    for byte in line:
        wire.send(bytes([byte]))
        await asyncio.sleep(0)
    wire.send(line * 3)
    assert [(await wire.line())["id"] for _ in range(4)] == [1, 1, 1, 1]


async def test_a_line_may_have_64_kib_and_no_more(served: Served) -> None:
    """65 536 bytes with the line feed are served; one more ends the connection, nothing is done."""
    head, tail = b'{"jsonrpc":"2.0","id":1,"method":"disarm"', b"}\n"
    wire = await served.connect()
    wire.send(head + b" " * ((1 << 16) - len(head) - len(tail)) + tail)
    assert "result" in await wire.line()
    wire.send(head + b" " * ((1 << 16) - len(head) - len(tail) + 1) + tail)
    assert await wire.error() == -32700
    assert await wire.line() == {}
    endless = await served.connect()
    endless.send(b"x" * (1 << 16))
    assert await endless.error() == -32700
    assert await endless.line() == {}
    assert served.asked == ["disarm"]


async def test_notifications_of_clients_get_no_answer(served: Served) -> None:
    """Without an id not even an error is told."""
    wire = await served.connect()
    wire.send(b'{"jsonrpc":"2.0","method":"disarm"}\n{"jsonrpc":"2.0","method":"nothing"}\n')
    wire.ask("effects", id=5)
    assert (await wire.line())["id"] == 5
    assert served.asked == ["disarm"]


async def test_nothing_is_armed_for_nobody(served: Served) -> None:
    """Without an id the lease would be told to nobody: such a request is not even begun."""
    wire = await served.connect()
    wire.send(b'{"jsonrpc":"2.0","method":"arm","params":' + ARM.encode() + b"}\n")
    wire.ask("disarm", id=5)
    assert (await wire.line())["id"] == 5
    assert served.asked == ["disarm"]


async def test_a_bug_in_a_method_is_told_without_its_details(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    """Code -32603; what went wrong stands in the log, not in the answer."""
    wire = await served.connect()
    wire.ask("play", '{"effect":"x","x_m":0,"y_m":0}')
    said = json.dumps(await wire.line())
    assert "-32603" in said
    assert "/a/path" not in said
    assert "/a/path" in caplog.text


async def test_a_stop_waits_for_nothing(served: Served) -> None:
    """While requests that take long are under way, and no more are taken, a stop is done."""
    wire = await served.connect()
    for id in range(10):
        wire.ask("arm", ARM, id=id)
    wire.ask("stop", id=99)
    lines = [await wire.line() for _ in range(3)]
    assert {line["id"] for line in lines} == {8, 9, 99}
    assert [line["error"]["code"] for line in lines if "error" in line] == [1005, 1005]  # type: ignore[index]
    served.gate.set()
    assert {(await wire.line())["id"] for _ in range(8)} == set(range(8))


async def test_a_client_that_said_its_last_still_gets_its_answers(served: Served) -> None:
    """As with a line that is piped in: end of input, then the answers, then the end."""
    wire = await served.connect()
    wire.ask("arm", ARM)
    wire.ask("disarm", id=2)
    wire.writer.write_eof()
    assert (await wire.line())["id"] == 2
    served.gate.set()
    assert (await wire.line())["id"] == 1
    assert await wire.line() == {}


async def test_requests_are_bounded_but_not_stops_and_touches(served: Served) -> None:
    """2000 at once are served, then it is too busy; stops and touches are served all the same."""
    wire = await served.connect()
    line = b'{"jsonrpc":"2.0","id":1,"method":"disarm"}\n'
    touch = b'{"jsonrpc":"2.0","id":1,"method":"touch","params":{"source":"a","touches":[]}}\n'
    count = 12_000
    wire.send(line * count)
    answers = [await wire.line() for _ in range(count)]
    refused = [answer for answer in answers if "error" in answer]
    assert served.asked.count("disarm") == count - len(refused)
    assert all(answer["error"]["code"] == 1005 for answer in refused)  # type: ignore[index]
    assert served.asked.count("disarm") >= 2000
    assert refused
    wire.send(touch * 3000)
    wire.ask("stop", id=2)
    assert all("result" in answer for answer in [await wire.line() for _ in range(3001)])


async def test_a_flood_leaves_the_loop_to_others(served: Served) -> None:
    """However much is sent, a turn serves little of it: others run again and again meanwhile."""
    wire = await served.connect()
    wire.send(b'{"jsonrpc":"2.0","method":"touch"}\n' * 20_000)
    wire.send(b'{"jsonrpc":"2.0","method":"stop"}\n')
    turns = 0
    while "stop" not in served.asked:
        await asyncio.sleep(0)
        turns += 1
    assert turns > 50


async def test_of_touches_that_wait_the_newest_counts(served: Served) -> None:
    """One that wants no answer gives way to the next of its source, and only to that.

    Not to another source's, nor where something else is asked in between, nor where an answer is
    wanted, nor to what is no touch after all.
    """

    def touch(source: str, *, x: float, id: str = "") -> bytes:
        params = f'{{"source":"{source}","touches":[{{"id":1,"x_m":{x},"y_m":0.1}}]}}'
        return f'{{"jsonrpc":"2.0",{id}"method":"touch","params":{params}}}\n'.encode()

    wire = await served.connect()
    lines = [touch("a", x=0.01 * number) for number in range(4)]  # the last one counts
    lines += [touch("b", x=0.04), touch("a", x=0.05)]
    lines += [b'{"jsonrpc":"2.0","method":"disarm"}\n', touch("a", x=0.06, id='"id":7,')]
    lines += [touch("a", x=0.07), b'{"jsonrpc":"2.0","method":"touch","params":{"source":"a"}}\n']
    refused = [
        touch("a", x=0.5).replace(b"0.1}", b'"here"}'),
        touch("a", x=0.5).replace(b'"2.0"', b'"1.0"'),
        touch("a", x=0.5).replace(b'"method"', b'"more":1,"method"'),
    ]
    for number, line in enumerate(refused):  # what is refused takes nobody's place, a lift's least
        lines += [touch("a", x=0.08 + 0.01 * number), line]
    wire.send(b"".join(lines))
    wire.ask("stop", id=8)
    # Two of the refused are no requests at all, which is told without a number.
    assert [(await wire.line())["id"] for _ in range(4)] == [7, None, None, 8]
    before = [("a", 0.03), ("b", 0.04), ("a", 0.05), ("a", 0.06), ("a", 0.07)]
    assert served.touched == [*before, ("a", 0.08), ("a", 0.09), ("a", 0.1)]


async def test_what_a_touch_sets_off_goes_before_the_next_turn(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two turns there is room for what came in and for what that has woken."""
    monkeypatch.setattr("controller.api.server.MAX_TURN_TIME", 0.0)  # a line each
    loop = asyncio.get_running_loop()
    order: list[str] = []

    class Asked(list[str]):
        def append(self, name: str) -> None:
            order.append(name)
            if order == ["status"]:
                loop.call_soon(comes_in)

    def comes_in() -> None:
        order.append("touch")
        loop.call_soon(order.append, "command")

    served.asked = Asked()
    wire = await served.connect()
    for number in range(3):
        wire.ask("status", id=number)
    await until(lambda: order.count("status") == 3)
    assert order[:4] == ["status", "touch", "command", "status"]


async def test_thirty_two_clients_and_no_more(served: Served) -> None:
    """The next is told that it is too busy; a place that is given up is free again."""
    wires = [await served.connect() for _ in range(MAX_CONNECTIONS)]
    for wire in wires:
        wire.ask("effects")
        assert "result" in await wire.line()
    late = await served.connect()
    assert await late.error() == 1005
    assert await late.line() == {}
    await wires[0].close()
    await asyncio.sleep(0.05)
    again = await served.connect()
    again.ask("stop")
    assert "result" in await again.line()


async def test_who_says_nothing_gives_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of idle clients cannot keep anybody from stopping; who listens is left alone."""
    monkeypatch.setattr("controller.api.server.IDLE_TIMEOUT", 0.2)
    async with serving(tmp_path) as served:
        listener = await served.connect()
        listener.ask("subscribe", '{"topics":["log"]}')
        assert "result" in await listener.line()
        idle = [await served.connect() for _ in range(200)]
        await asyncio.sleep(0.3)
        wire = await served.connect()
        wire.ask("stop")
        assert "result" in await wire.line()
        served.hub.publish("log", lambda: LOG)
        assert (await listener.line())["method"] == "event"
        for each in idle:
            await each.close()


LOG = LogEvent(level="info", message="x" * 500, cause=None, remedy=None)


async def test_who_does_not_read_loses_notifications_then_the_connection(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What waits for it stays bounded, the next that arrives says how many were lost."""
    monkeypatch.setattr("controller.api.connection.UNREAD_TIMEOUT", 1.0)
    deaf = socket.socket(socket.AF_UNIX)
    deaf.connect(str(served.path))
    deaf.sendall(b'{"jsonrpc":"2.0","id":1,"method":"subscribe","params":{"topics":["log"]}}\n')
    await until(lambda: served.asked)
    (client,) = served.clients
    for _ in range(5000):
        served.hub.publish("log", lambda: LOG)
    assert client._transport is not None
    assert client._transport.get_write_buffer_size() < MAX_UNREAD_BYTES
    read = b""
    deaf.setblocking(False)
    for _ in range(50):
        try:
            read += deaf.recv(1 << 20)
        except BlockingIOError:
            await asyncio.sleep(0.001)
    served.hub.publish("log", lambda: LOG)
    await asyncio.sleep(0.01)
    read += deaf.recv(1 << 20)
    *_, last = [json.loads(line) for line in read.splitlines() if line.endswith(b"}}")]
    lines = read.count(b'"method":"event"')
    assert last["params"]["lost"] == 5001 - lines
    for _ in range(5000):
        served.hub.publish("log", lambda: LOG)
    assert client.is_open
    await asyncio.sleep(1.05)
    served.hub.publish("log", lambda: LOG)
    await asyncio.sleep(0)
    assert not client.is_open
    deaf.close()


async def test_who_does_not_read_its_answers_loses_the_connection(served: Served) -> None:
    """Answers are not lost one by one: whoever lets 256 KiB of them wait is left."""
    deaf = socket.socket(socket.AF_UNIX)
    deaf.connect(str(served.path))
    deaf.setblocking(False)
    sent = 0
    while not served.left and sent < 1 << 26:
        try:
            sent += deaf.send(b"garbage\n" * 1000)
        except BlockingIOError:
            pass
        except OSError:
            break
        await asyncio.sleep(0)
    await asyncio.sleep(0.01)
    assert len(served.left) == 1
    deaf.close()


async def test_what_changes_often_is_told_sixty_times_a_second(served: Served) -> None:
    """Of a thousand contact changes in a moment the newest counts; states are told one by one."""
    wire = await served.connect()
    wire.ask("subscribe", '{"topics":["log"]}')
    await wire.line()
    (client,) = served.clients
    served.hub.subscribe(client, ["silence"])
    made = 0

    def make() -> Message:
        nonlocal made
        made += 1
        return LOG

    for _ in range(1000):
        served.hub.publish("silence", make)
    for _ in range(3):
        served.hub.publish("log", lambda: LOG)
    await asyncio.sleep(0.1)
    assert made == 1
    topics = [(await wire.line())["params"]["topic"] for _ in range(4)]  # type: ignore[index]
    assert topics == ["log", "log", "log", "silence"]


def test_a_method_without_a_handler_is_found_at_once() -> None:
    """Handlers and the table of methods agree when the server is made."""
    with pytest.raises(ValueError, match="differ in arm"):
        ApiServer({}, left=lambda client: None, keeps=lambda client: False)
