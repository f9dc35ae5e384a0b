"""Both Python clients against a daemon over a wire, and against what is no daemon."""

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
from controller.api.methods import METHODS, ArmResult
from controller.api.schema import Message
from controller.api.socket_path import SYSTEM_SOCKET, find_socket
from daemon_bench import PLACE, running_daemon, until_state
from model.errors import InputError

PAGE = Path(controller.__file__).parent.parent / "docs" / "reference" / "api.md"
READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"


async def test_the_waiting_client_does_all_there_is(tmp_path: Path) -> None:
    """Armed for longer than a lease, touched, told of it, stopped, cleared: from another thread."""
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
                seen += [told.topic for told in era.events(timeout=0.2)]
            return seen

        async with await bench.client() as era:
            await until_state(era, READY)
        seen = await asyncio.to_thread(study)
        assert seen[:2] == [ENABLED, READY]
        assert "pattern" in seen[2:]
        assert seen.count("state") >= 6


async def test_the_asyncio_client_keeps_its_lease(tmp_path: Path) -> None:
    """Armed for longer than a lease of a second, then disarmed by the end of the block."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        async with era.armed("me", lease_s=1):
            await asyncio.sleep(1.3)
            assert (await era.status()).state == ENABLED
        await until_state(era, READY)
        answers = await asyncio.gather(*(era.status() for _ in range(50)))
        assert {answer.state for answer in answers} == {READY}


async def test_a_daemon_that_ends_is_told_to_whoever_waits(tmp_path: Path) -> None:
    """Calls raise Unreachable, events come to their end, for whoever listens later, too."""
    async with running_daemon(tmp_path) as bench:
        era = await bench.client()
        await until_state(era, READY)
        await era.subscribe("state")
        listening = asyncio.create_task(_all_events(era))
    assert await asyncio.wait_for(listening, 20) >= 1
    assert await asyncio.wait_for(_all_events(era), 20) == 0
    with pytest.raises(Unreachable):
        await era.status()
    await era.close()


async def _all_events(era: AsyncClient) -> int:
    return len([told async for told in era.events()])


async def test_the_example_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The Python lines of the page, as they stand there, with the socket in its usual place."""
    found = re.search(r"## In Python\n\n((?:    .*\n|\n)+)", PAGE.read_text("utf-8"))
    assert found is not None
    code = re.sub(r"^    ", "", found[1], flags=re.MULTILINE)
    async with running_daemon(tmp_path) as bench:
        monkeypatch.setattr("controller.api.client.find_socket", lambda path: bench.socket)
        async with await bench.client() as era:
            await until_state(era, READY)
            running = asyncio.create_task(asyncio.to_thread(exec, code, {}))
            await running
            await until_state(era, READY)


@contextlib.contextmanager
def answering(path: Path, *lines: bytes) -> Iterator[None]:
    """Somebody at a socket who says these lines to the first who asks, and hangs up."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()

        def answer() -> None:
            with contextlib.suppress(OSError):
                client, _ = server.accept()
                with client:
                    client.recv(1000)
                    client.sendall(b"".join(lines))

        thread = threading.Thread(target=answer)
        thread.start()
        yield
        thread.join()


HELLO = (
    b'{"jsonrpc":"2.0","id":1,"result":{"api_version":"2.0","software_version":"9","rig":'
    b'{"length_m":1,"width_m":1,"eras":[],"simulated":true,"frequency_hz":[]},"table":'
    b'{"fingerprint":"","mode":"","frequencies_hz":[],"cells_x":1,"cells_y":1},"rig_text":"",'
    b'"layout":null}}\n'
)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ((HELLO,), r"speaks version 2\.0 of the API"),
        (
            (b'{"jsonrpc":"2.0","id":1,"result":{"api_version":"2.0"}}\n',),
            r"version 2\.0 of the API",
        ),
        ((b'{"jsonrpc":"2.0","id":1,"result":{"mood":"good"}}\n',), "does not understand"),
        ((b'{"jsonrpc":"2.0","id":1,"error":{"code":1,"message":"?"}}\n',), "does not understand"),
        ((b"SSH-2.0-OpenSSH_9.2\n",), "does not understand"),
        ((), "is gone"),
        ((b'{"jso',), "is gone"),
    ],
)
async def test_whoever_answers_otherwise_is_no_daemon_of_ours(
    tmp_path: Path, lines: tuple[bytes, ...], message: str
) -> None:
    """Another major version, or a connection that ends: one error for both clients."""
    with answering(tmp_path / "a", *lines), pytest.raises(Unreachable, match=message):
        await asyncio.to_thread(Client.connect, tmp_path / "a")
    with answering(tmp_path / "b", *lines), pytest.raises(Unreachable, match=message):
        await AsyncClient.connect(tmp_path / "b")


async def test_a_refusal_of_the_whole_connection_is_told(tmp_path: Path) -> None:
    """It is the answer to no request in particular, and so to the one that was asked."""
    busy = b'{"jsonrpc":"2.0","id":null,"error":{"code":1005,"message":"too many connections"}}\n'
    with answering(tmp_path / "a", busy), pytest.raises(RpcError, match="too many") as caught:
        await asyncio.to_thread(Client.connect, tmp_path / "a")
    assert caught.value.code is ErrorCode.BUSY
    with answering(tmp_path / "b", busy), pytest.raises(RpcError, match="too many"):
        await AsyncClient.connect(tmp_path / "b")


@pytest.mark.parametrize("client", [Client, AsyncClient])
def test_both_clients_have_every_method_with_its_parameters(
    client: type[Client] | type[AsyncClient],
) -> None:
    """As a notebook shows them: the signature, what comes back, and a sentence on each."""
    for name in METHODS:
        assert getattr(client, name).__doc__
    assert list(inspect.signature(client.arm).parameters) == ["self", "owner", "lease_s"]
    assert inspect.signature(client.arm).return_annotation is ArmResult


def test_a_daemon_that_does_not_answer_is_given_up(tmp_path: Path) -> None:
    """After the timeout, with what to do about it."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        server.listen()
        with pytest.raises(Unreachable, match="does not answer"):
            Client.connect(tmp_path / "s", timeout=0.05)


