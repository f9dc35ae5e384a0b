"""Control of a running far end: JSON, a line each way, over a Unix socket for its owner only.

What may be asked stands in `sim.control.operations`.
"""

import asyncio
import contextlib
import json
import os
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from drivers import clock
from drivers.errors import LinkError
from sim.control.answers import Answer, Wait
from sim.control.context import SimulationContext
from sim.control.operations import carry_out

LINE_MAX = 64 * 1024  # bytes; thirty fingers take a tenth of it


@asynccontextmanager
async def control_socket(context: SimulationContext, path: Path) -> AsyncIterator[None]:
    """Serve control of a far end at a path; raises LinkError where no socket can be made."""
    sock = _bind(path)
    loop = asyncio.get_running_loop()
    clients: dict[asyncio.Task[None], socket.socket] = {}

    def forget(client: asyncio.Task[None]) -> None:
        clients.pop(client).close()

    def accept() -> None:
        try:
            connection, _ = sock.accept()
        except OSError:  # the client has left again already
            return
        connection.setblocking(False)
        client = loop.create_task(_converse(context, connection), name=f"control at {path}")
        clients[client] = connection
        client.add_done_callback(forget)

    loop.add_reader(sock, accept)
    try:
        yield
    finally:
        loop.remove_reader(sock)
        sock.close()
        _remove(path)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)


async def _converse(context: SimulationContext, connection: socket.socket) -> None:
    """Answer a client line by line until it leaves. Plain sockets: no transport to outlive us."""
    loop = asyncio.get_running_loop()
    rest = b""
    with contextlib.suppress(ConnectionError):
        while data := await loop.sock_recv(connection, LINE_MAX):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                make_answer = carry_out(context, line, now=clock.now())
                if isinstance(make_answer, Wait):
                    await make_answer.passes()
                    make_answer = make_answer.then
                # A long fit must not hold up the amplifiers, whose hosts wait for 50 ms at most.
                reply = await asyncio.to_thread(_encode_made, make_answer)
                await loop.sock_sendall(connection, reply)
            if len(rest) > LINE_MAX:  # where the next line starts will never be known: hang up
                error = {"error": f"a line is longer than {LINE_MAX} bytes"}
                await loop.sock_sendall(connection, _encode(error))
                return


def _encode_made(make_answer: Answer) -> bytes:
    return _encode(make_answer())


def _encode(reply: dict[str, Any]) -> bytes:
    return json.dumps(reply, separators=(",", ":")).encode() + b"\n"


def _bind(path: Path) -> socket.socket:
    """A listening socket that only its owner may use; takes the place of one that is dead."""
    sock = socket.socket(socket.AF_UNIX)
    mask = os.umask(0o177)  # from its first moment on
    try:
        if path.is_socket() and _is_dead(path):
            path.unlink()
        sock.bind(str(path))
        sock.listen()
        sock.setblocking(False)
    except OSError as error:
        sock.close()
        raise LinkError(
            f"no control socket can be made at {path} ({error.strerror or error}): give a path "
            "of under 100 characters in a folder of yours that no other program serves at"
        ) from error
    finally:
        os.umask(mask)
    return sock


def _remove(path: Path) -> None:
    path.unlink(missing_ok=True)


def _is_dead(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return True
    return False
