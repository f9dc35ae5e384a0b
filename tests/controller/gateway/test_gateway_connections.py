"""Stops through the gateway are passed on or answered, whatever other clients do."""

import asyncio
import socket
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from unittest.mock import AsyncMock, Mock

import pytest
from aiohttp import WSMessage, WSMsgType

from controller.api import link
from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from controller.api.schema import API_VERSION, Empty
from controller.gateway import connections
from daemons import PATIENCE, until
from gateway_bench import (
    TOKEN,
    GatewayProcess,
    ScriptedDaemon,
    gateway_process,
    wait_for_daemon,
)
from virtual_lines import in_virtual_time


@pytest.fixture
def gateway(daemon: ScriptedDaemon, tmp_path: Path) -> Iterator[GatewayProcess]:
    """A gateway from which no host has had a connection to the daemon yet, but ours."""
    with gateway_process(tmp_path, daemon.socket) as made:
        wait_for_daemon(made)
        yield made


def sent(gateway: GatewayProcess, method: str, host: str) -> socket.socket:
    """A connection of a host over which one request was sent."""
    made = socket.create_connection(
        ("127.0.0.1", gateway.port), timeout=PATIENCE, source_address=(host, 0)
    )
    made.sendall(
        f"POST /api/v1/{method} HTTP/1.1\r\nHost: {gateway.host}\r\nConnection: close\r\n"
        f"Authorization: Bearer {TOKEN}\r\nContent-Length: 0\r\n\r\n".encode()
    )
    return made


def status(connection: socket.socket) -> int:
    """The status of the response."""
    with connection:
        return int(connection.recv(1 << 16)[9:12])


def test_stops_are_passed_on_although_other_hosts_connect_often(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """Whose requests have all places that the daemon has for them."""
    daemon.calls.clear()
    others = [sent(gateway, "status", f"127.0.0.{host}") for _ in range(45) for host in (2, 3)]
    stops = [sent(gateway, "stop", "127.0.0.4") for _ in range(70)]
    disarms = [sent(gateway, "disarm", "127.0.0.4") for _ in range(20)]
    assert [status(each) for each in stops] == [200] * 70
    assert [status(each) for each in disarms] == [200] * 20
    assert daemon.methods.count("stop") == 70
    for each in others:
        each.close()


@pytest.fixture
def full_queue(tmp_path: Path) -> Iterator[Path]:
    """The socket of a daemon that hangs: no further connection is queued."""
    path = tmp_path / "era.sock"
    waiting: list[socket.socket] = []
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(path))
        bound.listen(0)
        while True:
            waiting.append(socket.socket(socket.AF_UNIX))
            waiting[-1].setblocking(False)
            try:
                waiting[-1].connect(str(path))
            except BlockingIOError:
                break
        yield path
        for each in waiting:
            each.close()


