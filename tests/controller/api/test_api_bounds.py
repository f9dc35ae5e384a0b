"""Bounds of one connection, to the byte and the request, in virtual time."""

import asyncio
import contextlib
import json
import os
import resource
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from controller.api import connection as turns
from controller.api.connection import (
    MAX_CONNECTIONS,
    MAX_REQUEST_RATE,
    MAX_UNREAD_BYTES,
    Acceptor,
    Admission,
    Connection,
)
from controller.api.schema import MAX_RATE, Message
from controller.api.server import ContactsEvent, Hub, LogEvent
from daemons import ServedApi, Wire, feed, request, serving
from registry.threads import no_long_collections


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


TOUCH = '{"id":1,"x_m":0.1,"y_m":0.1}'
WRONG = '{"id":"a","x_m":"b","y_m":[],"z":0,"t":0}'
HEAVY = {
    "newlines": b"\n" * (1 << 18),
    "keys": request("arm", "{" + ",".join(f'"{n}":1' for n in range(7000)) + "}"),
    "keys within the bound": request("arm", "{" + ",".join(f'"{n}":1' for n in range(240)) + "}"),
    "repeated keys": request("arm", "{" + ",".join(['"a":1'] * 240) + "}"),
    "members": b"{" + b",".join(b'"%d":1' % n for n in range(240)) + b"}\n",
    "depth": b'{"a":' * 5000 + b"\n",
    "depth within the bound": b"[" * 79 + b"]" * 79 + b"\n",
    "touches": request("touch", f'{{"source":"a","touches":[{",".join([TOUCH] * 64)}]}}') * 30,
    "touches in turn": b"".join(
        request("touch", f'{{"source":"{n}","touches":[{",".join([TOUCH] * 64)}]}}')
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

    def fail() -> Message:
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

    def make() -> Message:
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
