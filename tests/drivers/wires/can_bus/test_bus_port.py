"""A bus of python-can as a port: a transmit queue that is full, and error frames."""

import asyncio
import errno
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import can
import pytest

from drivers.errors import LinkError
from drivers.wires.can_bus import BusPort
from drivers.wires.can_frames import CanFrame, pack_frames

SET = [CanFrame(0x201, bytes([number])) for number in range(22)]
STOP = [CanFrame(0x201, b"stop")]
COMMIT = [CanFrame(0x200, b"commit")]


class Adapter(can.BusABC):
    """An adapter with room for some frames; incoming: what is received next."""

    def __init__(self) -> None:
        self.room = 10  # txqueuelen of Linux
        self.taken: list[bytes] = []
        self.incoming: list[can.Message] = []
        self.ends = os.pipe()
        super().__init__(channel="0")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if not self.room:
            raise can.CanOperationError("no buffer space", error_code=errno.ENOBUFS)
        self.room -= 1
        self.taken.append(bytes(msg.data))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self.incoming.pop(0) if self.incoming else None), False

    def fileno(self) -> int:
        return self.ends[0]


@asynccontextmanager
async def opened(
    heard: Callable[[bytes], None] = lambda data: None, *, is_watched: bool = True
) -> AsyncIterator[tuple[BusPort, Adapter, list[str]]]:
    """A port, its adapter, and its losses; heard: called with what it receives."""
    adapter, losses = Adapter(), list[str]()
    port = BusPort(adapter, is_watched, "can0", heard, losses.append)
    try:
        yield port, adapter, losses
    finally:
        port.close()
        await port.wait_closed()
        for each in adapter.ends:
            os.close(each)


async def until(condition: Callable[[], bool]) -> None:
    """Let the event loop turn until a condition holds, for a minute at most."""
    async with asyncio.timeout(60.0):
        while True:
            if condition():
                return
            await asyncio.sleep(0)


async def test_long_set_is_sent_as_the_queue_takes_it() -> None:
    """All 22 frames in order, of which there is room for ten; blocked until then."""
    async with opened() as (port, adapter, losses):
        port.write(pack_frames(SET))
        assert port.is_blocked
        while port.is_blocked:
            await asyncio.sleep(0)
            adapter.room = 1
        assert adapter.taken == [frame.data for frame in SET]
        assert not losses


async def test_stop_replaces_the_rest_of_a_set_but_no_broadcast() -> None:
    """Ten frames of the set were taken; of the others only the commit of all precedes the stop."""
    async with opened() as (port, adapter, _):
        port.write(pack_frames(SET))
        for frames in (COMMIT, SET, STOP):
            port.write(pack_frames(frames))
        adapter.room = 30
        await until(lambda: not port.is_blocked)
        assert adapter.taken[10:] == [b"commit", b"stop"]


async def test_frames_of_a_stuck_queue_are_dropped() -> None:
    """Nobody acknowledges on the bus: what waited is not sent when it is mended much later."""
    async with opened() as (port, adapter, losses):
        adapter.room = 0
        port.write(pack_frames(COMMIT + SET))
        await until(lambda: not port._unsent)
        assert port.is_blocked
        adapter.room = 30
        port.write(pack_frames(STOP))
        assert adapter.taken == [b"stop"]
        assert not losses


async def test_broadcast_waits_no_longer_while_others_are_written(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A commit amid requests that are repeated every 20 ms: gone after the 30 ms of a reply."""
    async with opened() as (port, adapter, _):
        now = port.loop.time()
        monkeypatch.setattr(port.loop, "time", lambda: now)
        adapter.room = 0
        port.write(pack_frames(COMMIT))
        for _ in range(2):
            now += 0.02
            port.write(pack_frames(STOP))
        adapter.room = 30
        port.write(pack_frames(STOP))
        monkeypatch.undo()
        assert adapter.taken == [b"stop"]


async def test_bus_off_is_a_loss_and_other_error_frames_are_none() -> None:
    """Error class 0x40 of linux/can/error.h; told once."""
    async with opened() as (port, adapter, losses):
        adapter.incoming.append(can.Message(arbitration_id=0x04, is_error_frame=True))
        port.poll()
        assert not losses
        adapter.incoming += [can.Message(arbitration_id=0x40, is_error_frame=True)] * 2
        port.poll()
        (loss,) = losses
        assert "bus-off" in loss


async def test_failed_send_is_a_loss() -> None:
    """The adapter is unplugged: LinkError for the request, and the line is lost with its text."""
    async with opened() as (port, adapter, losses):
        adapter.send = _unplugged  # type: ignore[method-assign]
        with pytest.raises(LinkError) as failed:
            port.write(pack_frames(STOP))
        assert losses == [str(failed.value)]


async def test_reader_thread_hands_over_frames_in_order_until_the_adapter_is_gone() -> None:
    """Frames that came before are handed over first; the thread ends, and the loss is told once."""
    heard: list[bytes] = []
    async with opened(heard.append, is_watched=False) as (port, adapter, losses):
        port.poll()  # left to the thread
        frames = [CanFrame(0x181, bytes([number])) for number in range(3)]
        adapter.incoming += [
            *(can.Message(arbitration_id=0x181, is_extended_id=False, data=f.data) for f in frames),
            can.Message(arbitration_id=0x40, is_error_frame=True),
        ]
        await until(lambda: bool(losses))
        assert heard == [pack_frames([frame]) for frame in frames]
        assert port._thread is not None
        port._thread.join(10.0)
        assert not port._thread.is_alive()
    assert len(losses) == 1


def _unplugged(msg: can.Message, timeout: float | None = None) -> None:
    raise can.CanOperationError("No such device", error_code=errno.ENODEV)
