"""Lines of several amplifiers: opened by the first, lost for all, closed by the last."""

import asyncio
import gc
from collections.abc import Callable, Sequence
from functools import partial

import pytest

from drivers.backends.can_bus.backend import CanBackend
from drivers.backends.modbus.backend import ModbusBackend
from drivers.backends.serial_line.backend import SerialBackend
from drivers.backends.shared_line import SharedLine, shared_line
from drivers.backends.wire_backend import WireBackend
from drivers.codec.can_bus.canopen import CanFrame
from drivers.errors import LinkError
from drivers.hardware import (
    HARDWARE_PROVIDER,
    Adapter,
    HardwareProvider,
    Port,
    Worker,
)
from drivers.line.priority import priority_of
from drivers.line.sender import sender_of
from drivers.protocol.messages import Arm, Ping, Stop


class Line(SharedLine[Port]):
    """A line that records events; `blocks` delays opening and closing."""

    address_term = "place"

    def __init__(self) -> None:
        super().__init__("the line")
        self.happened: list[str] = []
        self.blocks: asyncio.Event | None = None
        self.fails = False

    async def _open(self) -> Port:
        if self.fails:
            raise LinkError("there is no such line")
        await self._note("opened")
        return self

    is_blocked = False

    def write(self, data: bytes) -> None:
        """Discard it."""

    def close(self) -> None:
        """Begin to close; see `wait_closed`."""

    async def wait_closed(self) -> None:
        await self._note("closed")

    async def _note(self, what: str) -> None:
        if self.blocks is not None:
            await self.blocks.wait()
        self.happened.append(what)

    def _fail_pending(self, what: str) -> None:
        self.happened.append(f"gave up: {what}")

    def lose(self, what: str) -> None:
        self._lose(what)

    def send(self) -> None:
        self._ready().write(b"")


def the_line() -> Line:
    """Return the line in use, or a new one."""
    return shared_line(Line, "key", Line)


async def test_first_user_opens_and_last_user_closes() -> None:
    """One line for all users; afterwards a new one."""
    line = the_line()
    await line.join(1, lambda _: None)
    assert the_line() is line
    await line.join(2, lambda _: None)
    await line.leave(1)
    assert line.happened == ["opened"]
    await line.leave(2)
    assert line.happened == ["opened", "gave up: the line was closed", "closed"]
    assert the_line() is not line


async def test_number_in_use_is_refused() -> None:
    """The second user gets a remedy, and the first is not disturbed."""
    line = the_line()
    await line.join(1, lambda _: None)
    with pytest.raises(LinkError, match=r"place 1 on the line.*already open"):
        await line.join(1, lambda _: None)
    assert line.happened == ["opened"]
    await line.leave(1)


async def test_failed_opening_leaves_no_user() -> None:
    """The same number may try again, on a new line."""
    line = the_line()
    line.fails = True
    with pytest.raises(LinkError, match="no such line"):
        await line.join(1, lambda _: None)
    again = the_line()
    assert again is not line
    await again.join(1, lambda _: None)
    assert again.happened == ["opened"]
    await again.leave(1)


async def test_join_during_close_reopens() -> None:
    """It is closed before it is opened again."""
    line = the_line()
    await line.join(1, lambda _: None)
    line.blocks = asyncio.Event()
    going = asyncio.create_task(line.leave(1))
    await asyncio.sleep(0)
    coming = asyncio.create_task(the_line().join(2, lambda _: None))
    await asyncio.sleep(0)
    line.blocks.set()
    await asyncio.gather(going, coming)
    assert [what for what in line.happened if what != "gave up: the line was closed"] == [
        "opened",
        "closed",
        "opened",
    ]
    assert the_line() is line
    await line.leave(2)


async def test_join_before_close_keeps_it_open() -> None:
    """The last user waited to close it while another opened or closed it."""
    line = the_line()
    await line.join(1, lambda _: None)
    async with line._changing:
        going = asyncio.create_task(line.leave(1))
        await asyncio.sleep(0)
        coming = asyncio.create_task(line.join(2, lambda _: None))
        await asyncio.sleep(0)
    await asyncio.gather(going, coming)
    assert "closed" not in line.happened
    assert the_line() is line
    await line.leave(2)


async def test_loss_is_reported_once_per_user_and_ends_with_join() -> None:
    """The next loss is reported to users that have joined again only; others cannot send."""
    losses: list[tuple[int, str]] = []
    line = the_line()
    for number in (1, 2):
        await line.join(number, lambda what, number=number: losses.append((number, what)))
    line.lose("pulled out")
    line.lose("pulled out again")
    assert losses == [(1, "pulled out"), (2, "pulled out")]
    with pytest.raises(LinkError, match="pulled out"):
        line.raise_if_lost(1)
    await line.leave(1)
    await line.join(1, lambda what: losses.append((1, what)))
    assert line.happened == ["opened", "gave up: pulled out", "closed", "opened"]
    line.raise_if_lost(1)
    with pytest.raises(LinkError, match="place 2 has not been reopened"):
        line.raise_if_lost(2)
    line.lose("burnt")
    assert losses[2:] == [(1, "burnt")]
    await line.leave(1)
    await line.leave(2)


