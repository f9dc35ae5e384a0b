"""Connections of the API's clients: their bounds, their turns, and daemons of a later version.

Bounds are to the byte and the request, turns are counted in requests; both in virtual time.
"""

import asyncio
import contextlib
import json
import os
import resource
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from controller.api import connection
from controller.api import connection as turns
from controller.api.client import AsyncClient, Client
from controller.api.connection import (
    MAX_CONNECTIONS,
    MAX_REQUEST_RATE,
    MAX_UNREAD_BYTES,
    Acceptor,
    Admission,
    Connection,
)
from controller.api.methods import METHODS, TOPICS, ContactsEvent, EventParams, LogEvent
from controller.api.schema import MAX_RATE, ApiMessage
from controller.api.server import Hub
from controller.gateway.field import DrawnField
from daemons import (
    PLACE,
    ServedApi,
    Wire,
    feed,
    holding,
    request,
    running_daemon,
    serving,
    until_state,
)
from registry.threads import no_long_collections
from virtual_lines import in_virtual_time

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
TOUCH = request("touch", '{"source":"a","touches":[]}', id=1)
TOUCH_DOWN = TOUCH.replace(b"[]", b'[{"id":1,"x_m":0.1,"y_m":0.1}]')
LOOKALIKE = request("renew", '{"lease":"stop"}')
STOP = request("stop")


def serve(**costs: float) -> ServedApi:
    """A server that counts time from now on; costs: as for `ServedApi`."""
    loop = asyncio.get_running_loop()
    began_at = loop.time()
    return ServedApi(clock=lambda: loop.time() - began_at, **costs)


@pytest.fixture(autouse=True)
def one_line_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """End turns by the number of lines, as virtual time stands still meanwhile."""
    monkeypatch.setattr(connection, "MAX_TURN", 0.0)


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
    monkeypatch.setattr(connection.time, "perf_counter", lambda: 30e-6 * lines)
    served = serve()
    served.called = count
    feed(served.client()[0], REQUEST * 10)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert lines == 4


@in_virtual_time
async def test_clients_take_a_burst_then_a_quarter_of_the_time() -> None:
    """Of requests of 1 ms each: 20 at once, then 250 in a second, each overdrawn by at most one."""
    served = serve(costs=0.001)
    client, _ = served.client()
    feed(client, TOUCH * 700)
    await asyncio.sleep(1.0)
    times = served.times("touch")
    assert sum(time == 0 for time in times) == pytest.approx(20, abs=1)
    assert len(times) == pytest.approx(20 + 250, abs=3)


@in_virtual_time
async def test_client_that_touches_waits_for_no_other_client() -> None:
    """Beside 30 that ask without end, whose requests of 1 ms each take all of their own share."""
    served = serve(costs=0.001)
    touching, _ = served.client()
    feed(touching, TOUCH_DOWN)
    for _ in range(30):
        feed(served.client()[0], REQUEST * 100)
    for number in range(1, 6):
        await asyncio.sleep(0.1 * number - served.clock())
        feed(touching, TOUCH_DOWN)
    await asyncio.sleep(0.05)
    assert len(served.times("renew")) < 250
    assert served.times("touch") == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5], abs=0.002)


@in_virtual_time
async def test_client_whose_fingers_were_never_lifted_is_one_of_the_others() -> None:
    """150 ms after its last frame, as its contacts: it and the others have one share."""
    served = serve(costs=0.001)
    silent, _ = served.client()
    feed(silent, TOUCH_DOWN)
    feed(served.client()[0], REQUEST * 400)
    await asyncio.sleep(0.3)
    feed(silent, REQUEST * 400)
    await asyncio.sleep(1.0 - served.clock())
    assert len(served.calls) == pytest.approx(1 + 20 + 250, abs=3)


@in_virtual_time
async def test_requests_wait_while_a_touch_is_on_its_way_to_the_wire() -> None:
    """Until it is sent, and for 3 ms at most if touches follow each other without a gap."""
    served = serve()
    client, _ = served.client()
    served.is_busy = True
    feed(client, REQUEST * 4)
    await asyncio.sleep(0.0029)
    assert served.calls == []
    await asyncio.sleep(0.0049)
    assert served.times("renew") == pytest.approx([0.003, 0.0065], abs=0.001)
    served.is_busy = False
    await asyncio.sleep(0.0006)
    assert len(served.times("renew")) == 4


