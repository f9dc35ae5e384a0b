"""Writing to a serial port, which never blocks, on a pseudo-terminal and by a thread."""

import asyncio
import os
import pty
import threading
import tty
from collections.abc import Iterator

import pytest
import serial

from drivers.errors import LinkError
from drivers.ports.serial_port import SerialPort

TIMEOUT = 5.0  # s; for what is expected


@pytest.fixture
def ends() -> Iterator[tuple[serial.Serial, int]]:
    """A port, and the descriptor at its other end."""
    far, near = pty.openpty()
    tty.setraw(near)
    port = serial.Serial(os.ttyname(near), timeout=0)
    yield port, far
    port.close()
    os.close(near)
    os.close(far)


async def read_until(far: int, end: bytes) -> bytes:
    """Read from the other end until these bytes."""
    os.set_blocking(far, False)
    got = b""
    async with asyncio.timeout(TIMEOUT):
        while not got.endswith(end):
            try:
                got += os.read(far, 1 << 16)
            except BlockingIOError:
                await asyncio.sleep(0)
    return got


async def test_blocked_port_takes_the_newest_frame(ends: tuple[serial.Serial, int]) -> None:
    """Unsent bytes of an older one are dropped; the newest follows without another call."""
    port, far = ends
    watched = SerialPort(port, "/dev/ttyUSB9", lambda data: None, lambda what: None)
    watched.write(b"a" * (1 << 20))
    assert watched.is_blocked
    watched.write(b"b" * (1 << 20))
    watched.write(b"stop")
    got = await read_until(far, b"stop")
    assert got.count(b"b") < 1 << 20
    assert got.count(b"a") < 1 << 20
    assert not watched.is_blocked
    watched.close()
    await watched.wait_closed()


async def test_closed_port_is_a_link_error(ends: tuple[serial.Serial, int]) -> None:
    """And the loss is reported once."""
    port, far = ends
    losses: list[str] = []
    watched = SerialPort(port, "/dev/ttyUSB9", lambda data: None, losses.append)
    watched.write(b"a" * (1 << 20))
    os.close(os.dup(far))
    os.dup2(os.open(os.devnull, os.O_RDWR), far)  # hangs up
    with pytest.raises(LinkError, match="check the cable"):
        watched.write(b"stop")
    assert len(losses) == 1
    watched.close()
    await watched.wait_closed()


async def test_error_of_whoever_takes_the_data_is_no_loss(ends: tuple[serial.Serial, int]) -> None:
    """A LinkError is an OSError, as those of a port that is gone."""
    port, far = ends
    losses: list[str] = []

    def fail(data: bytes) -> None:
        raise LinkError("of another line")

    watched = SerialPort(port, "/dev/ttyUSB9", fail, losses.append)
    os.write(far, b"reply")
    with pytest.raises(LinkError, match="of another line"):
        watched.poll()
    assert not losses
    watched.close()
    await watched.wait_closed()


async def test_port_without_a_descriptor_is_written_by_a_thread() -> None:
    """A port that takes nothing for seconds does not block the caller."""
    entered, taken = threading.Semaphore(0), threading.Semaphore(0)
    written: list[bytes] = []
    losses: asyncio.Queue[str] = asyncio.Queue()

    class Device:
        in_waiting = 0

        def fileno(self) -> int:
            raise OSError("no descriptor")

        def read(self, size: int) -> bytes:
            return b""

        def cancel_read(self) -> None:
            """Do nothing."""

        def close(self) -> None:
            """Do nothing."""

        def write(self, data: bytes) -> None:
            entered.release()
            assert taken.acquire(timeout=TIMEOUT)
            written.append(data)
            if data == b"stop":
                raise ConnectionResetError("gone")

    port = SerialPort(Device(), "COM3", lambda data: None, losses.put_nowait)  # type: ignore[arg-type]
    port.write(b"one")
    assert await asyncio.to_thread(entered.acquire, timeout=TIMEOUT)
    for data in (b"two", b"stop"):
        assert port.is_blocked
        port.write(data)
    taken.release(2)
    assert "serial line COM3 was lost (gone)" in await asyncio.wait_for(losses.get(), TIMEOUT)
    assert written == [b"one", b"stop"]
    await port.wait_closed()
