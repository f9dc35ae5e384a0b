"""The gateway flooded, starved and killed, without effect on the daemon's control loop.

The daemon is a process over a simulated amplifier, armed, with a finger down. Its amplifier faults
without a heartbeat within 250 ms, so a late control loop shows as another state than
OPERATION_ENABLED, or by the age of the last reply. Pauses of the whole machine are detected by a
metronome and excused.
"""

import contextlib
import logging
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from controller.api.client import Client
from daemon_bench import PLACE
from gateway_bench import (
    ARM,
    ERA,
    TOKEN,
    GatewayProcess,
    RawWebSocket,
    frame,
    gateway_process,
    http,
    raise_priority,
    real_daemon,
    upgrade,
    wait_for,
    wait_for_daemon,
    wait_for_state,
)

pytestmark = pytest.mark.alone

ENABLED = "OPERATION_ENABLED"
WATCHDOG = 0.25  # s; of the amplifiers, by default
LATE = 0.06  # s; of a process that does nothing, on a machine that is busy with something else

IMPATIENT = """
import sys
from controller.cli.main import main
from controller.gateway import connections, session
connections.REQUEST_TIMEOUT = connections.UNREAD_TIMEOUT = session.SEND_TIMEOUT = 1.0
sys.exit(main())
"""
"""`era` with shorter timeouts of the gateway."""

_logger = logging.getLogger(__name__)  # what was measured; shown by pytest --log-cli-level=info


class Metronome:
    """A process with the daemon's priority that wakes every 10 ms, to detect a paused machine."""

    _CODE = (
        "import time\n"
        "while True:\n"
        "    due = time.monotonic() + 0.01\n"
        "    time.sleep(0.01)\n"
        "    late = time.monotonic() - due\n"
        "    if late > 0.02: print(due, late, flush=True)\n"
    )

    def __init__(self) -> None:
        self.late: list[tuple[float, float]] = []  # when it was due, and how late it was [s]
        self._process = subprocess.Popen(
            [sys.executable, "-c", self._CODE], stdout=subprocess.PIPE, text=True
        )
        raise_priority(self._process.pid)
        self._reading = threading.Thread(target=self._read)
        self._reading.start()

    def stood_still(self) -> bool:
        """Whether it was late within the last 5 s."""
        since = time.monotonic() - 5
        return sum(late for due, late in self.late if due > since) > LATE

    @property
    def latest(self) -> float:
        """Its largest delay [s]."""
        return max((late for _, late in self.late), default=0.0)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        self._reading.join()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                due, late = map(float, line.split())
                self.late.append((due, late))


@pytest.fixture(scope="module")
def metronome() -> Iterator[Metronome]:
    """One metronome for all tests."""
    made = Metronome()
    yield made
    made.close()


def _arm_again(era: Client) -> str:
    """Arm after the amplifier's watchdog tripped; return the lease."""
    wait_for_state(era, "FAULT")
    era.clear()
    wait_for_state(era, "READY_TO_SWITCH_ON")
    return era.arm("watch", lease_s=30).lease


@dataclass
class Watch:
    """A client of the daemon that holds a finger down."""

    metronome: "Metronome"
    oldest: float = 0.0  # s; age of the amplifier's replies
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
        with Client.connect(path, name="watch") as era:
            lease = era.arm("watch", lease_s=30).lease
            while not self.over.wait(0.02):
                era.touch([PLACE])
                status = era.status()
                if status.state != ENABLED:
                    assert self.metronome.stood_still(), f"{status.state}: {status.cause}"
                    lease = _arm_again(era)
                    continue
                era.renew(lease)
                self.oldest = max(self.oldest, *(a.reply_age_s or 0.0 for a in status.amplifiers))
                self.looks += 1
            era.disarm()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of one daemon for all tests."""
    with real_daemon(tmp_path_factory.mktemp("daemon")) as path:
        yield path


@pytest.fixture
def watched(daemon: Path, metronome: "Metronome") -> Iterator[Watch]:
    """The daemon armed and watched; it must stay armed while the machine runs."""
    watch = Watch(metronome)
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
        assert watch.oldest < WATCHDOG or watch.metronome.latest > LATE
        _logger.info("%d looks, oldest answer %.0f ms", watch.looks, 1000 * watch.oldest)


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
    made.settimeout(20)
    made.connect(("127.0.0.1", gateway.port))
    return made


def has_ended(connection: socket.socket) -> bool:
    """Whether the other side has closed, without reading."""
    try:
        connection.send(b"")
        return bool(connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)) or _is_reset(
            connection
        )
    except OSError:
        return True


def _is_reset(connection: socket.socket) -> bool:
    """By the kernel's state of the connection: 1 is established, see tcp_states.h of Linux."""
    return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] != 1


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
        end = time.monotonic() + 40
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