async def test_stop_is_answered_although_the_daemon_hangs(
    full_queue: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise nobody is told to switch the amplifiers off by hand."""
    monkeypatch.setattr(link, "RESPONSE_TIMEOUT", 0.05)
    async with asyncio.timeout(100 * link.RESPONSE_TIMEOUT):
        with pytest.raises(Unreachable, match="does not respond"):
            await link.DaemonLink.open(full_queue, "browser")
        with pytest.raises(Unreachable, match="does not respond"):
            await AsyncClient(full_queue, name="gateway", timeout=0.05).stop()


async def test_clients_that_leave_while_the_daemon_hangs_keep_their_places(
    full_queue: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until their connections have failed: else any number of them would wait for the daemon."""
    monkeypatch.setattr(connections, "RESPONSE_TIMEOUT", 0.3)
    kept: dict[connections.ClientConnection, AsyncClient] = {}

    def request(*, leaves: bool = True) -> "asyncio.Task[object]":
        made = connections.ClientConnection(Mock(), full_queue, {}, kept)
        transport = Mock(is_closing=lambda: False, get_extra_info=lambda _: ("192.0.2.1", 1))
        made.connection_made(transport)
        task = asyncio.create_task(made.request("status", Empty()))
        if leaves:
            asyncio.get_running_loop().call_soon(made.connection_lost, None)
        made.stop_waiting()
        return task

    waiting = [request() for _ in range(connections.MAX_KEPT)]
    await asyncio.sleep(0.01)
    with pytest.raises(RpcError, match="too many connections"):
        await request(leaves=False)
    with pytest.raises(Unreachable):
        await asyncio.gather(*waiting)
    await until(lambda: not kept)


@in_virtual_time
async def test_connection_that_waits_is_closed(tmp_path: Path) -> None:
    """The oldest beside 128 that wait, and after 5 s without a complete request, bytes or not.

    None before what has come of it is read, and those that had an answer before new ones.
    """
    waiting: dict[connections.ClientConnection, asyncio.TimerHandle] = {}
    made = [
        connections.ClientConnection(Mock(), tmp_path, waiting, {})
        for _ in range(connections.MAX_WAITING + 3)
    ]
    wires = [Mock(is_closing=lambda: False) for _ in made]
    for each, wire in zip(made, wires, strict=True):
        each.connection_made(wire)

    def closed() -> list[int]:
        return [number for number, wire in enumerate(wires) if wire.abort.called]

    made[4].stop_waiting()
    made[4].wait()  # answered
    assert closed() == []
    await asyncio.sleep(0.01)
    assert closed() == [0, 1, 4]
    made[-2].stop_waiting()  # its request has come
    await asyncio.sleep(4.9)
    made[-1].data_received(b"G")
    assert closed() == [0, 1, 4]
    await asyncio.sleep(0.2)
    assert closed() == [each for each in range(len(made)) if each != len(made) - 2]


LEFT = WSMessage(WSMsgType.CLOSED, None, None)


class DeafBrowser:
    """A WebSocket of a browser that reads the first frame only, and has sent others."""

    close_code = None

    def __init__(self) -> None:
        self.frames: asyncio.Queue[WSMessage] = asyncio.Queue()
        self.sent = 0

    def __aiter__(self) -> "DeafBrowser":
        return self

    async def __anext__(self) -> WSMessage:
        """The next frame."""
        message = await self.frames.get()
        if message is LEFT:
            raise StopAsyncIteration
        return message

    async def send_str(self, _: str) -> None:
        """Send the first frame."""

    async def send_frame(self, _: bytes, opcode: WSMsgType) -> None:
        """Send none of the others: they wait."""
        await asyncio.Event().wait()

    async def close(self, *, code: int = 1000, drain: bool = True) -> None:
        """Answer that it has left."""


@pytest.fixture
async def busy_daemon(tmp_path: Path) -> AsyncIterator[tuple[Path, asyncio.Future[list[bytes]]]]:
    """The socket of a daemon that sends an event, and reads only later; what it read."""
    path = tmp_path / "era.sock"
    read: asyncio.Future[list[bytes]] = asyncio.get_running_loop().create_future()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        hello = b'{"jsonrpc":"2.0","id":"web","result":{"api_version":"%s"}}\n{}\n'
        writer.write(hello % API_VERSION.encode())
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        await given_up.wait()
        writer.transport.resume_reading()  # type: ignore[attr-defined]
        read.set_result((await reader.read()).splitlines())
        writer.close()

    given_up = asyncio.Event()
    asyncio.get_running_loop().call_later(0.3, given_up.set)
    async with await asyncio.start_unix_server(serve, path, limit=1 << 12):
        yield path, read


async def test_stop_of_a_browser_that_is_given_up_is_passed_on(
    busy_daemon: tuple[Path, "asyncio.Future[list[bytes]]"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits behind touches that a busy daemon has not read, and the browser does not read.

    However its name is written; what only looks like it is not passed on.
    """
    path, read = busy_daemon
    monkeypatch.setattr(connections, "SEND_TIMEOUT", 0.05)
    opened = await link.DaemonLink.open(path, "browser")
    monkeypatch.setattr(link.DaemonLink, "open", AsyncMock(return_value=opened))
    browser = DeafBrowser()
    touch = (
        '{"jsonrpc":"2.0","method":"touch","params":{"source":"page","touches":[]}}' + " " * 4000
    )
    stop = '{"jsonrpc":"2.0","id":9,"method":"st\\u006fp"}'
    play = '{"jsonrpc":"2.0","id":8,"method":"play","params":{"effect":"stop","x_m":0,"y_m":0}}'
    for text in [touch] * 1000 + [stop, play]:
        browser.frames.put_nowait(WSMessage(WSMsgType.TEXT, text, ""))
    async with asyncio.timeout(PATIENCE):
        await connections.bridge(browser, "192.0.2.1:1", path, None)  # type: ignore[arg-type]
        lines = await read
    opened.abort()
    await asyncio.sleep(0)
    assert len(lines) < 900
    assert lines[-1] == stop.encode()


async def test_others_have_a_turn_after_each_frame(
    busy_daemon: tuple[Path, "asyncio.Future[list[bytes]]"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many frames of a browser wait."""
    path, read = busy_daemon
    monkeypatch.setattr(connections, "SEND_TIMEOUT", 0.5)
    opened = await link.DaemonLink.open(path, "browser")
    monkeypatch.setattr(link.DaemonLink, "open", AsyncMock(return_value=opened))
    browser = DeafBrowser()
    for _ in range(100):
        browser.frames.put_nowait(WSMessage(WSMsgType.TEXT, "{}", ""))
    bridging = asyncio.create_task(connections.bridge(browser, "", path, None))  # type: ignore[arg-type]
    turns = 0
    async with asyncio.timeout(PATIENCE):
        while not browser.frames.empty():
            await asyncio.sleep(0)
            turns += 1
        browser.frames.put_nowait(LEFT)
        await bridging
        await read
    opened.abort()
    await asyncio.sleep(0)
    assert turns >= 100


class LeavingBrowser(DeafBrowser):
    """A WebSocket of a browser that leaves when it is sent its second frame."""

    async def send_frame(self, _: bytes, opcode: WSMsgType) -> None:
        """Send a frame without waiting; the event loop sees next that the browser has left."""
        self.sent += 1
        if self.sent == 1:
            asyncio.get_running_loop().call_soon(self.frames.put_nowait, LEFT)


async def test_lines_that_came_together_are_not_sent_to_a_browser_that_has_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them would be a warning in the log."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        hello = b'{"jsonrpc":"2.0","id":"web","result":{"api_version":"%s"}}\n'
        writer.write(hello % API_VERSION.encode() + 1000 * b"{}\n")
        await reader.read()
        writer.close()

    path, browser = tmp_path / "era.sock", LeavingBrowser()
    async with await asyncio.start_unix_server(serve, path), asyncio.timeout(PATIENCE):
        opened = await link.DaemonLink.open(path, "browser")
        monkeypatch.setattr(link.DaemonLink, "open", AsyncMock(return_value=opened))
        await connections.bridge(browser, "192.0.2.1:1", path, None)  # type: ignore[arg-type]
    opened.abort()
    await asyncio.sleep(0)
    assert 1 <= browser.sent < 10
