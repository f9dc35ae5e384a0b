"""Writing to a serial port without false timeouts.

pyserial checks the timeout after the system has taken the bytes, and so reports one if this process
was delayed meanwhile. Here the system is asked first.
"""

import contextlib
import os

import serial


def descriptor(port: serial.Serial) -> int | None:
    """Return the file descriptor of a port, if it has one."""
    if os.name != "posix":
        return None
    try:
        return int(port.fileno())
    except (OSError, AttributeError):  # UnsupportedOperation is an OSError
        return None


def write_all(port: serial.Serial, data: bytes) -> None:
    """Write all; SerialTimeoutException if the port is blocked, OSError if it is lost."""
    opened = descriptor(port)
    if opened is not None:
        with contextlib.suppress(BlockingIOError):  # buffer full: wait
            data = data[os.write(opened, data) :]
    if data:
        port.write(data)