def test_gateway_serves_during_a_flood_of_requests(gateway: GatewayProcess, watched: Watch) -> None:
    """Ten thousand requests per second over WebSockets; another client is served over HTTP."""
    before = watched.looks
    over = threading.Event()
    sent = [0] * 4

    def flood(number: int) -> None:
        request = (
            b'{"jsonrpc":"2.0","id":1,"method":"status","params":{}}',
            b'{"jsonrpc":"2.0","method":"effects","params":{}}',
            b'{"jsonrpc":"2.0","method":"touch","params":{"source":"me","touches":'
            b'[{"id":1,"x_m":0.2,"y_m":0.1}]}}',
            b"garbage",
        )[number]
        burst = frame(request) * 25  # each 10 ms: 2500 in a second each
        while not over.is_set():
            with contextlib.suppress(OSError, AssertionError), RawWebSocket(gateway) as ws:
                ws.connection.settimeout(1)
                while not over.wait(0.01):
                    ws.connection.sendall(burst)
                    sent[number] += 25

    threads = [threading.Thread(target=flood, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    answered = []
    end = time.monotonic() + 2
    try:
        while time.monotonic() < end:
            asked = time.monotonic()
            assert http(gateway, "/api/v1/effects", body=b"{}").status in (200, 429)
            answered.append(time.monotonic() - asked)
    finally:
        over.set()
        for thread in threads:
            thread.join()
    _logger.info("%d requests, others' answers in %.0f ms", sum(sent), 1000 * max(answered))
    assert watched.looks > before


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
        sources = {contact.source for contact in era.status().contacts}
    assert len(sources) == 1  # the watch's own


def test_fingers_of_a_killed_gateway_are_lifted(daemon: Path, tmp_path: Path) -> None:
    """After the contact timeout."""
    with Client.connect(daemon, name="test") as era:
        with gateway_process(tmp_path, daemon) as gateway, RawWebSocket(gateway) as ws:
            wait_for_daemon(gateway)
            point = {"id": 1, "x_m": 0.2, "y_m": 0.1}
            while not era.status().contacts:
                ws.call("touch", {"source": "me", "touches": [point]})
                ws.response()
            gateway.process.kill()
        wait_for(lambda: not era.status().contacts)


def test_stop_over_http_is_latched_until_clear(
    watched: Watch, daemon: Path, tmp_path: Path
) -> None:
    """Arming is refused with 409 before that."""
    with gateway_process(tmp_path, daemon) as gateway, Client.connect(daemon, name="test") as era:
        wait_for_daemon(gateway)
        watched.over.set()
        wait_for_state(era, "READY_TO_SWITCH_ON")
        assert http(gateway, body=ARM).status == 200
        wait_for_state(era, ENABLED)
        assert http(gateway, "/api/v1/stop", body=b"").status == 200
        assert era.status().state == "QUICK_STOP_ACTIVE"
        assert http(gateway, body=ARM).status == 409
        assert http(gateway, "/api/v1/clear", body=b"").status == 200
        wait_for_state(era, "READY_TO_SWITCH_ON")
