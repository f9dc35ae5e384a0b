"""The gateway flooded, starved and killed before a real daemon, whose control loop does not notice.

The daemon is a process over a simulated amplifier, armed, with a finger down all the time. Its
amplifier must hear a heartbeat every 250 ms, or it stops with a fault: a control loop that is late
shows as a state that is not OPERATION_ENABLED. A client of its own sees every change of state, and
how old the amplifier's last answer ever is. A machine that stands still for all of its processes
is told by a metronome beside it, and not held against the gateway.
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
    """A process that only looks at the clock every 10 ms, as urgently as the daemon may run.

    Where it is late, too, the machine stood still for everybody, and the gateway is not to blame.
    """

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
        """Whether it was late just now: on a machine that has time for all it never is."""
        since = time.monotonic() - 5
        return sum(late for due, late in self.late if due > since) > LATE

    @property
    def latest(self) -> float:
        """The longest that it ever was late [s]."""
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
    """One for all of this."""
    made = Metronome()
    yield made
    made.close()


def _arm_again(era: Client) -> str:
    """After the amplifier's watchdog; the lease."""
    wait_for_state(era, "FAULT")
    era.clear()
    wait_for_state(era, "READY_TO_SWITCH_ON")
    return era.arm("watch", lease_s=30).lease


@dataclass
class Watch:
    """What a client of the daemon sees while it holds a finger down."""

    metronome: "Metronome"
    oldest: float = 0.0  # s; of the amplifier's answers, at any look
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
        """Until it is over; renews the lease, repeats the touch, and looks fifty times a second."""
        with Client.connect(path, name="watch") as era:
            lease = era.arm("watch", lease_s=30).lease
            while not self.over.wait(0.02):
                era.touch([PLACE])
                told = era.status()
                if told.state != ENABLED:
                    assert self.metronome.stood_still(), f"{told.state}: {told.cause}"
                    lease = _arm_again(era)
                    continue
                era.renew(lease)
                self.oldest = max(self.oldest, *(a.reply_age_s or 0.0 for a in told.amplifiers))
                self.looks += 1
            era.disarm()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """One daemon for all of this, by its socket."""
    with real_daemon(tmp_path_factory.mktemp("daemon")) as path:
        yield path


@pytest.fixture
def watched(daemon: Path, metronome: "Metronome") -> Iterator[Watch]:
    """The daemon armed and watched; at the end it was armed all the time that the machine ran."""
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
    """A gateway to be mistreated; it writes nothing to its log all the while.

    By the command of the fixture's parameter, `era` without one.
    """
    program = getattr(request, "param", (ERA,))
    with gateway_process(tmp_path, daemon, program=program) as made:
        wait_for_daemon(made)
        yield made
        if made.process.poll() is None:
            assert made.log() == ""


def stop_is_understood(gateway: GatewayProcess) -> None:
    """A browser that comes now is let in and answered, over HTTP and over a WebSocket."""
    assert http(gateway, "/api/v1/effects", body=b"{}").status == 200
    with RawWebSocket(gateway) as ws:
        ws.call("effects", {})
        assert ws.response()["result"]


def deaf_connection(gateway: GatewayProcess) -> socket.socket:
    """A connection with next to no room for what it does not read."""
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    made.settimeout(20)
    made.connect(("127.0.0.1", gateway.port))
    return made


def has_ended(connection: socket.socket) -> bool:
    """Whether the other side has left; nothing is read before that."""
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


def test_two_thousand_silent_connections_keep_nobody_out(gateway: GatewayProcess) -> None:
    """All at once; the oldest give way, a browser is served meanwhile, and few are left of them."""
    with contextlib.ExitStack() as held:
        silent = [held.enter_context(gateway.connect()) for _ in range(2000)]
        stop_is_understood(gateway)
        wait_for(lambda: sum(not has_ended(each) for each in silent) <= 128)
        stop_is_understood(gateway)


def trickles(gateway: GatewayProcess) -> list[bytes]:
    """What may be begun and not ended: a header, a body, a second request, what is refused."""
    head = f"POST /api/v1/arm HTTP/1.1\r\nHost: {gateway.host}\r\n"
    full = f"{head}Authorization: Bearer {TOKEN}\r\nContent-Type: application/json\r\n"
    begun = (
        head,
        f"{full}Content-Length: 100\r\n\r\n",
        f"{full}Transfer-Encoding: chunked\r\n\r\n",
        f"{head}Content-Length: 100\r\n\r\n",  # is refused at once, for it has no token
        f"{full}Content-Length: 2\r\n\r\n{{}}{head}",
    )
    return [said.encode() for said in begun]


@pytest.mark.parametrize("gateway", [(sys.executable, "-c", IMPATIENT)], indirect=True)
def test_gateway_closes_connections_that_trickle_or_do_not_read(gateway: GatewayProcess) -> None:
    """A byte now and then wins no time; ten over WebSockets and ten over HTTP ask much and read
    nothing. All of them are closed, and a browser is served meanwhile.
    """
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
        stop_is_understood(gateway)
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
        stop_is_understood(gateway)


def test_a_flood_of_requests_costs_nobody_else(gateway: GatewayProcess, watched: Watch) -> None:
    """Ten thousand requests in a second over WebSockets, HTTP and touches beside: who floods is
    asked to slow down or disconnected, and a stop of another client is answered meanwhile.
    """
    before = watched.looks
    over = threading.Event()
    sent = [0] * 4

    def flood(number: int) -> None:
        said = (
            b'{"jsonrpc":"2.0","id":1,"method":"status","params":{}}',
            b'{"jsonrpc":"2.0","method":"effects","params":{}}',
            b'{"jsonrpc":"2.0","method":"touch","params":{"source":"me","touches":'
            b'[{"id":1,"x_m":0.2,"y_m":0.1}]}}',
            b"garbage",
        )[number]
        burst = frame(said) * 25  # each 10 ms: 2500 in a second each
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


def test_gateways_killed_under_load_are_not_missed(
    watched: Watch, daemon: Path, tmp_path: Path
) -> None:
    """Three in turn, killed while browsers flood them; the next one serves again."""
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


def test_fingers_of_a_gateway_that_is_killed_are_lifted(daemon: Path, tmp_path: Path) -> None:
    """Within 150 ms of the last word of it, and a little for a busy machine."""
    with Client.connect(daemon, name="test") as era:
        with gateway_process(tmp_path, daemon) as gateway, RawWebSocket(gateway) as ws:
            wait_for_daemon(gateway)
            point = {"id": 1, "x_m": 0.2, "y_m": 0.1}
            while not era.status().contacts:
                ws.call("touch", {"source": "me", "touches": [point]})
                ws.response()
            gateway.process.kill()
        wait_for(lambda: not era.status().contacts)


def test_a_stop_over_http_stops_and_nothing_arms_by_itself(
    watched: Watch, daemon: Path, tmp_path: Path
) -> None:
    """By anyone with the token, at any time; after it only clear and arm, in this order."""
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
