"""Cancelled SDO transfers end and send nothing more."""

from collections.abc import Callable

import canopen
import pytest

from drivers.backends.can_bus.objects import ObjectClient
from drivers.errors import LinkTimeout
from drivers.hardware import Worker
from drivers.statistics import WireCounters

TIMEOUT = 0.01  # s; of a node that never answers


class Network(canopen.Network):
    """A bus without replies; `sent` counts frames, and `on_send` is called with each."""

    def __init__(self) -> None:
        super().__init__()
        self.sent = 0
        self.on_send: Callable[[], None] = lambda: None

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.sent += 1
        self.on_send()


def test_queued_transfer_does_not_start_after_close() -> None:
    """The job was taken before, and its turn comes afterwards: the bus may be another's by then."""
    network = Network()
    client = ObjectClient(network, 1, Worker("era-test"), WireCounters())
    client.close()
    with pytest.raises(LinkTimeout):
        client.capabilities(timeout=TIMEOUT)
    assert network.sent == 0


def test_cancelled_transfer_is_not_retried() -> None:
    """After an aborted one it would read an object up to five times."""
    network = Network()
    client = ObjectClient(network, 1, Worker("era-test"), WireCounters())
    with pytest.raises(LinkTimeout):
        client.faults(timeout=TIMEOUT)
    network.sent, network.on_send = 0, client.abandon
    with pytest.raises(LinkTimeout):
        client.faults(timeout=TIMEOUT)
    assert network.sent == 1
    network.sent, network.on_send = 0, lambda: None
    with pytest.raises(LinkTimeout):
        client.faults(timeout=TIMEOUT)
    assert network.sent >= 5
