"""Clients and the drawn field with a daemon of a later version."""

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any

import pytest

from controller.api.client import AsyncClient, Client
from controller.api.connection import Connection
from controller.api.registered import METHODS
from controller.api.server import TOPICS, EventParams
from controller.gateway.field import DrawnField
from daemons import PLACE, holding, running_daemon, until_state
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
