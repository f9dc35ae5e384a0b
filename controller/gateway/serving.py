"""The gateway as a process: uvicorn, with bounds on what has not asked for anything yet."""

import asyncio
import contextlib
import resource
import signal
import socket
from collections.abc import AsyncIterator, Callable
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from controller.gateway.app import Gateway
from controller.gateway.settings import Settings
from model.errors import InputError

MOST_WAITING = 128  # connections that have not sent a whole request yet
FIRST_REQUEST = 5.0  # s; a connection without a request by then is closed
_MOST_CONCURRENT = 256  # requests and connections; beyond it 503
_LARGEST_MESSAGE = 1 << 16
_ENDING = 1.0  # s; for connections to end by themselves


class _Patient(H11Protocol):
    """HTTP, as uvicorn speaks it, for connections that come to ask something.

    Whoever connects and says nothing holds a place for five seconds at most, or until 128 others
    have come after; so two thousand silent connections do not keep a browser out.
    """

    _waiting: dict["_Patient", asyncio.TimerHandle] = {}  # noqa: RUF012 (of all connections)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Let it in, if need be in place of the one that has waited longest."""
        super().connection_made(transport)
        while len(self._waiting) >= MOST_WAITING:
            oldest = next(iter(self._waiting))
            oldest.heard()
            oldest.transport.abort()
        self._waiting[self] = self.loop.call_later(FIRST_REQUEST, transport.abort)

    def handle_events(self) -> None:
        """Note that it has asked, once its first request is whole."""
        super().handle_events()
        if self.cycle is not None:
            self.heard()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """A WebSocket takes the connection over."""
        self.heard()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Free its place."""
        self.heard()
        super().connection_lost(exc)

    def heard(self) -> None:
        """It does not wait any longer."""
        timer = self._waiting.pop(self, None)
        if timer is not None:
            timer.cancel()


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

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        """Not here."""
        yield


async def serve(settings: Settings, *, announce: Callable[[int], None]) -> None:
    """Serve until SIGINT or SIGTERM; announce is told the port. Raises InputError."""
    _allow_many_descriptors()
    listening = _listen(settings)
    config = uvicorn.Config(
        Gateway(settings).app,
        http=_Patient,
        ws="websockets-sansio",
        ws_max_size=_LARGEST_MESSAGE,
        ws_ping_interval=10.0,
        ws_ping_timeout=10.0,
        ws_per_message_deflate=False,  # no bombs, and nothing to win over loopback
        limit_concurrency=_MOST_CONCURRENT,
        timeout_graceful_shutdown=int(_ENDING),
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,  # whoever calls could write into them what it likes
        ssl_certfile=settings.certificate,
        ssl_keyfile=settings.key,
    )
    server = _Server(config, announce=announce)
    async with _ending(server):
        await server.serve(sockets=[listening])


def _listen(settings: Settings) -> socket.socket:
    """The socket to listen on."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
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
