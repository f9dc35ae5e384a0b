"""Both Python clients against a daemon over a serial line, and against what is not a daemon."""

import asyncio
import contextlib
import inspect
import os
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import controller
from controller.api.async_client import AsyncClient
from controller.api.client import Client
from controller.api.client_protocol import Unreachable
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import METHODS
from controller.api.schema import Message
from controller.api.socket_path import SYSTEM_SOCKET, find_socket
from daemon_bench import PLACE, running_daemon, until_state
from model.errors import InputError

PAGE = Path(controller.__file__).parent.parent / "docs" / "reference" / "api.md"
READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"


async def test_client_keeps_its_lease_and_receives_events(tmp_path: Path) -> None:
    """Armed for longer than a lease, touched, notified, stopped and cleared, from a thread."""
    async with running_daemon(tmp_path) as bench:

        def study() -> list[str]:
            seen: list[str] = []
            with Client.connect(bench.socket, name="study") as era:
                era.subscribe("pattern", "state")
                with era.armed("study", lease_s=1):
                    end = time.monotonic() + 1.3
                    while time.monotonic() < end:
                        era.touch([PLACE])
                        time.sleep(0.03)
                    seen.append(era.status().state)
                era.unsubscribe("pattern")
                era.stop()
                with pytest.raises(RpcError) as caught:
                    era.arm("study")
                assert caught.value.code is ErrorCode.WRONG_STATE
                assert caught.value.data.remedy is not None
                era.clear()
                seen.append(era.status().state)
                seen += [event.topic for event in era.events(timeout=0.2)]
            return seen

        async with await bench.client() as era:
            await until_state(era, READY)
        seen = await asyncio.to_thread(study)
        assert seen[:2] == [ENABLED, READY]
        assert "pattern" in seen[2:]
        assert seen.count("state") >= 6


async def test_async_client_keeps_its_lease(tmp_path: Path) -> None:
    """Armed for longer than a lease of a second, then disarmed; concurrent calls all complete."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        async with era.armed("me", lease_s=1):
            await asyncio.sleep(1.3)
            assert (await era.status()).state == ENABLED
        await until_state(era, READY)
        results = await asyncio.gather(*(era.status() for _ in range(50)))
        assert {status.state for status in results} == {READY}


async def test_async_client_ends_when_the_daemon_does(tmp_path: Path) -> None:
    """Calls raise Unreachable, `events` ends, also for later iterations."""

    async def count_events(era: AsyncClient) -> int:
        return len([event async for event in era.events()])

    async with running_daemon(tmp_path) as bench:
        era = await bench.client()
        await until_state(era, READY)
        await era.subscribe("state")
        counting = asyncio.create_task(count_events(era))
    assert await asyncio.wait_for(counting, 20) >= 1
    assert await asyncio.wait_for(count_events(era), 20) == 0
    with pytest.raises(Unreachable):
        await era.status()
    await era.close()


async def test_example_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Python lines of docs/reference/api.md, with the socket at its default path."""
    found = re.search(r"## In Python\n\n((?:    .*\n|\n)+)", PAGE.read_text("utf-8"))
    assert found is not None
    code = re.sub(r"^    ", "", found[1], flags=re.MULTILINE)
    async with running_daemon(tmp_path) as bench:
        monkeypatch.setattr("controller.api.client.find_socket", lambda path: bench.socket)
        async with await bench.client() as era:
            await until_state(era, READY)
            await asyncio.to_thread(exec, code, {})
            await until_state(era, READY)


def test_clients_have_the_same_methods() -> None:
    """Every method of the API, with the same parameters and result in both clients."""
    for name in METHODS:
        own = inspect.signature(getattr(Client, name))
        other = inspect.signature(getattr(AsyncClient, name))
        assert own == other
        assert list(own.parameters)[1:] or not METHODS[name].params.model_fields


