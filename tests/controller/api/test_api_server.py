"""The API's server with raw clients: bounds, fairness, and who receives what."""

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

from controller.api.connection import Connection
from controller.api.hub import Hub
from controller.api.methods import METHODS, EffectsResult, TouchParams
from controller.api.schema import Empty, Message
from controller.api.server import ApiServer
from daemon_bench import until

ARM = '{"owner":"me","lease_s":5}'


@dataclass
class Served:
    """A server whose methods only record their calls."""

    path: Path
    hub: Hub
    calls: list[str] = field(default_factory=list)
    touches: list[tuple[str, float]] = field(default_factory=list)  # source, and first finger's x
    fingers: list[tuple[int, ...]] = field(default_factory=list)  # their ids, frame by frame
    may_arm: asyncio.Event = field(default_factory=asyncio.Event)
    disconnected: list[Connection] = field(default_factory=list)
    clients: set[Connection] = field(default_factory=set)
    wires: "list[Wire]" = field(default_factory=list)

    async def connect(self) -> "Wire":
        """A raw connection."""
        wire = Wire(*await asyncio.open_unix_connection(str(self.path), limit=1 << 22))
        self.wires.append(wire)
        return wire


@dataclass
class Wire:
    """A raw client."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    def call(self, method: str, params: str = "{}", *, id: int = 1) -> None:
        """Send a request."""
        line = f'{{"jsonrpc":"2.0","id":{id},"method":"{method}","params":{params}}}\n'
        self.writer.write(line.encode())

    async def line(self) -> dict[str, object]:
        """The next line of the server; {} at the end."""
        line = await asyncio.wait_for(self.reader.readline(), 20)
        return json.loads(line) if line else {}

    async def error(self) -> object:
        """The code of the next line, an error."""
        error = (await self.line())["error"]
        assert isinstance(error, dict)
        return error["code"]

    async def close(self) -> None:
        """Close."""
        self.writer.close()
        with contextlib.suppress(OSError):
            await self.writer.wait_closed()


@asynccontextmanager
async def serving(
    folder: Path, *, clock: Callable[[], float] = time.monotonic
) -> AsyncIterator[Served]:
    """A server on a socket of its own; clock [s]."""
    hub = Hub({"state": lambda: None}, clock=time.monotonic)
    served = Served(folder / "s", hub)

    def handler(name: str) -> Callable[[Connection, Message], Message | Awaitable[Message]]:
        async def arm() -> Message:
            await served.may_arm.wait()
            return Empty()

        def handle(client: Connection, params: Message) -> Message | Awaitable[Message]:
            served.calls.append(name)
            served.clients.add(client)
            if isinstance(params, TouchParams):
                served.fingers.append(tuple(each.id for each in params.touches))
            if isinstance(params, TouchParams) and params.touches:
                served.touches.append((params.source, params.touches[0].x_m))
            if name == "subscribe":
                hub.subscribe(client, ["log"])
            if name == "play":
                raise KeyError("a bug, with /a/path in it")
            return arm() if name == "arm" else METHODS[name].result.model_construct()

        return handle

    server = ApiServer(
        {
            **{name: handler(name) for name in METHODS},
            "effects": lambda client, params: EffectsResult(effects=[]),
        },
        clock=clock,
        on_disconnect=served.disconnected.append,
        holds_lease=lambda client: False,
        is_subscribed=hub.is_subscribed,
    )
    bound = socket.socket(socket.AF_UNIX)
    bound.bind(str(served.path))
    await server.open(bound)
    try:
        yield served
    finally:
        served.may_arm.set()
        for wire in served.wires:
            await wire.close()
        hub.close()
        await server.close()


@pytest.fixture
async def served(tmp_path: Path) -> AsyncIterator[Served]:
    """A server for one test."""
    async with serving(tmp_path) as made:
        yield made


async def test_server_continues_after_invalid_lines(served: Served) -> None:
    """Invalid JSON, requests, methods and parameters get an error each; the next line is served."""
    wire = await served.connect()
    wire.writer.write(b"garbage\n\n\xff\n[]\n")
    wire.call("no_such_method")
    wire.call("disarm", '{"level": 2}')
    wire.call("disarm", id=9)
    codes = [await wire.error() for _ in range(6)]
    assert codes == [-32700, -32700, -32700, -32600, -32601, -32602]
    assert (await wire.line()) == {"jsonrpc": "2.0", "id": 9, "result": {}}
    assert served.calls == ["disarm"]


async def test_server_assembles_lines(served: Served) -> None:
    """A line in single bytes, and several lines at once."""
    wire = await served.connect()
    line = b'{"jsonrpc":"2.0","id":1,"method":"disarm"}\n'
    for byte in line:
        wire.writer.write(bytes([byte]))
        await asyncio.sleep(0)
    wire.writer.write(line * 3)
    assert [(await wire.line())["id"] for _ in range(4)] == [1, 1, 1, 1]


async def test_server_closes_when_a_line_exceeds_64_kib(served: Served) -> None:
    """65 536 bytes with the line feed are served; a byte more, complete or not, is refused."""
    head, tail = b'{"jsonrpc":"2.0","id":1,"method":"disarm"', b"}\n"
    wire = await served.connect()
    wire.writer.write(head + b" " * ((1 << 16) - len(head) - len(tail)) + tail)
    assert "result" in await wire.line()
    wire.writer.write(head + b" " * ((1 << 16) - len(head) - len(tail) + 1) + tail)
    endless = await served.connect()
    endless.writer.write(b"x" * (1 << 16))
    for each in (wire, endless):
        assert await each.error() == -32700
        assert await each.line() == {}
    assert served.calls == ["disarm"]


async def test_request_without_id_gets_no_response(served: Served) -> None:
    """Not even an error; and without an id nothing is armed, as its lease would be unknown."""
    wire = await served.connect()
    wire.writer.write(
        b'{"jsonrpc":"2.0","method":"disarm"}\n{"jsonrpc":"2.0","method":"nothing"}\n'
    )
    wire.writer.write(b'{"jsonrpc":"2.0","method":"arm","params":' + ARM.encode() + b"}\n")
    wire.call("effects", id=5)
    assert (await wire.line())["id"] == 5
    assert served.calls == ["disarm"]


async def test_bug_in_a_method_is_reported_without_details(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    """Code -32603; the details are in the log alone."""
    wire = await served.connect()
    wire.call("play", '{"effect":"x","x_m":0,"y_m":0}')
    response = json.dumps(await wire.line())
    assert "-32603" in response
    assert "/a/path" not in response
    assert "/a/path" in caplog.text


async def test_stop_is_served_while_requests_are_pending(served: Served) -> None:
    """Eight may be pending, further ones are refused, a stop is served at once."""
    wire = await served.connect()
    for id in range(10):
        wire.call("arm", ARM, id=id)
    wire.call("stop", id=99)
    lines = [await wire.line() for _ in range(3)]
    assert {line["id"] for line in lines} == {8, 9, 99}
    assert [line["error"]["code"] for line in lines if "error" in line] == [1005, 1005]  # type: ignore[index]
    served.may_arm.set()
    assert {(await wire.line())["id"] for _ in range(8)} == set(range(8))


async def test_client_that_closed_its_side_gets_pending_responses(served: Served) -> None:
    """End of input, then the responses, then the end; only arming is for those who stay."""
    wire = await served.connect()
    wire.call("stop")
    wire.call("arm", ARM, id=2)
    wire.writer.write_eof()
    answers = [await wire.line() for _ in range(2)]
    assert {each["id"]: "result" in each for each in answers} == {1: True, 2: False}
    assert await wire.line() == {}
    assert served.calls == ["stop"]


async def test_flood_leaves_the_event_loop_to_others(served: Served) -> None:
    """A turn serves little of 5000 lines: others run many times meanwhile."""
    wire = await served.connect()
    wire.writer.write(b'{"jsonrpc":"2.0","method":"effects"}\n' * 5_000)
    wire.writer.write(b'{"jsonrpc":"2.0","method":"stop"}\n')
    iterations = 0
    while "stop" not in served.calls:
        await asyncio.sleep(0)
        iterations += 1
    assert iterations > 50


async def test_touch_frame_is_superseded_by_the_next_of_its_source(served: Served) -> None:
    """Only by a valid frame of the same source without an id, directly after it."""

    def touch(source: str, *, x: float, id: str = "") -> bytes:
        params = f'{{"source":"{source}","touches":[{{"id":1,"x_m":{x},"y_m":0.1}}]}}'
        return f'{{"jsonrpc":"2.0",{id}"method":"touch","params":{params}}}\n'.encode()

    wire = await served.connect()
    lines = [touch("a", x=0.01 * number) for number in range(4)]  # the last one is served
    lines += [touch("b", x=0.04), touch("a", x=0.05)]
    lines += [b'{"jsonrpc":"2.0","method":"disarm"}\n', touch("a", x=0.06, id='"id":7,')]
    lines += [touch("a", x=0.07), b'{"jsonrpc":"2.0","method":"touch","params":{"source":"a"}}\n']
    invalid = [
        touch("a", x=0.5).replace(b"0.1}", b'"here"}'),
        touch("a", x=0.5).replace(b'"2.0"', b'"1.0"'),
        touch("a", x=0.5).replace(b'"method"', b'"more":1,"method"'),
    ]
    for number, line in enumerate(invalid):
        lines += [touch("a", x=0.08 + 0.01 * number), line]
    wire.writer.write(b"".join(lines))
    wire.call("stop", id=8)
    # Two of the invalid ones are not requests, hence errors without an id.
    assert [(await wire.line())["id"] for _ in range(4)] == [7, None, None, 8]
    before = [("a", 0.03), ("b", 0.04), ("a", 0.05), ("a", 0.06), ("a", 0.07)]
    assert served.touches == [*before, ("a", 0.08), ("a", 0.09), ("a", 0.1)]


async def test_touch_frame_with_a_finger_that_the_next_has_not_is_served(served: Served) -> None:
    """A tap whose frames come together is not lost; one more finger supersedes."""

    def touch(*ids: int) -> bytes:
        touches = ",".join(f'{{"id":{id},"x_m":0.{id},"y_m":0.1}}' for id in ids)
        params = f'{{"source":"a","touches":[{touches}]}}'
        return f'{{"jsonrpc":"2.0","method":"touch","params":{params}}}\n'.encode()

    wire = await served.connect()
    frames = [(1,), (2,), (2, 3), (3,), ()]
    wire.writer.write(b"".join(touch(*ids) for ids in frames))
    wire.call("stop", id=8)
    assert (await wire.line())["id"] == 8
    assert served.fingers == [(1,), (2, 3), (3,), ()]


async def test_control_loop_runs_between_iterations(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two iterations data is received, and what it wakes runs."""
    monkeypatch.setattr("controller.api.turns.MAX_TURN", 0.0)  # one line per iteration
    loop = asyncio.get_running_loop()
    order: list[str] = []

    class Calls(list[str]):
        def append(self, name: str) -> None:
            order.append(name)
            if order == ["status"]:
                loop.call_soon(touch)

    def touch() -> None:
        order.append("touch")
        loop.call_soon(order.append, "command")

    served.calls = Calls()
    wire = await served.connect()
    for number in range(3):
        wire.call("status", id=number)
    await until(lambda: order.count("status") == 3)
    assert order[:4] == ["status", "touch", "command", "status"]


async def test_stop_is_served_among_silent_and_asking_clients(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 160 silent connections after 32 that ask: a place in reserve stops, but does not arm.

    They are those of another process.
    """
    process = 1
    monkeypatch.setattr("controller.api.admission.credentials_of", lambda _: (process, 0))
    async with serving(tmp_path, clock=lambda: 0.0) as served:
        asking = [await served.connect() for _ in range(32)]
        for wire in asking:
            wire.call("effects")
            assert "result" in await wire.line()
        for _ in range(160):
            await served.connect()
        await iterate(200)
        process = 2
        wire = await served.connect()
        for method in ("effects", "hello", "status", "stop", "disarm"):
            wire.call(method, '{"client":"me"}' if method == "hello" else "{}")
        answers = [await wire.line() for _ in range(5)]
        assert ["result" in each for each in answers] == [False, True, True, True, True]
        assert answers[0]["error"]["code"] == 1005  # type: ignore[index]
        await asking[0].close()
        await until(lambda: served.disconnected)
        wire.call("effects")
        assert "result" in await wire.line()  # there is a place for all methods now


async def iterate(count: int) -> None:
    """Run the event loop for some iterations."""
    for _ in range(count):
        await asyncio.sleep(0)
