"""Both Python clients against a daemon over a serial line, and against what is not a daemon."""

import asyncio
import contextlib
import json
import math
import os
import re
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

import controller
from controller.api.client import MAX_QUEUED_EVENTS, AsyncClient, Client
from controller.api.jsonrpc import ErrorCode, RpcError, event_line
from controller.api.link import (
    SYSTEM_SOCKET,
    ConnectionLost,
    DaemonLink,
    LeaseLost,
    Unreachable,
    check_peer,
    find_socket,
)
from controller.api.methods import LogEvent
from kit.clock import in_virtual_time
from model.errors import InputError
from processes.daemons import (
    PLACE,
    daemon_at,
    far_end,
    next_event,
    ready_daemon,
    running_daemon,
    until_state,
)

PAGE = Path(controller.__file__).parent.parent / "docs" / "reference" / "api.md"
READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"


async def test_client_plays_and_receives_events(tmp_path: Path) -> None:
    """Armed, touched and notified from a thread; disarmed after its block."""
    async with ready_daemon(tmp_path) as (bench, _):

        def study() -> list[str]:
            with Client.connect(bench.socket, name="study") as era:
                era.subscribe("pattern", "state")
                with era.armed("study", lease_s=60):
                    while not era.status().drive:
                        era.touch([PLACE])
                        time.sleep(0.03)
                era.unsubscribe("pattern")
                return [event.topic for event in era.events(timeout=0.2)]

        topics = await asyncio.to_thread(study)
        assert "pattern" in topics
        assert topics.count("state") >= 5  # at first, then on, enabled, off and ready


@in_virtual_time
async def test_client_connects_again_with_subscriptions_and_lease(tmp_path: Path) -> None:
    """A lease of 5 s outlives a loss of 3 s; one of 6 s ends it for good, for calls and waiting."""
    async with ready_daemon(tmp_path) as (bench, era):
        away, events, armed = bench.socket.with_name("away"), [], contextlib.AsyncExitStack()

        async def lose(duration: float) -> None:
            bench.socket.rename(away)
            for connection in list(bench.daemon.server.clients):
                connection.abort()
            await asyncio.sleep(duration)
            away.rename(bench.socket)

        await era.subscribe("state")
        await armed.enter_async_context(era.armed("me", lease_s=5))
        for duration in (0.0, 3.0):
            await lose(duration)
            await asyncio.sleep(duration)
            assert (await era.status()).armed_by == "me"
        await era.touch([PLACE])
        await lose(6.0)
        with pytest.raises(LeaseLost, match="no daemon runs"):
            events += [event async for event in era.events()]
        for use in (era.touch([PLACE]), armed.aclose()):
            with pytest.raises(LeaseLost):
                await use
        while not events or events[-1].data["new"] != READY:
            events.append(await next_event(era, "state"))
        results = await asyncio.gather(*(era.status() for _ in range(50)))
        assert {status.state for status in results} == {READY}


@in_virtual_time
async def test_lease_is_lost_with_the_daemon_that_gave_it(tmp_path: Path) -> None:
    """Another one at the same socket is not armed; waiting for events fails as calls do."""
    async with far_end(tmp_path) as far, contextlib.AsyncExitStack() as armed:
        async with daemon_at(far, tmp_path) as bench, await bench.client() as first:
            await until_state(first, READY)
            era = await bench.client("study")
            await armed.enter_async_context(era.armed("study", lease_s=60))
        async with daemon_at(far, tmp_path) as bench, await bench.client() as second:
            waiting = asyncio.create_task(era.next_event(timeout=9))
            await until_state(second, READY)
            with pytest.raises(LeaseLost):
                await waiting
            with pytest.raises(LeaseLost):
                await armed.aclose()
            assert (await second.status()).armed_by is None
            await era.close()