class Note(Message):
    """More than fits into a socket's buffer."""

    text: str


def test_half_a_line_is_never_gone_on_with(tmp_path: Path) -> None:
    """A daemon that reads no more got half of a question: the connection is over, as for all."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        server.listen()
        peers: list[socket.socket] = []

        def greet() -> None:
            peers.append(server.accept()[0])
            peers[0].recv(1000)
            peers[0].sendall(HELLO.replace(b'"2.0","soft', b'"1.0","soft'))

        thread = threading.Thread(target=greet)
        thread.start()
        with Client.connect(tmp_path / "s", timeout=0.2) as era:
            thread.join()
            peers[0].settimeout(5)
            with peers[0] as daemon, daemon.makefile("rb") as lines:
                with pytest.raises(Unreachable, match="does not answer"):
                    era.call("note", Note(text="x" * 10_000_000), Note)
                with pytest.raises(Unreachable):
                    era.stop()
                assert lines.read().endswith(b"x")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (3, "name is 3; it must be a text"),
        ("", "name is ''; it must have at least 1 character"),
        ("a\nb", r"name is 'a\\nb'; it must be one line, without characters that a terminal obeys"),
    ],
)
async def test_a_name_that_cannot_be_sent_is_told_before_anybody_is_called(
    name: str, said: str, tmp_path: Path
) -> None:
    """In our words, and by what it is called here; no daemon is needed for that."""
    with pytest.raises(InputError, match=f"^{said}$"):
        Client.connect(tmp_path / "nobody", name=name)
    with pytest.raises(InputError, match=f"^{said}$"):
        await AsyncClient.connect(tmp_path / "nobody", name=name)


def test_what_is_no_socket_is_named_as_such(tmp_path: Path) -> None:
    """A file where the socket was meant: nobody should start a daemon for it."""
    (tmp_path / "rig.yaml").write_text("", encoding="utf-8")
    with pytest.raises(Unreachable, match=r"rig\.yaml is no socket; give the one"):
        Client.connect(tmp_path / "rig.yaml")


async def test_a_socket_may_be_named_by_text() -> None:
    """As rigs and tables may: whoever types a name at a prompt gets what is wrong with it."""
    with pytest.raises(Unreachable, match=r"no daemon runs at nosuch\.sock; start one"):
        Client.connect("nosuch.sock")
    with pytest.raises(Unreachable, match=r"no daemon runs at nosuch\.sock; start one"):
        await AsyncClient.connect("nosuch.sock")


def test_a_daemon_of_others_is_named_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where one may not even look into its folder, connecting is what tells whose it is."""

    def forbidden(path: Path, **options: bool) -> os.stat_result:
        if path == SYSTEM_SOCKET:
            raise PermissionError(13, "Permission denied", str(path))
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr(Path, "stat", forbidden)
    assert find_socket(None) == SYSTEM_SOCKET
    monkeypatch.undo()
    assert "belongs to somebody else" in str(Unreachable.at(SYSTEM_SOCKET, PermissionError()))
