"""Connections of the API's clients: their bounds, their turns, and daemons of a later version.

Bounds are to the byte and the request, turns are counted in requests; both in virtual time.
"""

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from controller.api import server
from controller.api.client import AsyncClient, Client
from controller.api.methods import METHODS, TOPICS, ContactsEvent, EventParams, LogEvent
from controller.api.schema import MAX_RATE, ApiMessage
from controller.api.server import (
    MAX_UNREAD_BYTES,
    Connection,
    Hub,
)
from controller.gateway.field import DrawnField
from daemons import (
    PLACE,
    ServedApi,
    Wire,
    holding,
    request,
    running_daemon,
    serving,
    until_state,
)
from registry.threads import no_long_collections
from virtual_lines import feed, in_virtual_time

READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"
# keyed by name, not messages: so many levels deep
MAPPINGS = {"drive": 1, "layers": 2, "parameters": 1, "layout": 1}
MAPPINGS |= {"strengths": 1, "rejected_touches": 1, "rejected_examples": 1, "lost_events": 1}


def with_extra_keys(content: Any, mapping_depth: int = 0) -> Any:
    """A message of a later minor version: every object has a further key."""
    if isinstance(content, list):
        return [with_extra_keys(each) for each in content]
    if not isinstance(content, dict):
        return content
    if mapping_depth:
        return {key: with_extra_keys(each, mapping_depth - 1) for key, each in content.items()}
    later = {key: with_extra_keys(each, MAPPINGS.get(key, 0)) for key, each in content.items()}
    return later | {"extra": [{"of": "later"}]}


async def test_extra_keys_of_a_later_minor_version_are_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In results and notifications at every depth: by both clients and by the gateway."""
    made = Connection.connection_made

    def speak_later(connection: Connection, transport: Any) -> None:
        write = transport.write
        transport.write = lambda line: write(
            json.dumps(with_extra_keys(json.loads(line))).encode() + b"\n"
        )
        made(connection, transport)

    def use(path: Path) -> list[str]:
        with Client.connect(path) as era:
            era.subscribe("state")
            seen = [era.status().state, *(event.topic for event in era.events(timeout=0.2))]
            era.effects()
            return seen

    monkeypatch.setattr(Connection, "connection_made", speak_later)
    async with running_daemon(tmp_path) as bench:
        async with await AsyncClient.connect(bench.socket) as era:
            await until_state(era, READY)
            assert await asyncio.to_thread(use, bench.socket) == [READY, "state"]
            field = DrawnField(bench.socket)
            drawing = asyncio.create_task(field.run())
            frames = field.frames()
            empty = await anext(frames)
            await era.subscribe("pattern")
            async with era.armed("me"), holding(era, PLACE), asyncio.timeout(60):
                async for event in era.events():
                    assert "extra" in event.data["contacts"][0]
                    drives = [event.data["drive"], *event.data["layers"].values()]
                    assert all("extra" in tone for drive in drives for tone in drive.values())
                    if event.data["layers"]:
                        break
                drawn = empty
                while len(drawn) == len(empty):
                    drawn = await anext(frames)
        drawing.cancel()
        await asyncio.wait({drawing})


@in_virtual_time
async def test_daemon_sends_exactly_the_documented_keys(tmp_path: Path) -> None:
    """Results and notifications read strictly by the models of the reference page."""
    down = [{"id": 1, "x_m": PLACE[0], "y_m": PLACE[1]}]
    topics = sorted(TOPICS.keys() - {"link", "log"})
    received: set[str] = set()

    async with contextlib.AsyncExitStack() as stack:
        bench = await stack.enter_async_context(running_daemon(tmp_path, "learn: l.npz\n"))
        async with await bench.client() as era:
            await until_state(era, READY)
        reader, writer = await asyncio.open_unix_connection(bench.socket, limit=1 << 20)
        stack.callback(writer.close)

        async def next_response() -> dict[str, Any]:
            """The next response; notifications before it are read strictly."""
            while True:
                content: dict[str, Any] = json.loads(await reader.readline())
                if "method" not in content:
                    return content
                event = EventParams.model_validate(content["params"])
                TOPICS[event.topic].data.model_validate_json(json.dumps(event.data))
                received.add(event.topic)

        async def call(method: str, **params: object) -> None:
            request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
            writer.write(json.dumps(request).encode() + b"\n")
            response = await next_response()
            assert response.keys() == {"jsonrpc", "id", "result"}, response
            METHODS[method].result.model_validate_json(json.dumps(response["result"]))

        async with asyncio.timeout(60):
            await call("hello", client="me")
            await call("subscribe", topics=topics, rate_hz=60.0)
            assert received == set()  # the reply comes before the first event
            await call("effects")
            await call("arm", owner="me", lease_s=5.0)
            for touches, awaited in ((down, "pattern"), ([], "silence")):
                while awaited not in received:
                    await call("touch", source="me", touches=touches)
                    await call("status")
                    await asyncio.sleep(0.01)
            await call("stop")
            await call("clear")
            while received != set(topics):
                await call("status")
                await asyncio.sleep(0.01)


REQUEST = request("renew", '{"lease":"a"}')


def serve() -> ServedApi:
    """A server that counts time from now on."""
    loop = asyncio.get_running_loop()
    began_at = loop.time()
    return ServedApi(clock=lambda: loop.time() - began_at)


@pytest.fixture(autouse=True)
def one_line_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """End turns by the number of lines, as virtual time stands still meanwhile."""
    monkeypatch.setattr(server, "MAX_TURN", 0.0)


async def iterate(count: int) -> None:
    """Run the event loop for some iterations."""
    for _ in range(count):
        await asyncio.sleep(0)


@in_virtual_time
async def test_turn_ends_with_the_line_after_a_tenth_of_a_millisecond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whose lines take 30 us each: four of ten."""
    lines = 0

    def count(name: str) -> None:
        nonlocal lines
        lines += 1

    monkeypatch.undo()
    monkeypatch.setattr(server.time, "perf_counter", lambda: 30e-6 * lines)
    served = serve()
    served.called = count
    feed(served.client()[0], REQUEST * 10)
    await iterate(3)
    assert lines == 4


