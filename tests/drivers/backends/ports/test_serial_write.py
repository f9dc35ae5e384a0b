"""Writing to a serial port, on a pseudo-terminal."""

import os
import pty
import tty
from collections.abc import Iterator

import pytest
import serial

from drivers.backends.ports.watched import WatchedPort
from drivers.backends.ports.writing import write_all
from drivers.errors import LinkTimeout


@pytest.fixture
def ends() -> Iterator[tuple[serial.Serial, int]]:
    """A port, and the descriptor at its other end."""
    far, near = pty.openpty()
    tty.setraw(near)
    port = serial.Serial(os.ttyname(near), timeout=0, write_timeout=0.02)
    yield port, far
    port.close()
    os.close(near)
    os.close(far)


def test_taken_bytes_are_not_a_timeout(
    ends: tuple[serial.Serial, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if the process is delayed while it writes."""
    port, far = ends
    monkeypatch.setattr("serial.serialposix.Timeout.expired", lambda self: True)
    write_all(port, b"all of it")
    assert os.read(far, 100) == b"all of it"


def test_blocked_port_is_a_timeout(ends: tuple[serial.Serial, int]) -> None:
    """The other end does not read, so its buffer fills up."""
    port, _ = ends
    with pytest.raises(serial.SerialTimeoutException):
        write_all(port, bytes(1 << 20))


async def test_blocked_line_is_a_timeout_with_a_remedy(
    ends: tuple[serial.Serial, int],
) -> None:
    """Which is retried."""
    port, _ = ends
    watched = WatchedPort(port, "/dev/ttyUSB9", lambda data: None, lambda what: None)
    with pytest.raises(LinkTimeout, match=r"/dev/ttyUSB9.*check flow control"):
        watched.write(bytes(1 << 20))
    watched.close()
    await watched.wait_closed()


def test_closed_port_is_a_link_error(ends: tuple[serial.Serial, int]) -> None:
    """Like a lost one."""
    port, _ = ends
    port.close()
    with pytest.raises(OSError, match="not open"):
        write_all(port, b"x")
