"""The gateway's server process: uvicorn, its socket, and its end within a second."""

import asyncio
import contextlib
import logging
import os
import re
import signal
import socket
import ssl
from collections.abc import Callable, Iterator

import uvicorn

from controller.api.admission import allow_many_descriptors
from controller.gateway.app import Gateway
from controller.gateway.connections import HttpConnection, WebSocketConnection
from controller.gateway.settings import Settings
from model.errors import InputError

_MAX_CONCURRENT = 256  # requests and connections; above it 503
_MAX_MESSAGE = 1 << 16  # bytes
_SEND_BUFFER = 1 << 17  # bytes per connection in the system's buffer
_NICENESS = 10  # added, so that the daemon's control loop has priority
_SHUTDOWN_TIMEOUT = 0.3  # s; for connections to close by themselves


class _Server(uvicorn.Server):
    """Ends within a short time, whatever its clients do; at a signal with an exit status of 0."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Shut down at SIGINT and SIGTERM; else the exit status would be the signal's."""
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, self.handle_exit, number, None)
        yield

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close connections, aborting those that do not close in time."""
        asyncio.get_running_loop().call_later(_SHUTDOWN_TIMEOUT, self._abort)
        await super().shutdown(sockets)

    def _abort(self) -> None:
        for connection in list(self.server_state.connections):
            connection.transport.abort()
        self.force_exit = True  # aborting TLS may wait for the peer


async def serve(settings: Settings, *, announce: Callable[[int], None]) -> None:
    """Serve until SIGINT or SIGTERM; announce: called with the port. Raises InputError."""
    with contextlib.suppress(OSError):  # a service may be forbidden to
        os.nice(_NICENESS)
    allow_many_descriptors()
    check_certificate(settings)
    gateway = Gateway(settings)
    listening = listen(settings)
    config = uvicorn.Config(
        gateway.app,
        http=HttpConnection,
        ws=WebSocketConnection,
        ws_max_size=_MAX_MESSAGE,
        ws_ping_interval=10.0,
        ws_ping_timeout=10.0,
        ws_per_message_deflate=False,  # no decompression bombs
        limit_concurrency=_MAX_CONCURRENT,
        timeout_graceful_shutdown=1,
        lifespan="off",
        log_level="error",  # clients can cause warnings without limit
        access_log=False,
        server_header=False,
        proxy_headers=False,  # clients can forge them
        ssl_certfile=settings.certificate,
        ssl_keyfile=settings.key,
    )
    # Of texts of clients that are not UTF-8, each of which it logs.
    logging.getLogger("uvicorn.error").addFilter(
        lambda record: not (record.exc_info and record.exc_info[0] is UnicodeDecodeError)
    )
    server = _Server(config)
    own = asyncio.create_task(gateway.run())
    # It never ends by itself: one that fails ends the process, which then says why.
    own.add_done_callback(lambda _: server.handle_exit(signal.SIGTERM, None))
    announce(listening.getsockname()[1])
    await server.serve(sockets=[listening])
    own.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await own


def check_certificate(settings: Settings) -> None:
    """Check that certificate and key can be read and match; raises InputError."""
    if settings.certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(
            *(settings.certificate, settings.key),
            password="",  # without it OpenSSL would prompt for one
        )
    except (OSError, ValueError) as error:
        text = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        reason = re.sub(r"^\[\w+\] | \(_ssl\.c:\d+\)$", "", str(text))
        raise InputError(
            f"{settings.certificate} and {settings.key} cannot be used for TLS ({reason}); give a "
            "certificate chain and its key, both PEM, the key without password"
        ) from error


def listen(settings: Settings) -> socket.socket:
    """Listen on a socket of its own; raises InputError."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # With IPPROTO_TCP given asyncio sets TCP_NODELAY; without it a response's body waits 40 ms for
    # the acknowledgement of its head.
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Inherited by accepted connections; the system's default limit is some megabytes.
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        listening.bind((settings.host, settings.port))
        listening.listen()
    except OSError as error:
        listening.close()
        raise InputError(
            f"cannot listen on {settings.host} port {settings.port} ({error.strerror}); stop the "
            "other program or give another port (--listen)"
        ) from error
    return listening
