"""Daemons of other versions than the client, and how strictly ours keeps to what it promises."""

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from controller.gateway.topics import FIELD

from controller.api.async_client import AsyncClient
from controller.api.client import Client
from controller.api.client_protocol import Unreachable
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import METHODS
from controller.api.schema import Empty
from controller.api.topics import TOPICS, EventParams
from controller.gateway.daemon_link import DaemonLink
from controller.gateway.mirror import DaemonMirror
from daemon_bench import PLACE, running_daemon, until, until_state

READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"
BY_NAME = ("drive", "rejected_touches", "parameters", "layout")  # their keys are no message's


def with_news(said: Any, *, by_name: bool = False) -> Any:
    """A message as a later minor version might say it: every object has a key more."""
    if isinstance(said, list):
        return [with_news(each) for each in said]
    if not isinstance(said, dict):
        return said
    news = {} if by_name else {"news": [{"of": "later"}]}
    return {key: with_news(value, by_name=key in BY_NAME) for key, value in said.items()} | news


@contextlib.asynccontextmanager
async def between(
    daemon: Path, path: Path, change: Callable[[dict[str, Any]], object]
) -> AsyncIterator[None]:
    """Another socket for a daemon, at which everything that it says is changed."""
    under_way: set[asyncio.Task[None]] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        told, asked = await asyncio.open_unix_connection(daemon, limit=1 << 20)

        async def forth() -> None:
            while data := await reader.read(1 << 16):
                asked.write(data)
            asked.close()

        async def back() -> None:
            while line := await told.readline():
                writer.write(json.dumps(change(json.loads(line))).encode() + b"\n")
            writer.close()

        under_way.update((asyncio.create_task(forth()), asyncio.create_task(back())))

    server = await asyncio.start_unix_server(serve, path)
    try:
        yield
    finally:
        server.close()
        for task in under_way:
            task.cancel()
        await asyncio.gather(*under_way, return_exceptions=True)


async def test_keys_that_a_later_minor_version_adds_are_ignored(tmp_path: Path) -> None:
    """In results and notifications at every depth: by both clients, and by the gateway."""

    def ask(path: Path) -> list[str]:
        with Client.connect(path) as era:
            era.subscribe("state")
            seen = [era.status().state, *(told.topic for told in era.events(timeout=0.2))]
            era.effects()
            return seen

    later = tmp_path / "later.sock"
    frames: dict[str, str | bytes] = {}
    async with running_daemon(tmp_path) as bench, between(bench.socket, later, with_news):
        async with await AsyncClient.connect(later) as era:
            await until_state(era, READY)
            assert await asyncio.to_thread(ask, later) == [READY, "state"]
            drawing = asyncio.create_task(DaemonMirror(later, tell=frames.__setitem__).run())
            await until(lambda: FIELD in frames)
            nothing = frames[FIELD]
            await era.subscribe("pattern")
            async with era.armed("me"), asyncio.timeout(20):
                await era.touch([PLACE])
                async for told in era.events():
                    assert "news" in told.data["contacts"][0]
                    assert "news" in next(iter(told.data["drive"].values()))
                    break
                await until(lambda: "pattern" in frames and frames[FIELD] != nothing)
        drawing.cancel()
        await asyncio.gather(drawing, return_exceptions=True)


async def test_the_daemon_says_what_its_version_promises_and_no_more(tmp_path: Path) -> None:
    """Read strictly, by the models that the reference is made of: no key too many or too few."""
    down = [{"id": 1, "x_m": PLACE[0], "y_m": PLACE[1]}]
    topics = sorted(TOPICS.keys() - {"link", "log"})
    told: set[str] = set()

    async with contextlib.AsyncExitStack() as stack:
        bench = await stack.enter_async_context(running_daemon(tmp_path))
        async with await bench.client() as era:
            await until_state(era, READY)
        reader, writer = await asyncio.open_unix_connection(bench.socket, limit=1 << 20)
        stack.callback(writer.close)

        async def next_answer() -> dict[str, Any]:
            """The next line that is no notification; those are read strictly here."""
            while True:
                said: dict[str, Any] = json.loads(await reader.readline())
                if "method" not in said:
                    return said
                event = EventParams.model_validate(said["params"])
                TOPICS[event.topic].data.model_validate_json(json.dumps(event.data))
                told.add(event.topic)

        async def ask(method: str, **params: object) -> None:
            asked = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
            writer.write(json.dumps(asked).encode() + b"\n")
            said = await next_answer()
            assert said.keys() == {"jsonrpc", "id", "result"}, said
            METHODS[method].result.model_validate_json(json.dumps(said["result"]))

        async with asyncio.timeout(20):
            await ask("hello", client="me")
            await ask("subscribe", topics=topics, rate_hz=60.0)
            await ask("effects")
            await ask("arm", owner="me", lease_s=5.0)
            for touches, awaited in ((down, "pattern"), ([], "silence")):
                while awaited not in told:
                    await ask("touch", source="me", touches=touches)
                    await ask("status")
                    await asyncio.sleep(0.01)
            await ask("stop")
            await ask("clear")
            while told != set(topics):
                await ask("status")
                await asyncio.sleep(0.01)


async def test_a_daemon_of_another_major_version_is_named_as_such(tmp_path: Path) -> None:
    """Whatever else its hello looks like: by both clients, and to whoever asks the gateway."""

    def changed(said: dict[str, Any]) -> dict[str, Any]:
        return said | {"result": {"api_version": "2.0", "era": 2}}

    spoken = r"speaks version 2\.0 of the API, this program 1\.\d+; update the older of the two"
    other = tmp_path / "other.sock"
    async with running_daemon(tmp_path) as bench, between(bench.socket, other, changed):
        with pytest.raises(Unreachable, match=spoken):
            await AsyncClient.connect(other)
        with pytest.raises(Unreachable, match=spoken):
            await asyncio.to_thread(Client.connect, other)
        link = DaemonLink(other, on_hello=lambda hello: None, on_event=lambda told: None)
        following = asyncio.create_task(link.run())
        said = ""
        while "version" not in said:
            with pytest.raises(RpcError) as caught:
                await link.call("status", Empty())
            said = str(caught.value)
            await asyncio.sleep(0.01)
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)
        assert re.search(spoken, said)
        assert caught.value.code is ErrorCode.LINK
