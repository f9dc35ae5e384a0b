"""The gateway flooded and killed, without effect on the daemon's control loop.

The daemon is a process over a simulated amplifier, armed, with a finger down. Its amplifier faults
without a heartbeat within its watchdog, the longest of the protocol here, so a control loop that
stands still shows as another state than OPERATION_ENABLED.
"""

import contextlib
import socket
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from controller.api.client import Client
from daemons import PATIENCE, PLACE
from gateway_bench import (
    ERA,
    TOKEN,
    GatewayProcess,
    RawWebSocket,
    frame,
    gateway_process,
    has_ended,
    http,
    real_daemon,
    upgrade,
    wait_for,
    wait_for_daemon,
    wait_for_state,
)
from patient_daemon import PROGRAM

pytestmark = pytest.mark.real_time

ENABLED = "OPERATION_ENABLED"

IMPATIENT = """
import sys
from controller.cli.main import main
from controller.gateway import app, bridge, connections
app.CLIENT_TIMEOUT = connections.CLIENT_TIMEOUT = bridge.SEND_TIMEOUT = 1.0
sys.exit(main())
"""
"""`era` with shorter timeouts of the gateway."""


@dataclass
class Watch:
    """A client of the daemon that holds a finger down."""

    looks: int = 0
    has_failed: bool = False
    over: threading.Event = field(default_factory=threading.Event)

    def run(self, path: Path) -> None:
        """Watch, and note a failure."""
        try:
            self._run(path)
        except BaseException:
            self.has_failed = True
            raise

    def _run(self, path: Path) -> None:
        """Renew the lease, repeat the touch and read the status fifty times a second."""
        with Client.connect(path, name="watch", timeout=PATIENCE) as era:
            lease = era.arm("watch", lease_s=60).lease
            while not self.over.wait(0.02):
                era.touch([PLACE])
                status = era.status()
                assert status.state == ENABLED, status.cause
                era.renew(lease)
                self.looks += 1
            era.disarm()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of one daemon for all tests."""
    with real_daemon(tmp_path_factory.mktemp("daemon"), program=PROGRAM) as path:
        yield path


@pytest.fixture
def watched(daemon: Path) -> Iterator[Watch]:
    """The daemon armed and watched; it must stay armed."""
    watch = Watch()
    thread = threading.Thread(target=watch.run, args=(daemon,))
    with Client.connect(daemon, name="test") as era:
        wait_for_state(era, "READY_TO_SWITCH_ON")
        thread.start()
        try:
            wait_for(lambda: watch.looks > 5 or not thread.is_alive())
            yield watch
        finally:
            watch.over.set()
            thread.join()
        assert not watch.has_failed


@pytest.fixture
def gateway(
    request: pytest.FixtureRequest, watched: Watch, daemon: Path, tmp_path: Path
) -> Iterator[GatewayProcess]:
    """A gateway, which must not log anything; parameter: the command instead of `era`."""
    program = getattr(request, "param", (ERA,))
    with gateway_process(tmp_path, daemon, program=program) as made:
        wait_for_daemon(made)
        yield made
        if made.process.poll() is None:
            assert made.log() == ""


def assert_served(gateway: GatewayProcess) -> None:
    """A new client is served over HTTP and over a WebSocket."""
    assert http(gateway, "/api/v1/effects", body=b"{}").status == 200
    with RawWebSocket(gateway) as ws:
        ws.call("effects", {})
        assert ws.response()["result"]


def deaf_connection(gateway: GatewayProcess) -> socket.socket:
    """A connection with a small receive buffer."""
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    made.settimeout(60)
    made.connect(("127.0.0.1", gateway.port))
    return made


def test_gateway_serves_with_two_thousand_silent_connections(gateway: GatewayProcess) -> None:
    """The oldest are closed until 128 are left."""
    with contextlib.ExitStack() as held:
        silent = [held.enter_context(gateway.connect()) for _ in range(2000)]
        assert_served(gateway)
        wait_for(lambda: sum(not has_ended(each) for each in silent) <= 128)
        assert_served(gateway)


def trickles(gateway: GatewayProcess) -> list[bytes]:
    """Incomplete requests: a header, a body, a refused request, a second request."""
    head = f"POST /api/v1/arm HTTP/1.1\r\nHost: {gateway.host}\r\n"
    full = f"{head}Authorization: Bearer {TOKEN}\r\nContent-Type: application/json\r\n"
    begun = (
        head,
        f"{full}Content-Length: 100\r\n\r\n",
        f"{full}Transfer-Encoding: chunked\r\n\r\n",
        f"{head}Content-Length: 100\r\n\r\n",  # refused at once, without a token
        f"{full}Content-Length: 2\r\n\r\n{{}}{head}",
    )
    return [request.encode() for request in begun]


@pytest.mark.parametrize("gateway", [(sys.executable, "-c", IMPATIENT)], indirect=True)
def test_gateway_closes_connections_that_trickle_or_do_not_read(gateway: GatewayProcess) -> None:
    """Single bytes do not extend a timeout; other clients are served meanwhile."""
    page = f"GET /app.js HTTP/1.1\r\nHost: {gateway.host}\r\n\r\n".encode()
    hello = frame(b'{"jsonrpc":"2.0","id":1,"method":"hello","params":{"client":"me"}}')
    with contextlib.ExitStack() as held:
        left: list[tuple[socket.socket, bytes]] = []
        for begun in trickles(gateway):
            slow = held.enter_context(gateway.connect())
            slow.sendall(begun)
            left.append((slow, b"1"))
        for number in range(20):
            deaf = held.enter_context(deaf_connection(gateway))
            if number % 2:
                deaf.sendall(upgrade(gateway))
            left.append((deaf, 20 * (hello if number % 2 else page)))
        assert_served(gateway)
        end = time.monotonic() + PATIENCE
        while left:
            assert time.monotonic() < end, f"{len(left)} are still there"
            for each in list(left):
                connection, more = each
                connection.setblocking(False)
                try:
                    connection.send(more)
                except BlockingIOError:
                    pass
                except ConnectionError:
                    left.remove(each)
            time.sleep(0.1)
        assert_served(gateway)


def test_daemon_continues_when_gateways_are_killed_under_load(
    watched: Watch, daemon: Path, tmp_path: Path
) -> None:
    """Three in turn, each under a flood; the next one serves again."""
    for _ in range(3):
        with gateway_process(tmp_path, daemon) as gateway:
            wait_for_daemon(gateway)
            with RawWebSocket(gateway) as ws:
                ws.call("subscribe", {"topics": ["field", "pattern", "amplifiers"]})
                with contextlib.suppress(OSError):
                    for _ in range(200):
                        ws.send(b'{"jsonrpc":"2.0","method":"status","params":{}}')
                gateway.process.kill()
                gateway.process.wait()
    with Client.connect(daemon, name="test") as era:
        # the watch's own; a busy machine may have it expire between two repetitions
        wait_for(lambda: len({contact.source for contact in era.status().contacts}) == 1)