@in_virtual_time
async def test_a_turn_that_is_deferred_costs_its_clients_nothing() -> None:
    """Else what was saved until it is due may be spent by finding that it is not due yet."""
    served = serve(costs=0.015, reading_costs=3e-6)
    client, _ = served.client()
    feed(client, REQUEST * 3)
    await asyncio.sleep(0.1)
    assert served.times("renew") == pytest.approx([0.0, 0.0, 0.04], abs=0.001)


@in_virtual_time
async def test_stop_is_served_at_once_though_touches_come_first_and_time_is_overdrawn() -> None:
    """Also behind other requests of its client, and in two parts."""
    served = serve(costs=0.001)
    client, _ = served.client()
    feed(client, TOUCH * 100)
    await asyncio.sleep(0.01)
    assert len(served.times("touch")) < 30
    served.is_busy = True
    feed(client, STOP[:-5])
    feed(client, STOP[-5:])
    await asyncio.sleep(0.001)
    assert served.times("stop") == [pytest.approx(0.01)]
    assert len(served.times("touch")) == 100


@in_virtual_time
async def test_lines_that_only_look_like_a_stop_are_served_in_turn() -> None:
    """The first of them is served at once, the next one so only a tenth of a second later."""
    served = serve()
    client, _ = served.client()
    served.is_busy = True
    for pause in (0.0, 0.001, 0.05, 0.06):
        await asyncio.sleep(pause)
        feed(client, LOOKALIKE)
        for _ in range(4):
            await asyncio.sleep(0)
    delays = [
        time - sent
        for time, sent in zip(served.times("renew"), (0.0, 0.001, 0.051, 0.111), strict=True)
    ]
    assert delays == pytest.approx([0.0, 0.003, 0.003, 0.0], abs=0.0006)


async def iterate() -> None:
    """Run the event loop for a few iterations."""
    for _ in range(4):
        await asyncio.sleep(0)


