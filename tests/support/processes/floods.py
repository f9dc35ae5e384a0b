"""Floods of a daemon, each a process: `python tests/support/processes/floods.py KIND ...`.

    idle SOCKET COUNT         silent connections
    unreading SOCKET COUNT    connections that subscribe to everything and read nothing
    garbage SOCKET SEED       invalid requests as fast as possible
    asking SOCKET COUNT       requests as fast as they are served, on several connections
    again SOCKET COUNT        subscribers that connect again when they are closed, 2000 in a second

They run until their standard input ends; each prints `ready` once it runs.
"""

import asyncio
import contextlib
import json
import random
import resource
import select
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager

_SUBSCRIBE = {
    "topics": ["state", "contacts", "pattern", "silence", "amplifiers", "latency", "log", "link"],
    "rate_hz": 60,
}


@asynccontextmanager
async def flood(kind: str, *arguments: object) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run one of them; killed with the context."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", __file__, kind, *map(str, arguments)),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert await process.stdout.readline() == b"ready\n"
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


def _print(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _is_over() -> bool:
    return bool(select.select([sys.stdin], [], [], 0)[0])


def _connect(path: str) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(path)
    return connection


def _idle(path: str, count: str) -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    connections = []
    _print("ready")
    while len(connections) < int(count):
        connections.append(_connect(path))
    _print(str(len(connections)))
    sys.stdin.read()


def _unreading(path: str, count: str) -> None:
    connections = [_connect(path) for _ in range(int(count))]
    lines = [
        {"jsonrpc": "2.0", "id": 1, "method": "subscribe", "params": _SUBSCRIBE},
        *(
            {"jsonrpc": "2.0", "id": n, "method": "hello", "params": {"client": "x"}}
            for n in (2, 3)
        ),
    ]
    data = b"".join(json.dumps(line).encode() + b"\n" for line in lines)
    for connection in connections:
        with contextlib.suppress(OSError):  # closed in favour of another
            connection.sendall(data)
    _print("ready")
    sys.stdin.read()


def _garbage(path: str, seed: str) -> None:
    chance = random.Random(int(seed))
    deep = 20_000
    makers: Sequence[Callable[[], bytes]] = (
        lambda: chance.randbytes(chance.randrange(1, 5000)),
        lambda: b"[" * deep + b"\n",
        lambda: b'{"a":' * deep + b"\n",
        lambda: b"9" * 60_000 + b"\n",
        lambda: b"x" * 70_000,
        lambda: (
            b'{"jsonrpc":"2.0","id":1,"method":"arm","params":{"owner":"\\ud800","lease_s":NaN}}\n'
        ),
        lambda: b'{"jsonrpc":"2.0","id":1e999,"method":"touch","params":{}}\n',
        lambda: (
            b'{"jsonrpc":"2.0","id":1,"method":"touch","params":{"source":"g","touches":'
            b'[{"id":1,"x_m":1e999,"y_m":NaN}]}}\n'
        ),
        lambda: (
            b'{"jsonrpc":"2.0","id":1,"method":"renew","params":{"lease":"%d"}}\n'
            % chance.getrandbits(128)
        ),
        lambda: b"\xff\xfe\x00\n" * 100,
        lambda: b"!!python/object/apply:os.system [exit]\n" * 10,
        lambda: b"cos\nsystem\n(S'exit'\ntR.\n",
    )
    _print("ready")
    while not _is_over():
        with contextlib.suppress(OSError), _connect(path) as connection:
            connection.settimeout(1.0)
            for _ in range(20):
                connection.sendall(chance.choice(makers)())


def _asking(path: str, count: str) -> None:
    connections = [_connect(path) for _ in range(int(count))]
    many = b'{"jsonrpc":"2.0","id":1,"method":"status"}\n' * 50
    for connection in connections:
        connection.setblocking(False)
    _print("ready")
    while not _is_over():
        readable, writable, _ = select.select(connections, connections, [], 0.1)
        with contextlib.suppress(BlockingIOError):
            for connection in readable:
                connection.recv(1 << 16)
            for connection in writable:
                connection.send(many)


def _again(path: str, count: str) -> None:
    line = {"jsonrpc": "2.0", "id": 1, "method": "subscribe", "params": _SUBSCRIBE}
    subscribe = json.dumps(line).encode() + b"\n"
    poll = select.poll()
    connections: dict[int, socket.socket] = {}
    begin, connection_count = time.monotonic(), 0
    _print("ready")
    while not _is_over():
        while len(connections) < int(count) and connection_count < 2000 * (
            time.monotonic() - begin
        ):
            connection = _connect(path)
            with contextlib.suppress(OSError):
                connection.sendall(subscribe)
            connection.setblocking(False)
            connections[connection.fileno()] = connection
            poll.register(connection, select.POLLIN)
            connection_count += 1
        for number, _ in poll.poll(1):
            try:
                is_open = bool(connections[number].recv(1 << 16))
            except OSError:
                is_open = False
            if not is_open:
                poll.unregister(number)
                connections.pop(number).close()
    _print(f"{connection_count / (time.monotonic() - begin):.0f}")


_KINDS = {
    "idle": _idle,
    "unreading": _unreading,
    "garbage": _garbage,
    "asking": _asking,
    "again": _again,
}


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt, OSError):  # the daemon may end first
        _KINDS[sys.argv[1]](*sys.argv[2:])
