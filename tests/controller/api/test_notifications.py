"""Notifications of the API: when topics are sent, and which keys events and results have."""

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from controller.api.client import AsyncClient, Client
from controller.api.hub import Hub
from controller.api.methods import METHODS, TOPICS, ContactsEvent, EventParams, LogEvent
from controller.api.schema import MAX_RATE, ApiMessage
from controller.api.server import Connection
from controller.gateway.field import DrawnField
from kit.clock import in_virtual_time
from processes.daemons import (
    PLACE,
    READY,
    ServedApi,
    Wire,
    holding,
    ready_daemon,
    running_daemon,
    until_state,
)


def subscribed_hub(clock: Callable[[], float], *topics: str) -> tuple[Hub, Wire]:
    """A hub, and the wire of a client that has subscribed to topics."""
    hub = Hub({}, clock=clock)
    connection, wire = ServedApi(clock=clock).client()
    hub.subscribe(connection, list(topics))
    return hub, wire


async def test_hub_survives_an_exception_of_a_producer(caplog: pytest.LogCaptureFixture) -> None:
    """The failure is logged once, outside the topic of the log; later events are sent."""
    hub, wire = subscribed_hub(lambda: 0.0, "log", "contacts")

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


@in_virtual_time
async def test_hub_sends_the_newest_of_changes_at_most_sixty_times_per_second() -> None:
    """A thousand changes make one event, a sixtieth of a second after the previous one."""
    loop = asyncio.get_running_loop()
    hub, wire = subscribed_hub(loop.time, "contacts")
    wire.lines()
    events = list[ContactsEvent]()

    def make_event() -> ContactsEvent:
        events.append(ContactsEvent(contacts=[]))
        return events[-1]

    async def delay_of_an_event() -> float:
        published_at = loop.time()
        for _ in range(1000):
            hub.publish("contacts", make_event)
        while not wire.waiting:  # noqa: ASYNC110 - virtual time
            await asyncio.sleep(0.0001)
        assert len(wire.lines()) == 1
        return loop.time() - published_at

    assert await delay_of_an_event() < 0.001
    assert await delay_of_an_event() == pytest.approx(1 / MAX_RATE, abs=0.001)
    await asyncio.sleep(1.0)
    assert await delay_of_an_event() < 0.001
    assert len(events) == 3
    hub.close()


@in_virtual_time
async def test_hub_sends_every_record_of_the_log_at_once() -> None:
    """Three records of one moment are three events."""
    hub, wire = subscribed_hub(asyncio.get_running_loop().time, "log")
    wire.lines()

    for _ in range(3):
        hub.publish("log", lambda: LogEvent(level="info", message="", cause=None, remedy=None))

    assert [line["params"]["topic"] for line in wire.lines()] == ["log"] * 3
    hub.close()


async def test_hub_sends_each_periodic_topic_at_its_own_rate() -> None:
    """A later subscription to another topic leaves that of the first; both end with the client."""
    loop = asyncio.get_running_loop()
    hub = Hub({"amplifiers": lambda: None, "latency": lambda: None}, clock=lambda: 0.0)
    connection, _ = ServedApi().client()

    hub.subscribe(connection, ["amplifiers"], rate=2.0)
    hub.subscribe(connection, ["latency"], rate=50.0)

    timers = cast(dict[str, asyncio.TimerHandle], dict(hub.subscriptions[connection]))
    delays = {topic: timer.when() - loop.time() for topic, timer in timers.items()}
    assert delays == pytest.approx({"amplifiers": 0.5, "latency": 0.02}, abs=0.015)
    hub.forget(connection)
    cancelled = {topic: timer.cancelled() for topic, timer in timers.items()}
    assert cancelled == {"amplifiers": True, "latency": True}
    assert not hub.subscriptions


MAPPING_DEPTHS = {
    "drive": 1,
    "layers": 2,
    "parameters": 1,
    "layout": 1,
    "strengths": 1,
    "rejected_touches": 1,
    "rejected_examples": 1,
    "lost_events": 1,
}
"""Keys whose values are keyed by name, and are no messages, so many levels deep."""


def with_extra_keys(content: Any, mapping_depth: int = 0) -> Any:
    """A message of a later minor version: every object has a further key."""
    if isinstance(content, list):
        return [with_extra_keys(element) for element in content]
    if not isinstance(content, dict):
        return content
    message = dict[str, Any]()
    for key, value in content.items():
        depth = mapping_depth - 1 if mapping_depth else MAPPING_DEPTHS.get(key, 0)
        message[key] = with_extra_keys(value, depth)
    if not mapping_depth:
        message["extra"] = [{"of": "later"}]
    return message