def connect(now: Callable[[], float], *, process: int = 1) -> tuple[Connection, Wire]:
    """A connection of a process and its transport."""
    connection = Connection(
        process,
        on_connect=lambda one: None,
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


async def test_server_limits_the_request_rate_except_for_stop_and_touch() -> None:
    """After 2000 requests at once the next is refused; stop and touch are served."""
    served, client, _ = serving()
    for line in [request("disarm")] * (int(MAX_REQUEST_RATE) + 1):
        await served.takes(client, line)
    assert served.names == ["disarm"] * 2000
    for line in (
        request("stop"),
        request("touch", '{"source":"a","touches":[]}'),
        request("clear"),
    ):
        await served.takes(client, line)
    assert served.names[2000:] == ["stop", "touch"]


async def test_refused_requests_count_in_the_rate() -> None:
    """Whatever is wrong with them: after 2000 at once the connection is closed."""
    for wrong in (b"\n", b"{}\n", request("nothing"), request("stop", '{"x":1}')):
        served, client, wire = serving()
        for _ in range(int(MAX_REQUEST_RATE)):
            wire.waiting = b""
            await served.takes(client, wrong)
        assert client.is_open
        await served.takes(client, wrong)
        assert wire.is_aborted
        assert wire.lines()[-1]["error"]["code"] == 1005


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
        patch.setattr(turns, "MAX_TURN", 0.0)
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


@pytest.mark.parametrize(
    ("clients", "dropped"),
    [
        ([("kept", 99), ("pending", 99), ("asking", 0.5)], None),
        ([("kept", 99), ("silent", 0.2), ("subscribed", 99), ("asking", 99)], 1),
        ([("kept", 99), ("silent", 0.05), ("subscribed", 99)], None),  # it may still speak
        ([("asking", 99), ("subscribed", 2), ("subscribed", 3)], 2),
        ([("asking", 2), ("asking", 3), ("subscribed", 0.5)], 1),
    ],
)
def test_place_is_taken_from_the_silent_then_idle_subscribers_then_the_idle(
    clients: list[tuple[str, float]], dropped: int | None
) -> None:
    """Never from a holder of the lease or one that waits; kind and silence [s] of each client."""
    made: list[tuple[Connection, str]] = []
    admission = Admission(
        holds_lease=lambda one: (one, "kept") in made,
        clock=lambda: 100.0,
    )
    for kind, silence in [*clients, *[("kept", 0.0)] * (MAX_CONNECTIONS - len(clients))]:
        connection, _ = connect(lambda silence=silence: 100.0 - silence)
        connection.has_spoken = kind != "silent"
        connection.topics = {"state": None} if kind == "subscribed" else {}
        connection.pending = {cast("asyncio.Task[None]", None)} if kind == "pending" else set()
        made.append((connection, kind))
        admission.admitted.add(connection)
    new, _ = connect(lambda: 100.0)
    admission.admit(new)
    assert new.is_reserve is (dropped is None)
    gone = [number for number, (one, _) in enumerate(made) if one not in admission.admitted]
    assert gone == ([] if dropped is None else [dropped])


@pytest.mark.parametrize("processes", [1, 20])
def test_client_in_reserve_survives_processes_that_connect_again_and_again(
    processes: int,
) -> None:
    """Neither before its first bytes were read nor after, if they hold more of the reserve.

    However many processes there are, none evicts a client whose first bytes wait to be read.
    """
    now = 0.0
    admission = Admission(
        holds_lease=lambda one: not one.is_reserve,
        clock=lambda: now,
    )

    def newcomers(count: int) -> None:
        nonlocal now
        for number in range(count):
            now += 0.0005
            one, _ = connect(lambda now=now: now, process=number % processes)
            one.has_spoken = True
            admission.admit(one)

    newcomers(2000)
    near, far = socket.socketpair()
    with near, far:
        own, wire = connect(lambda: now, process=4711)
        wire._extra = {"socket": near}
        admission.admit(own)
        assert own in admission.admitted
        far.send(b"{")
        newcomers(2000)
        assert own in admission.admitted
        feed(own, near.recv(10))
        newcomers(2000 if processes == 1 else 0)
        assert own in admission.admitted


async def test_server_refuses_connections_of_a_process_above_a_rate(tmp_path: Path) -> None:
    """After 64 at once the next is closed; a twentieth of a second later one is accepted."""
    now = 0.0
    bound = socket.socket(socket.AF_UNIX)
    bound.bind(str(tmp_path / "s"))
    made: list[Connection] = []

    def make(process: int) -> Connection:
        assert process == os.getpid()
        made.append(connect(lambda: now)[0])
        return made[-1]

    acceptor = Acceptor(bound, make, clock=lambda: now)
    async with contextlib.AsyncExitStack() as stack:
        stack.push_async_callback(acceptor.close)

        async def is_accepted() -> bool:
            client = stack.enter_context(socket.socket(socket.AF_UNIX))
            client.setblocking(False)
            before = len(made)
            client.connect(str(tmp_path / "s"))
            while len(made) == before:
                with contextlib.suppress(BlockingIOError):
                    return bool(client.recv(1))
                await asyncio.sleep(0)
            return True

        assert [await is_accepted() for _ in range(65)] == [True] * 64 + [False]
        now = 0.05
        assert [await is_accepted() for _ in range(2)] == [True, False]
        for each in made:
            each.abort()
        await iterate()


async def test_server_without_descriptors_closes_new_connections(tmp_path: Path) -> None:
    """The client reads the end in place of waiting."""
    bound = socket.socket(socket.AF_UNIX)
    bound.bind(str(tmp_path / "s"))
    acceptor = Acceptor(bound, lambda process: connect(lambda: 0.0)[0], clock=lambda: 0.0)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket(socket.AF_UNIX) as client:
        client.setblocking(False)
        client.connect(str(tmp_path / "s"))
        free = os.open(os.devnull, os.O_RDONLY)
        os.close(free)
        resource.setrlimit(resource.RLIMIT_NOFILE, (free, before[1]))
        try:
            await iterate()
            received = client.recv(1)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
        assert received == b""
    await acceptor.close()


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