async def test_lease_lost_within_armed_raises_at_the_next_call_and_at_the_end(
    tmp_path: Path,
) -> None:
    """Another client stops: both clients raise, with the cause, except for `stop`."""
    loop = asyncio.get_running_loop()
    async with ready_daemon(tmp_path) as (bench, stopping_client):

        def study() -> None:
            with Client.connect(bench.socket) as era, era.armed("study", lease_s=60):
                asyncio.run_coroutine_threadsafe(stopping_client.stop(), loop).result()
                end = time.monotonic() + 15  # s; less than a third of the lease
                with contextlib.suppress(LeaseLost):
                    while time.monotonic() < end and era.status():
                        time.sleep(0.01)
                with pytest.raises(LeaseLost):
                    era.status()
                era.stop()

        async def async_study(error: Exception | None = None) -> None:
            async with await bench.client() as era, era.armed("me", lease_s=1):
                await stopping_client.stop()
                if error is not None:
                    raise error

        with pytest.raises(LeaseLost, match="stopped by"):
            await asyncio.to_thread(study)
        await stopping_client.status()  # the study has stopped, too
        await stopping_client.clear()
        with pytest.raises(LeaseLost, match="stopped by"):
            await async_study()
        await stopping_client.clear()
        with pytest.raises(KeyError):  # the study's own error has priority
            await async_study(KeyError())


@in_virtual_time
async def test_client_raises_when_the_daemon_has_ended(tmp_path: Path) -> None:
    """Calls and `events`, after the attempts to connect again; at once when it was closed."""
    async with ready_daemon(tmp_path) as (bench, _):
        era = await AsyncClient.connect(bench.socket, timeout=0.3)
        await era.subscribe("state")
    assert (await era.next_event(timeout=0)) is not None
    with pytest.raises(Unreachable):
        [_ async for _ in era.events()]
    with pytest.raises(Unreachable):
        await era.status()
    await era.close()
    assert [event async for event in era.events()] == []


@in_virtual_time
async def test_events_that_a_client_is_too_slow_for_are_counted(tmp_path: Path) -> None:
    """Dropped by the daemon, or by the client as they were not taken: each event is had or lost."""
    async with ready_daemon(tmp_path) as (bench, observer), await bench.client() as era:
        await era.subscribe("log")
        hub = bench.daemon.publisher.hub
        line = LogEvent(level="info", message="x" * 900, cause=None, remedy=None)
        for count in (*[100] * 20, 1000, 1):  # at once
            for _ in range(count):
                hub.publish("log", lambda: line)
            await asyncio.sleep(0.1)
        events = []
        while (event := await era.next_event(timeout=0.1)) is not None:
            events.append(event)
        assert len(events) == MAX_QUEUED_EVENTS
        assert len(events) + sum(received.lost for received in events) == 3001
        assert 0 < (await observer.status()).lost_events["log"] < 1000