def connect(now: Callable[[], float]) -> tuple[Connection, Wire]:
    """A connection to a server with a clock, and its transport."""
    return ServedApi(clock=now).client()


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


async def test_input_of_a_client_is_bounded() -> None:
    """Nothing is read while 64 KiB wait to be served; no line is, beside 64 stops on their way."""
    served, client, wire = serving()
    client.pending = {asyncio.ensure_future(asyncio.sleep(3600)) for _ in range(64)}
    await served.takes(client, request("stop") * 2000)
    assert (served.names, wire.is_read) == ([], False)
    client.pending.pop().cancel()
    await served.takes(client, b"\n")
    assert (served.names, wire.is_read) == (["stop"] * 2000, True)
    for each in client.pending:
        each.cancel()


def test_client_that_does_not_read_loses_notifications_then_the_connection() -> None:
    """Unread output stays bounded, the next event counts the lost ones, then it is closed."""
    now = 0.0
    connection, wire = connect(lambda: now)
    counts: list[int] = []

    def make(lost: int) -> bytes:
        counts.append(lost)
        return b"x" * 1023 + b"\n"

    for _ in range(500):
        connection.notify(make)
    assert (counts, len(wire.waiting)) == ([0] * 128, MAX_UNREAD_BYTES // 2)
    wire.waiting = b""
    connection.notify(make)
    assert counts[-1] == 372
    for now in (0.0, 4.9, 5.1):  # noqa: B007  s, from the first loss on; read by the clock
        assert not wire.is_aborted
        for _ in range(500):
            connection.notify(make)
    assert wire.is_aborted


API_BOUNDS_TOUCH = '{"id":1,"x_m":0.1,"y_m":0.1}'
WRONG = '{"id":"a","x_m":"b","y_m":[],"z":0,"t":0}'
HEAVY = {
    "newlines": b"\n" * (1 << 18),
    "keys": request("arm", "{" + ",".join(f'"{n}":1' for n in range(7000)) + "}"),
    "keys within the bound": request("arm", "{" + ",".join(f'"{n}":1' for n in range(240)) + "}"),
    "repeated keys": request("arm", "{" + ",".join(['"a":1'] * 240) + "}"),
    "members": b"{" + b",".join(b'"%d":1' % n for n in range(240)) + b"}\n",
    "depth": b'{"a":' * 5000 + b"\n",
    "depth within the bound": b"[" * 79 + b"]" * 79 + b"\n",
    "touches": request("touch", f'{{"source":"a","touches":[{",".join([API_BOUNDS_TOUCH] * 64)}]}}')
    * 30,
    "touches in turn": b"".join(
        request("touch", f'{{"source":"{n}","touches":[{",".join([API_BOUNDS_TOUCH] * 64)}]}}')
        for n in range(30)
    ),
    "wrong touches": request("touch", f'{{"source":"a","touches":[{",".join([WRONG] * 70)}]}}'),
    "digits": b"9" * 60_000 + b"\n" + request("stop", "{}", id="9" * 4000),
    "text": request("hello", f'{{"client":"{"é" * 30_000}"}}', id=1),
    "no end": b"x" * (1 << 18),
    "requests": request("hello", '{"client":"a"}', id=1) * 3000,
    "stops": request("stop", id=1) * 3000,
}


def reference_time() -> float:
    """Processor time [s] of some fixed work, about that of fifty requests."""
    frame = HEAVY["touches"].partition(b"\n")[0]
    begin = time.thread_time()
    for _ in range(15):
        json.loads(frame)
        {str(number): number for number in range(400)}
    return time.thread_time() - begin


async def callback_times(data: bytes) -> list[float]:
    """Processor time [s] of each callback while a client's data is handled, a line in each turn."""
    connection, _ = ServedApi().client()
    times: list[float] = []
    run = asyncio.Handle._run

    def timed(handle: asyncio.Handle) -> None:
        begin = time.thread_time()
        run(handle)
        times.append(time.thread_time() - begin)

    with no_long_collections(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.Handle, "_run", timed)
        asyncio.get_running_loop().call_soon(feed, connection, data)
        for _ in range(300):
            await asyncio.sleep(0)
    connection.abort()
    await asyncio.gather(*connection.pending)
    assert len(times) > 300
    return times


@pytest.mark.parametrize("name", HEAVY)
async def test_no_line_takes_longer_than_some_fixed_work(name: str) -> None:
    """Of processor time, whatever a client sends at once.

    Each callback and the fixed work count with their least time of five runs one after the other,
    as a virtual machine counts what its host takes as well.
    """
    runs, references = [], []
    for _ in range(5):
        references.append(reference_time())
        runs.append(await callback_times(HEAVY[name]))
    longest = max(map(min, zip(*runs, strict=False)))
    assert longest < min(references)


async def test_hub_survives_an_exception_of_a_producer(caplog: pytest.LogCaptureFixture) -> None:
    """The failure is logged once, outside the topic of the log; later events are sent."""
    hub = Hub({}, clock=lambda: 0.0)
    connection, wire = connect(lambda: 0.0)
    hub.subscribe(connection, ["log", "contacts"])

    def fail() -> ApiMessage:
        raise ZeroDivisionError

    for topic in ("log", "contacts", "log"):
        hub.publish(topic, fail)  # type: ignore[arg-type]
    await asyncio.sleep(0.03)
    assert [hasattr(record, "topic") for record in caplog.records] == [True, True]
    hub.publish("contacts", lambda: ContactsEvent(contacts=[]))
    await asyncio.sleep(0.03)
    assert b'"topic":"contacts"' in wire.waiting
    hub.close()


async def test_hub_sends_the_newest_of_changes_at_most_sixty_times_per_second() -> None:
    """Of a thousand changes one, a sixtieth of a second after the one before; records of the log
    one by one, at once.
    """
    now = 100.0
    hub = Hub({}, clock=lambda: now)
    connection, wire = connect(lambda: now)
    hub.subscribe(connection, ["contacts", "log"])
    loop = asyncio.get_running_loop()
    made: list[str] = []

    def make() -> ApiMessage:
        made.append("contacts")
        return ContactsEvent(contacts=[])

    def publish() -> float:
        before = loop.time()
        for _ in range(1000):
            hub.publish("contacts", make)
        return cast(asyncio.TimerHandle, hub._flush).when() - before

    assert publish() < 1 / MAX_RATE
    for _ in range(3):
        hub.publish("log", lambda: LogEvent(level="info", message="", cause=None, remedy=None))
    await asyncio.sleep(0.01)
    topics = [json.loads(line)["params"]["topic"] for line in wire.waiting.splitlines()]
    assert (topics, made) == (["log", "log", "log", "contacts"], ["contacts"])
    assert publish() >= 1 / MAX_RATE - 1e-6
    cast(asyncio.TimerHandle, hub._flush).cancel()
    hub._flush = None
    now += 1.0
    assert publish() < 1 / MAX_RATE
    hub.close()


async def test_hub_sends_each_periodic_topic_at_its_own_rate() -> None:
    """A later subscription to another topic leaves that of the first; both end with the client."""
    hub = Hub({"amplifiers": lambda: None, "latency": lambda: None}, clock=lambda: 0.0)
    connection, _ = connect(lambda: 0.0)
    loop = asyncio.get_running_loop()
    hub.subscribe(connection, ["amplifiers"], rate=2.0)
    hub.subscribe(connection, ["latency"], rate=50.0)
    timers = {topic: cast(asyncio.TimerHandle, timer) for topic, timer in connection.topics.items()}
    due = {topic: timer.when() - loop.time() for topic, timer in timers.items()}
    assert due == pytest.approx({"amplifiers": 0.5, "latency": 0.02}, abs=0.015)
    hub.forget(connection)
    assert all(timer.cancelled() for timer in timers.values())
    assert not connection.topics