@pytest.fixture
def later_version(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the server send further keys in everything."""
    connection_made = Connection.connection_made

    def speak_later_version(connection: Connection, transport: Any) -> None:
        write = transport.write

        def write_with_extra_keys(line: bytes) -> None:
            message = with_extra_keys(json.loads(line))
            write(json.dumps(message).encode() + b"\n")

        transport.write = write_with_extra_keys
        connection_made(connection, transport)

    monkeypatch.setattr(Connection, "connection_made", speak_later_version)


def read_with_blocking_client(path: Path) -> tuple[str, list[str]]:
    """The state in the status, and the topics of events, as the blocking client reads them."""
    with Client.connect(path) as era:
        era.subscribe("state")
        state = era.status().state
        topics = [event.topic for event in era.events(timeout=0.2)]
        era.effects()
        return state, topics


async def wait_until_drawn(field: DrawnField) -> None:
    """Wait until the gateway has drawn more than an empty plate."""
    frames = field.frames()
    empty_frame = await anext(frames)
    async for frame in frames:
        if len(frame) > len(empty_frame):
            return


@pytest.mark.usefixtures("later_version")
async def test_extra_keys_of_a_later_minor_version_are_ignored(tmp_path: Path) -> None:
    """In results and notifications at every depth: by both clients and by the gateway."""
    async with ready_daemon(tmp_path) as (bench, era):
        blocking = await asyncio.to_thread(read_with_blocking_client, bench.socket)
        assert blocking == (READY, ["state"])

        field = DrawnField(bench.socket)
        running = asyncio.create_task(field.run())
        drawing = asyncio.create_task(wait_until_drawn(field))
        await era.subscribe("pattern")
        async with era.armed("me"), holding(era, PLACE), asyncio.timeout(60):
            async for event in era.events():
                if event.data["layers"]:
                    break
            await drawing
        contact = event.data["contacts"][0]
        assert "extra" in contact
        for drive in event.data["layers"].values():
            for channel, tone in drive.items():
                assert "extra" in tone, channel
        running.cancel()
        await asyncio.wait({running})


class StrictClient:
    """Reads results and notifications strictly, by the models of the reference page."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.topics = set[str]()
        self._reader = reader
        self._writer = writer

    async def call(self, method: str, **params: object) -> None:
        """Call a method, and read its result and all notifications before it."""
        message = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        self._writer.write(json.dumps(message).encode() + b"\n")
        content = json.loads(await self._reader.readline())
        while "method" in content:
            self._read_event(content["params"])
            content = json.loads(await self._reader.readline())
        assert content.keys() == {"jsonrpc", "id", "result"}, content
        METHODS[method].result.model_validate_json(json.dumps(content["result"]))

    def _read_event(self, params: object) -> None:
        event = EventParams.model_validate(params)
        TOPICS[event.topic].data.model_validate_json(json.dumps(event.data))
        self.topics.add(event.topic)


@in_virtual_time
async def test_daemon_sends_exactly_the_documented_keys(tmp_path: Path) -> None:
    """Results and notifications of an armed daemon that plays, is stopped and cleared."""
    finger = {"id": 1, "x_m": PLACE[0], "y_m": PLACE[1]}
    topics = TOPICS.keys() - {"link", "log"}
    async with running_daemon(tmp_path) as bench:
        async with await AsyncClient.connect(bench.socket) as era:
            await until_state(era, READY)
        reader, writer = await asyncio.open_unix_connection(bench.socket, limit=1 << 20)
        client = StrictClient(reader, writer)

        async def touch_until(topic: str, *touches: object) -> None:
            while topic not in client.topics:
                await client.call("touch", source="me", touches=touches)
                await client.call("status")
                await asyncio.sleep(0.01)

        async with asyncio.timeout(60):
            await client.call("hello", client="me")
            await client.call("subscribe", topics=sorted(topics), rate_hz=60.0)
            assert client.topics == set()  # the reply comes before the first event
            await client.call("effects")
            await client.call("arm", owner="me", lease_s=5.0)
            await touch_until("pattern", finger)
            await touch_until("silence")
            await client.call("stop")
            await client.call("clear")
            while client.topics != topics:
                await client.call("status")
                await asyncio.sleep(0.01)
        writer.close()