async def test_example_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Python lines of docs/reference/api.md, with the socket at its default path."""
    section = re.search(r"## In Python\n\n((?:    .*\n|\n)+)", PAGE.read_text("utf-8"))
    code = re.sub(r"^    ", "", section[1], flags=re.MULTILINE)
    async with running_daemon(tmp_path) as bench:
        monkeypatch.setattr("controller.api.client.find_socket", lambda path: bench.socket)
        async with await bench.client() as era:
            await until_state(era, READY)
            await asyncio.to_thread(exec, code, {})
            await until_state(era, READY)


HELLO = b'{"jsonrpc":"2.0","id":1,"result":{"api_version":"1.0"}}\n'


@contextlib.contextmanager
def responding(path: Path, *answers: bytes, stream: bytes = b"") -> Iterator[list[bytes]]:
    """A server that answers each client's requests in turn, then closes, or repeats a stream.

    Yields the requests.
    """
    received: list[bytes] = []
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()

        def serve(client: socket.socket) -> None:
            with client, contextlib.suppress(OSError):
                for answer in answers or [b""]:
                    received.append(client.recv(1000))
                    client.sendall(answer)
                while stream:
                    client.sendall(stream)
                    time.sleep(0.01)

        def respond() -> None:
            with contextlib.suppress(OSError):
                while True:
                    serve(server.accept()[0])

        thread = threading.Thread(target=respond)
        thread.start()
        try:
            yield received
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


@pytest.mark.parametrize(
    ("line", "error", "words"),
    [
        (b'{"jsonrpc":"2.0","id":1,"result":{"api_version":"2.0"}}\n', Unreachable, "version 2.0"),
        (b'{"jsonrpc":"2.0","id":1,"result":{"mood":"good"}}\n', Unreachable, "update"),
        (b'{"jsonrpc":"2.0","id":1,"error":{"code":1,"message":"?"}}\n', Unreachable, "update"),
        (b"SSH-2.0-OpenSSH_9.2\n", Unreachable, "update"),
        (b"", Unreachable, "log"),
        (b'{"jso', Unreachable, "log"),
        (
            b'{"jsonrpc":"2.0","id":null,"error":{"code":1005,"message":"too many connections"}}\n',
            RpcError,
            "too many connections",
        ),
    ],
)
async def test_connect_fails_when_the_peer_is_no_compatible_daemon(
    tmp_path: Path, line: bytes, error: type[Unreachable | RpcError], words: str
) -> None:
    """Another major version, another program, a closed connection: Unreachable with a remedy.

    An error without an id is raised as sent by a daemon with too many clients before it reads
    anything.
    """
    with responding(tmp_path / "a", line), pytest.raises(error, match=words) as blocking:
        await asyncio.to_thread(Client.connect, tmp_path / "a")
    with responding(tmp_path / "b", line), pytest.raises(error, match=words) as asynchronous:
        await AsyncClient.connect(tmp_path / "b")
    if error is RpcError:
        assert {getattr(caught.value, "code", None) for caught in (blocking, asynchronous)} == {
            ErrorCode.BUSY
        }


@pytest.mark.parametrize(
    ("method", "is_repeated"),
    [("stop", True), ("status", True), ("clear", False), ("play", False), ("arm", False)],
)
def test_request_is_repeated_when_the_connection_is_lost_if_that_is_harmless(
    tmp_path: Path, method: str, is_repeated: bool
) -> None:
    """A stop is; what could undo a stop of another client, or be felt twice, is sent once."""
    arguments = {"play": ("tap", PLACE), "arm": ("me",)}.get(method, ())
    with (
        responding(tmp_path / "s", HELLO, b"") as received,
        Client.connect(tmp_path / "s") as era,
        pytest.raises(ConnectionLost),
    ):
        getattr(era, method)(*arguments)
    sent = [json.loads(line)["method"] for line in received]
    assert (sent.count(method) > 1) is is_repeated


def test_stop_is_sent_before_subscriptions_are_restored(tmp_path: Path) -> None:
    """A daemon with many clients would refuse these, and the stop with them."""
    done = b'{"jsonrpc":"2.0","id":1,"result":{"epoch":1}}\n'
    with (
        responding(tmp_path / "s", HELLO, done) as received,
        Client.connect(tmp_path / "s") as era,
    ):
        era.subscribe("state")
        assert era.stop().epoch == 1
    methods = [json.loads(line)["method"] for line in received if line]
    assert methods == ["hello", "subscribe", "hello", "stop"]


def test_call_is_repeated_when_the_connection_is_lost_between_two_restored_topics(
    tmp_path: Path,
) -> None:
    """The second topic is not sent on the lost connection, whose response would never arrive."""
    accepted_then_lost = b'{"jsonrpc":"2.0","id":1,"result":{}}\n?\n'
    with (
        responding(tmp_path / "s", HELLO, accepted_then_lost) as received,
        Client.connect(tmp_path / "s", timeout=2.0) as era,
    ):
        era.subscribe("state", "pattern")
        with pytest.raises(ConnectionLost):
            era.status()
    methods = [json.loads(line)["method"] for line in received if line]
    assert methods.count("hello") > 2


@in_virtual_time
async def test_stop_is_repeated_while_no_daemon_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be restarting: the stop reaches it at its return."""
    async with ready_daemon(tmp_path) as (bench, era):
        open_link, refusing = DaemonLink.open, [tmp_path / "none"]

        async def open_later(path: Path, name: str) -> DaemonLink:
            return await open_link(refusing.pop() if refusing else path, name)

        monkeypatch.setattr(DaemonLink, "open", open_later)
        async with AsyncClient(bench.socket, name="late", timeout=10) as late:
            await late.stop()
        assert not refusing
        assert (await era.status()).state == "QUICK_STOP_ACTIVE"