async def test_user_joining_during_a_loss_is_notified_of_the_next() -> None:
    """It reopens the line, so that the loss does not count for it."""
    line, losses = the_line(), list[str]()
    await line.join(1, lambda _: None)
    async with line._changing:
        coming = asyncio.create_task(line.join(2, losses.append))
        await asyncio.sleep(0)
        line.lose("pulled out")
    await coming
    line.raise_if_lost(2)
    line.lose("burnt")
    assert losses == ["pulled out", "burnt"]
    await line.leave(1)
    await line.leave(2)


async def test_nothing_is_sent_while_reopening() -> None:
    """A LinkError meanwhile; afterwards it is sent."""
    line = the_line()
    await line.join(1, lambda _: None)
    line.lose("pulled out")
    with pytest.raises(LinkError, match="pulled out"):
        line.send()
    line.blocks = asyncio.Event()
    line.blocks.set()
    await line.leave(1)
    line.blocks.clear()
    coming = asyncio.create_task(line.join(2, lambda _: None))
    await asyncio.sleep(0)
    with pytest.raises(LinkError, match=r"the line is not open; open the amplifier first"):
        line.send()
    line.blocks.set()
    await coming
    line.send()
    await line.leave(2)


class _Machine(HardwareProvider):
    """A machine with a line that discards everything, until it is lost."""

    def __init__(self) -> None:
        self.sent: list[object] = []
        self.is_lost = False
        self.lose: Callable[[str], None] = lambda what: None

    async def open_port(
        self, name: str, *, on_data: object, on_loss: Callable[[str], None]
    ) -> Port:
        self.lose = on_loss
        return _Open(self)

    async def open_adapter(
        self, url: object, *, on_frame: object, on_loss: Callable[[str], None]
    ) -> Adapter:
        self.lose = on_loss
        return _Open(self)

    def make_worker(self) -> Worker:
        return Worker("era-test")

    def below(self, limit: int) -> int:
        return 0


class _Open:
    def __init__(self, machine: _Machine) -> None:
        self._machine = machine

    is_blocked = False

    def write(self, data: bytes) -> None:
        if self._machine.is_lost:
            self._machine.lose("pulled out")
            raise LinkError("pulled out")
        self._machine.sent.append(data)

    def send(self, frames: Sequence[CanFrame]) -> int:
        for frame in frames:
            self.write(frame.data)
        return len(frames)

    def close(self) -> None:
        """Do nothing."""

    async def wait_closed(self) -> None:
        """Return at once."""


WAITING = {
    SerialBackend: ("serial:///dev/none?address={}", [Ping(), Arm(watchdog=0.25, session=9)]),
    ModbusBackend: ("modbus+rtu:///dev/none#{}", [Ping(), Arm(watchdog=0.25, session=9)]),
    CanBackend: ("can+slcan:///dev/none#{}", [Arm(watchdog=0.25, session=9)]),  # listens first
}
STOP = Stop(0.005)


@pytest.mark.parametrize("kind", WAITING)
async def test_request_queued_before_a_loss_is_not_sent_after_reopening(
    kind: type[WireBackend],
) -> None:
    """A lost amplifier is not armed before it is reopened."""
    url, requests = WAITING[kind]
    machine = _Machine()
    HARDWARE_PROVIDER.set(machine)
    east, west = (kind(url.format(number)) for number in (1, 2))
    await east.open()
    await west.open()
    sender = sender_of(west)
    asked = [
        asyncio.create_task(
            sender.send(west, priority_of(each), partial(west.exchange, each, timeout=0.2))
        )
        for each in requests
    ]
    await asyncio.sleep(0.01)
    before = len(machine.sent)
    machine.lose("pulled out")
    await east.close()
    await east.open()
    for each in asked:
        with pytest.raises(LinkError, match=r"pulled out|reopened"):
            await each
    assert len(machine.sent) == before
    stopping = asyncio.create_task(west.exchange(STOP, timeout=0.2))  # a stop is
    await asyncio.sleep(0.01)
    assert len(machine.sent) > before
    stopping.cancel()
    await west.close()
    await east.close()


@pytest.mark.parametrize("kind", WAITING)
async def test_loss_found_while_writing_leaves_no_unretrieved_exception(
    kind: type[WireBackend],
) -> None:
    """The port reports the loss and raises, as one that was unplugged does."""
    url, _ = WAITING[kind]
    machine = _Machine()
    HARDWARE_PROVIDER.set(machine)
    unretrieved: list[object] = []
    asyncio.get_running_loop().set_exception_handler(
        lambda loop, context: unretrieved.append(context)
    )
    backend = kind(url.format(1))
    losses: list[str] = []
    backend.listen(lambda event: None, losses.append)
    await backend.open()
    machine.is_lost = True
    with pytest.raises(LinkError, match="pulled out"):
        await backend.exchange(STOP, timeout=0.2)
    await backend.close()
    gc.collect()
    assert unretrieved == []


@pytest.mark.parametrize("kind", WAITING)
async def test_request_before_opening_is_a_link_error(kind: type[WireBackend]) -> None:
    """With a remedy."""
    url, _ = WAITING[kind]
    with pytest.raises(LinkError, match=r"/dev/none.* is not open; open the amplifier first"):
        await kind(url.format(1)).exchange(Ping(), timeout=0.2)
