"""A full transmit queue of a CAN adapter: frames are paced, and those of a stop go first.

SocketCAN keeps 10 frames by default (txqueuelen); a set of 16 channels with envelopes takes 22.
"""

import asyncio
import errno
from collections.abc import Callable, Sequence

import can
import pytest

from drivers import clock
from drivers.backends.can_bus.bus import CanBus
from drivers.backends.can_bus.interfaces import send_some
from drivers.codec.can_bus.canopen import CanFrame
from drivers.errors import LinkTimeout
from drivers.hardware import HARDWARE_PROVIDER, Adapter, HardwareProvider, Port, Worker
from drivers.urls.can_bus import CanUrl
from virtual_loop import in_virtual_time

ROOM = 10
FRAME = 0.000_25  # s; of a frame at 500 kbit/s
SET = [CanFrame(0x201, bytes([number])) for number in range(22)]
STOP = CanFrame(0x481, b"stop")


class Queue(Adapter):
    """A transmit queue that the bus empties, a frame at a time."""

    def __init__(self) -> None:
        self.taken: list[CanFrame] = []
        self.is_stuck = False
        self._free_from = 0.0

    def send(self, frames: Sequence[CanFrame]) -> int:
        begin = max(self._free_from, clock.now())
        waiting = (begin - clock.now()) / FRAME
        room = 0 if self.is_stuck else max(0, min(len(frames), int(ROOM - waiting)))
        self._free_from = begin + room * FRAME
        self.taken += frames[:room]
        return room

    def close(self) -> None:
        """Do nothing."""

    async def wait_closed(self) -> None:
        """Return at once."""


class Machine(HardwareProvider):
    """A machine with this adapter."""

    def __init__(self, queue: Queue) -> None:
        self.queue = queue

    async def open_adapter(self, url: object, *, on_frame: object, on_loss: object) -> Adapter:
        return self.queue

    async def open_port(self, name: str, *, on_data: object, on_loss: object) -> Port:
        raise NotImplementedError

    def make_worker(self) -> Worker:
        raise NotImplementedError

    def below(self, limit: int) -> int:
        return 0


async def opened() -> tuple[CanBus, Queue]:
    """A bus with a short queue."""
    queue = Queue()
    HARDWARE_PROVIDER.set(Machine(queue))
    bus = CanBus(CanUrl.parse("can+socketcan://can0#1").bus)
    await bus.join(1, lambda what: None)
    return bus, queue


@in_virtual_time
async def test_long_set_is_paced() -> None:
    """All its frames in order, not slower than the bus."""
    bus, queue = await opened()
    begin = clock.now()
    await bus.send(SET, timeout=0.03)
    assert queue.taken == SET
    assert clock.now() - begin <= (len(SET) - ROOM + 2) * FRAME + 0.001


@in_virtual_time
async def test_stop_precedes_the_rest_of_a_set() -> None:
    """It waits for one place in the queue only, whichever amplifier it is for."""
    bus, queue = await opened()
    sending = asyncio.create_task(bus.send(SET, timeout=0.03))
    await asyncio.sleep(0)
    await bus.send([STOP], timeout=0.03, is_stop=True)
    assert queue.taken.index(STOP) <= ROOM + 2
    await sending
    assert [frame for frame in queue.taken if frame is not STOP] == SET


@in_virtual_time
async def test_queue_that_stays_full_is_a_timeout() -> None:
    """Within the time of the exchange, with a remedy; the bus is not lost."""
    bus, queue = await opened()
    queue.is_stuck = True
    begin = clock.now()
    with pytest.raises(LinkTimeout, match="txqueuelen"):
        await bus.send(SET, timeout=0.03)
    assert clock.now() - begin == pytest.approx(0.03, abs=0.001)
    queue.is_stuck = False
    await bus.send([STOP], timeout=0.03)
    assert queue.taken == [STOP]


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS),
        can.CanOperationError("Transmit buffer full"),
    ],
)
def test_python_can_reports_a_full_queue(error: can.CanOperationError) -> None:
    """ENOBUFS of the interface, or a full socket: the number of frames taken before."""
    send = refusing(3, error)
    assert send_some(send, SET) == 3
    with pytest.raises(can.CanOperationError, match="down"):
        send_some(refusing(3, can.CanOperationError("Network is down", errno.ENETDOWN)), SET)


def refusing(room: int, error: Exception) -> can.BusABC:
    """A bus that takes a number of frames and then raises."""
    left: Callable[[], object] = iter([None] * room).__next__

    class Bus(can.BusABC):
        def __init__(self) -> None:
            """Not open."""

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            try:
                left()
            except StopIteration:
                raise error from None

        def shutdown(self) -> None:
            """Nothing to close."""

        def __del__(self) -> None:
            """Nothing to warn of."""

    return Bus()
