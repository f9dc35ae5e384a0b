"""A gateway that is flooded or killed while its daemon plays.

The amplifier of the daemon faults without a heartbeat within its watchdog, the longest of the
protocol, so that a control loop that stands still shows as another state than OPERATION_ENABLED.
"""

import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from controller.api.client import Client
from processes.daemons import (
    PATIENCE,
    PLACE,
)
from processes.gateways import (
    GatewayProcess,
    RawWebSocket,
    gateway_process,
    has_ended,
    http,
    real_daemon,
    wait_for,
    wait_for_daemon,
    wait_for_state,
)

ENABLED = "OPERATION_ENABLED"


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of one daemon for all tests."""
    with real_daemon(tmp_path_factory.mktemp("daemon")) as path:
        yield path


def watch(path: Path, looks: list[str], over: threading.Event) -> None:
    """Hold a finger down: renew the lease, touch and read the status fifty times a second."""
    with Client.connect(path, name="watch", timeout=PATIENCE) as era:
        lease = era.arm("watch", lease_s=60).lease
        while not over.wait(0.02):
            era.touch([PLACE])
            status = era.status()
            assert status.state == ENABLED, status.cause
            era.renew(lease)
            looks.append(status.state)
        era.disarm()


@pytest.fixture
def watched(daemon: Path) -> Iterator[None]:
    """The daemon armed and watched; it must stay armed."""
    looks, over = list[str](), threading.Event()
    with Client.connect(daemon, name="test") as era, ThreadPoolExecutor() as thread:
        wait_for_state(era, "READY_TO_SWITCH_ON")
        watching = thread.submit(watch, daemon, looks, over)
        try:
            wait_for(lambda: len(looks) > 5 or watching.done())
            yield
        finally:
            over.set()
        watching.result()


@pytest.fixture
def gateway(watched: None, daemon: Path, tmp_path: Path) -> Iterator[GatewayProcess]:
    """A gateway, which must not log anything."""
    with gateway_process(tmp_path, daemon) as process:
        wait_for_daemon(process)
        yield process
        if process.process.poll() is None:
            assert process.log() == ""


def assert_served(gateway: GatewayProcess) -> None:
    """A new client is served over HTTP and over a WebSocket."""
    assert http(gateway, "/api/v1/effects", body=b"{}").status == 200
    with RawWebSocket(gateway) as ws:
        ws.call("effects", {})
        assert ws.response()["result"]


@pytest.mark.long
@pytest.mark.real_time
def test_gateway_serves_with_two_thousand_silent_connections(gateway: GatewayProcess) -> None:
    """The oldest are closed until 128 are left."""
    with contextlib.ExitStack() as held:
        silent = [held.enter_context(gateway.connect()) for _ in range(2000)]
        assert_served(gateway)
        wait_for(lambda: sum(not has_ended(connection) for connection in silent) <= 128)
        assert_served(gateway)


@pytest.mark.real_time
def test_daemon_continues_when_gateways_are_killed_under_load(
    watched: None, daemon: Path, tmp_path: Path
) -> None:
    """Two in turn, each under a flood; the next one serves again."""
    for _ in range(2):
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