@contextlib.contextmanager
def responding(path: Path, *lines: bytes) -> Iterator[None]:
    """A server that sends these lines to its first client and closes."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()

        def respond() -> None:
            with contextlib.suppress(OSError):
                client, _ = server.accept()
                with client:
                    client.recv(1000)
                    client.sendall(b"".join(lines))

        thread = threading.Thread(target=respond)
        thread.start()
        yield
        thread.join()


async def connect_error(folder: Path, *lines: bytes) -> tuple[Exception, Exception]:
    """The errors of both clients' `connect` to a server that sends these lines."""
    with responding(folder / "a", *lines), pytest.raises((Unreachable, RpcError)) as one:
        await asyncio.to_thread(Client.connect, folder / "a")
    with responding(folder / "b", *lines), pytest.raises((Unreachable, RpcError)) as other:
        await AsyncClient.connect(folder / "b")
    return one.value, other.value


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((b'{"jsonrpc":"2.0","id":1,"result":{"api_version":"2.0"}}\n',), "version 2.0"),
        ((b'{"jsonrpc":"2.0","id":1,"result":{"mood":"good"}}\n',), "update"),
        ((b'{"jsonrpc":"2.0","id":1,"error":{"code":1,"message":"?"}}\n',), "update"),
        ((b"SSH-2.0-OpenSSH_9.2\n",), "update"),
        ((), "log"),
        ((b'{"jso',), "log"),
    ],
)
async def test_connect_fails_when_the_peer_is_no_compatible_daemon(
    tmp_path: Path, lines: tuple[bytes, ...], words: str
) -> None:
    """Another major version, another program, a closed connection: Unreachable with a remedy."""
    for error in await connect_error(tmp_path, *lines):
        assert isinstance(error, Unreachable)
        assert words in str(error)


async def test_connect_raises_an_error_without_id(tmp_path: Path) -> None:
    """As sent by a daemon with too many clients before it reads anything."""
    busy = b'{"jsonrpc":"2.0","id":null,"error":{"code":1005,"message":"too many connections"}}\n'
    for error in await connect_error(tmp_path, busy):
        assert isinstance(error, RpcError)
        assert error.code is ErrorCode.BUSY


def test_connect_times_out_without_a_response(tmp_path: Path) -> None:
    """A server that accepts and stays silent."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        server.listen()
        with pytest.raises(Unreachable, match="see its log"):
            Client.connect(tmp_path / "s", timeout=0.05)


class Note(Message):
    """Parameters that exceed a socket's buffer."""

    text: str


def test_client_closes_after_an_incomplete_line(tmp_path: Path) -> None:
    """After part of a request nothing more is sent: the daemon would misread it."""
    hello = b'{"jsonrpc":"2.0","id":1,"result":{"api_version":"1.0"}}\n'
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        server.listen()
        peers: list[socket.socket] = []

        def respond() -> None:
            peers.append(server.accept()[0])
            peers[0].recv(1000)
            peers[0].sendall(hello)

        thread = threading.Thread(target=respond)
        thread.start()
        with Client.connect(tmp_path / "s", timeout=0.2) as era:
            thread.join()
            peers[0].settimeout(5)
            with peers[0] as daemon, daemon.makefile("rb") as lines:
                with pytest.raises(Unreachable):
                    era.call("note", Note(text="x" * 10_000_000), Note)
                with pytest.raises(Unreachable):
                    era.stop()
                assert lines.read().endswith(b"x")


def test_client_refuses_invalid_arguments(tmp_path: Path) -> None:
    """Before anything is sent, with the method, the key and the value."""
    with responding(tmp_path / "s"):
        era = Client(tmp_path / "s")
        for call, words in [
            (lambda: era.arm("me", lease_s=0.5), "arm: lease_s .*got 0.5"),
            (lambda: era.touch(0.1), "touch: places .*got 0.1"),  # type: ignore[arg-type]
            (lambda: era.touch((0.1, 0.05)), "place .*got 0.1"),  # type: ignore[arg-type]
            (lambda: era.play("tap", (0.1, 0.1, 0.1)), "place "),  # type: ignore[arg-type]
            (lambda: era.subscribe("weather"), "subscribe: topics.0"),  # type: ignore[arg-type]
            (lambda: Client.connect(tmp_path / "s", name="a\nb"), r"client .*got 'a\\nb'$"),
        ]:
            with pytest.raises(InputError, match=words):
                call()
        era.close()


async def test_connect_names_the_problem_of_a_path(tmp_path: Path) -> None:
    """A file that is not a socket, and a socket of which no daemon listens; text or Path."""
    (tmp_path / "rig.yaml").write_text("", encoding="utf-8")
    with pytest.raises(Unreachable, match=r"rig\.yaml is not a socket"):
        Client.connect(tmp_path / "rig.yaml")
    with pytest.raises(Unreachable, match=r"nosuch\.sock; start one"):
        Client.connect("nosuch.sock")
    with pytest.raises(Unreachable, match=r"nosuch\.sock; start one"):
        await AsyncClient.connect("nosuch.sock")


def test_find_socket_returns_the_system_socket_of_another_user(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also in a folder that cannot be read; connecting then reports whose it is."""

    def forbidden(path: Path, **options: bool) -> os.stat_result:
        if path == SYSTEM_SOCKET:
            raise PermissionError(13, "Permission denied", str(path))
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr(Path, "stat", forbidden)
    assert find_socket(None) == SYSTEM_SOCKET
    monkeypatch.undo()
    assert "another user" in str(Unreachable.at(SYSTEM_SOCKET, PermissionError()))
