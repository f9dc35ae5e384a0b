"""The gateway's server process: aiohttp, its socket, and its end within a second."""

import asyncio
import contextlib
import logging
import os
import signal
import socket
import ssl
from collections.abc import Callable

from aiohttp import web
from aiohttp.http import HttpProcessingError

from controller.api.connection import allow_many_descriptors
from controller.gateway.app import Gateway
from controller.gateway.connections import CLIENT_TIMEOUT, ConnectionAcceptor
from controller.gateway.settings import Settings
from model.errors import InputError
from registry.threads import no_long_collections

_MAX_LINE = 1 << 13  # bytes; of the head of a request
_MAX_LINES = 64
_SEND_BUFFER = 1 << 17  # bytes per connection in the system's buffer
_RECEIVE_BUFFER = 1 << 16  # likewise; about what is received in one turn of the event loop
_QUEUE = 512  # connections that wait to be accepted
_NICENESS = 10  # added, so that the daemon's control loop has priority
_SHUTDOWN_TIMEOUT = 0.3  # s; for requests to end by themselves


async def serve(settings: Settings, *, announce: Callable[[int], None]) -> None:
    """Serve until SIGINT or SIGTERM; announce: called with the port. Raises InputError."""
    with contextlib.suppress(OSError):  # a service may be forbidden to
        os.nice(_NICENESS)
    allow_many_descriptors()
    tls = load_certificate(settings)
    gateway = Gateway(settings)
    listening = listen(settings)
    failures = logging.getLogger(f"{__name__}.requests")
    failures.addFilter(_is_own_failure)
    runner = web.AppRunner(
        gateway.app,
        access_log=None,
        logger=failures,
        auto_decompress=False,  # no decompression bombs
        max_line_size=_MAX_LINE,
        max_field_size=_MAX_LINE,
        max_headers=_MAX_LINES,
        lingering_time=0,  # the connections'
        read_bufsize=1 << 12,  # bytes of a body that wait to be read
        keepalive_timeout=2 * CLIENT_TIMEOUT,  # the acceptor's comes first
        shutdown_timeout=_SHUTDOWN_TIMEOUT,
    )
    await runner.setup()
    assert runner.server is not None  # noqa: S101 (it is set up)
    over = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, over.set)
    # It never ends by itself: a part that fails ends the process, which then says why.
    own = asyncio.gather(
        gateway.field.run(),
        gateway.keep_connected(),
        ConnectionAcceptor(runner.server, tls).run(listening),
    )
    own.add_done_callback(lambda _: over.set())
    announce(listening.getsockname()[1])
    with no_long_collections():  # of connections that a storm leaves, nothing else is visited
        await over.wait()
    listening.close()
    await runner.cleanup()
    own.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await own


def _is_own_failure(record: logging.LogRecord) -> bool:
    """Whether it is not of a client, which has left or sends what is not HTTP."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, OSError | HttpProcessingError)


def load_certificate(settings: Settings) -> ssl.SSLContext | None:
    """Load certificate and key, None without; raises InputError unless they match."""
    if settings.certificate is None:
        return None
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        tls.load_cert_chain(
            *(settings.certificate, settings.key),
            password="",  # without it OpenSSL would prompt for one
        )
    except (OSError, ValueError) as error:
        reason = str(getattr(error, "strerror", None) or error).partition(" (_ssl.c")[0]
        raise InputError(
            f"{settings.certificate} and {settings.key} cannot be used for TLS ({reason}); give a "
            "certificate chain and its key, both PEM, the key without password"
        ) from error
    return tls


def listen(settings: Settings) -> socket.socket:
    """Listen on a socket of its own; raises InputError."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        listening = socket.create_server(
            (settings.host, settings.port),
            family=family,
            backlog=_QUEUE,
            dualstack_ipv6=family == socket.AF_INET6,
        )
    except OSError as error:
        raise InputError(
            f"cannot listen on {settings.host} port {settings.port} "
            f"({os.strerror(error.errno or 0)}); stop the other program or give another port "
            "(--listen; of a daemon --dashboard, or dashboard in its file)"
        ) from error
    # Inherited by accepted connections; the system's default limits are some megabytes.
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    listening.setblocking(False)
    return listening
