"""The control socket: JSON lines over a Unix socket that only its owner may open.

The operations are documented in `sim.control.operations`.
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

from drivers.errors import LinkError
from registry import threads
from sim.control.context import SimulationContext
from sim.control.operations import carry_out

LINE_MAX = 64 * 1024  # bytes; thirty fingers take a tenth of it


@asynccontextmanager
async def control_socket(context: SimulationContext, path: Path) -> AsyncIterator[None]:
    """Serve control at a path; raises LinkError where no socket can be created."""
    sock = _bind(path)
    loop = asyncio.get_running_loop()
    clients: dict[asyncio.Task[None], socket.socket] = {}

    def forget(client: asyncio.Task[None]) -> None:
        clients.pop(client).close()

    def accept() -> None:
        try:
            connection, _ = sock.accept()
        except OSError:  # the client has disconnected already
            return
        connection.setblocking(False)
        client = loop.create_task(_serve_client(context, connection), name=f"control at {path}")
        clients[client] = connection
        client.add_done_callback(forget)

    loop.add_reader(sock, accept)
    try:
        yield
    finally:
        loop.remove_reader(sock)
        sock.close()
        await asyncio.to_thread(path.unlink, missing_ok=True)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)
        await context.stop_solving()


async def _serve_client(context: SimulationContext, connection: socket.socket) -> None:
    """Serve a client line by line until it disconnects."""
    loop = asyncio.get_running_loop()
    rest = b""
    with contextlib.suppress(ConnectionError):
        while data := await loop.sock_recv(connection, LINE_MAX):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                response = await carry_out(context, line, now=threads.now())
                await loop.sock_sendall(connection, await asyncio.to_thread(_encode, response))
            if len(rest) > LINE_MAX:  # the next line cannot be found
                error = {"error": f"line must be at most {LINE_MAX} bytes"}
                await loop.sock_sendall(connection, _encode(error))
                return


def _encode(reply: dict[str, Any]) -> bytes:
    return json.dumps(reply, separators=(",", ":")).encode() + b"\n"


def _bind(path: Path) -> socket.socket:
    """Create a listening socket for the owner only; a stale one is replaced."""
    sock = socket.socket(socket.AF_UNIX)
    mask = os.umask(0o177)
    try:
        if path.is_socket() and _is_dead(path):
            path.unlink()
        sock.bind(str(path))
        sock.listen()
        sock.setblocking(False)
    except OSError as error:
        sock.close()
        raise LinkError(
            f"{path}: cannot create control socket: {error.strerror or error}; give an unused path "
            "of under 100 characters in a writable folder"
        ) from error
    finally:
        os.umask(mask)
    return sock


def _is_dead(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return True
    return False
