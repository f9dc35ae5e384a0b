"""The gateway as a process: uvicorn, from a socket to its end within a second."""

import asyncio
import contextlib
import os
import re
import resource
import signal
import socket
import ssl
from collections.abc import AsyncIterator, Callable
from typing import Any

import uvicorn

from controller.gateway.app import Gateway
from controller.gateway.connections import HttpConnection, WebSocketConnection
from controller.gateway.settings import Settings
from model.errors import InputError

_MOST_CONCURRENT = 256  # requests and connections; beyond it 503
_LARGEST_MESSAGE = 1 << 16
_MOST_SENT = 1 << 17  # bytes that the system keeps of what a connection has not read
_NICER = 10  # than whoever starts it: the daemon's control loop goes first where both want to run
_ENDING = 0.3  # s; for connections to end by themselves


class _Server(uvicorn.Server):
    """Tells where it listens; leaves signals to the command, which wants its own exit status."""

    def __init__(self, config: uvicorn.Config, *, announce: Callable[[int], None]) -> None:
        super().__init__(config)
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and say so."""
        await super().startup(sockets)
        if sockets and self.started:
            self._announce(sockets[0].getsockname()[1])

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End; who does not read or never ends what it says is not waited for."""
        asyncio.get_running_loop().call_later(_ENDING, self._abort)
        await super().shutdown(sockets)

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        """Not here."""
        yield

    def _abort(self) -> None:
        for connection in list(self.server_state.connections):
            connection.transport.abort()
        self.force_exit = True  # an abort of TLS may wait for the other side


async def serve(settings: Settings, *, announce: Callable[[int], None]) -> None:
    """Serve until SIGINT or SIGTERM; announce is told the port. Raises InputError."""
    os.nice(_NICER)
    _allow_many_descriptors()
    _check_certificate(settings)
    gateway = Gateway(settings)
    listening = listen(settings)
    config = uvicorn.Config(
        gateway.app,
        http=HttpConnection,
        ws=WebSocketConnection,
        ws_max_size=_LARGEST_MESSAGE,
        ws_ping_interval=10.0,
        ws_ping_timeout=10.0,
        ws_per_message_deflate=False,  # no bombs, and nothing to win over loopback
        limit_concurrency=_MOST_CONCURRENT,
        timeout_graceful_shutdown=1,
        lifespan="off",
        log_level="error",  # its warnings are of what others send, as often as they like
        access_log=False,
        server_header=False,
        proxy_headers=False,  # whoever calls could write into them what it likes
        ssl_certfile=settings.certificate,
        ssl_keyfile=settings.key,
    )
    server = _Server(config, announce=announce)
    following = asyncio.create_task(gateway.follow())
    # Without it the page would show for ever what was so last.
    following.add_done_callback(lambda _: setattr(server, "should_exit", True))
    try:
        async with _ending(server):
            await server.serve(sockets=[listening])
    finally:
        following.cancel()
        await asyncio.wait({following})
    if not following.cancelled():
        following.result()


def _check_certificate(settings: Settings) -> None:
    """Whether certificate and key are some, and belong together; raises InputError."""
    if settings.certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(
            *(settings.certificate, settings.key),
            password="",  # of a key that has one; nobody shall be asked for it at a start
        )
    except (OSError, ValueError) as error:
        said = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        reason = re.sub(r"^\[\w+\] | \(_ssl\.c:\d+\)$", "", str(said))
        raise InputError(
            f"{settings.certificate} and {settings.key} cannot be used for TLS ({reason}): give a "
            "certificate chain and the key that belongs to it, PEM both, the key without password"
        ) from error


def listen(settings: Settings) -> socket.socket:
    """The socket to listen on; raises InputError."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # Over sockets that say TCP asyncio sends at once; else the body of an answer waits 40 ms for
    # the other side's acknowledgement of its head.
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Of each connection that comes; the system's own bound is some megabytes.
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MOST_SENT)
        listening.bind((settings.host, settings.port))
    except OSError as error:
        listening.close()
        raise InputError(
            f"the gateway cannot listen on {settings.host} port {settings.port} "
            f"({error.strerror}); another program may use it: stop that or name another port"
        ) from error
    return listening


@contextlib.asynccontextmanager
async def _ending(server: uvicorn.Server) -> AsyncIterator[None]:
    """SIGINT and SIGTERM end the server in order."""
    loop = asyncio.get_running_loop()

    def end() -> None:
        server.should_exit = True

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, end)
    try:
        yield
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)


def _allow_many_descriptors() -> None:
    """As many open files as may be: connections that only connect must not use them up."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = 65_536 if hard == resource.RLIM_INFINITY else hard
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