def test_calls_end_within_the_timeout(tmp_path: Path) -> None:
    """Of a silent daemon, and of one that sends events without end but no response."""
    event = event_line("log", time=1.0, lost=0, data=b"{}")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        server.listen()
        with pytest.raises(Unreachable, match="see its log"):
            Client.connect(tmp_path / "s", timeout=0.05)
    with responding(tmp_path / "t", HELLO, stream=event):
        with Client.connect(tmp_path / "t", timeout=0.2) as era:
            for call in (era.stop, era.status):
                with pytest.raises(Unreachable, match="does not respond"):
                    call()
        with pytest.raises(Unreachable, match="is closed"):
            era.stop()


def test_client_refuses_invalid_arguments(tmp_path: Path) -> None:
    """Before anything is sent, with the method, the key and the value."""
    with responding(tmp_path / "s", HELLO), Client.connect(tmp_path / "s") as era:
        for call, words in [
            (lambda: era.arm("me", lease_s=0.5), "arm: lease_s .*got 0.5"),
            (lambda: era.touch(0.1), "touch: positions .*got 0.1"),  # type: ignore[arg-type]
            (lambda: era.touch((0.1, 0.05)), "position .*got 0.1"),  # type: ignore[arg-type]
            (lambda: era.touch([(math.nan, 0.05)]), r"position .*got \(nan, 0.05\)$"),
            (lambda: era.strength("seat", math.nan), "strength: gain_db must be .*got nan"),
            (lambda: era.play("tap", (0.1, 0.1, 0.1)), "position "),  # type: ignore[arg-type]
            (lambda: era.subscribe("weather"), "subscribe: topics.0"),  # type: ignore[arg-type]
            (lambda: Client.connect(tmp_path / "s", name="a\nb"), r"client .*got 'a\\nb'$"),
            (lambda: AsyncClient(tmp_path, name="", timeout=1.0), "hello: client .*got ''$"),
        ]:
            with pytest.raises(InputError, match=words):
                call()


@pytest.mark.parametrize(
    ("folder", "file", "process", "is_trusted"),
    [
        (1000, 1000, 1000, True),  # the caller
        (0, 0, 0, True),
        (990, 990, 990, True),  # the service
        (1001, 1001, 1001, False),  # another user, as who puts a socket into a shared folder
        (0, 1001, 1001, False),
        (1000, 1000, 1001, False),
        (1001, 1000, 1000, False),
    ],
)
def test_peer_is_believed_only_as_root_caller_or_service(
    folder: int, file: int, process: int, is_trusted: bool
) -> None:
    """Folder, socket and process have one owner, who is one of the three."""
    users = {"/run/x": folder, "/run/x/era.sock": file}
    other_fields = dict.fromkeys(("st_mode", "st_ino"), 0)
    credentials = struct.pack("3i", 4711, process, process)
    connected = cast(socket.socket, SimpleNamespace(getsockopt=lambda *_: credentials))
    expected = contextlib.nullcontext() if is_trusted else pytest.raises(Unreachable, match="ERA_")
    with pytest.MonkeyPatch.context() as patch, expected:  # pytest itself reports by Path.stat
        patch.setattr(
            Path, "stat", lambda path: SimpleNamespace(st_uid=users[str(path)], **other_fields)
        )
        patch.setattr("os.geteuid", lambda: 1000)
        patch.setattr("pwd.getpwnam", lambda name: SimpleNamespace(pw_uid={"plate": 990}[name]))
        check_peer(Path("/run/x/era.sock"), connected, environment={"ERA_HAPTICS_USER": "plate"})


def test_clients_use_the_socket_of_the_environment_or_the_system_socket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is taken whether or not a daemon is there; a given path goes first.

    Else that of the system, also in a folder of another user that cannot be read; connecting then
    reports whose it is.
    """
    with monkeypatch.context() as patched:
        patched.setenv("ERA_HAPTICS_SOCKET", str(tmp_path / "own.sock"))
        patched.setattr("controller.api.link.SYSTEM_SOCKET", tmp_path)  # exists
        assert find_socket(None) == tmp_path / "own.sock"
        assert find_socket("given.sock") == Path("given.sock")

    def forbidden(path: Path, **options: bool) -> os.stat_result:
        if path == SYSTEM_SOCKET:
            raise PermissionError(13, "Permission denied", str(path))
        raise FileNotFoundError(2, "No such file or directory", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "stat", forbidden)
        assert find_socket(None) == SYSTEM_SOCKET
    assert "another user" in str(Unreachable.at(SYSTEM_SOCKET, PermissionError()))
