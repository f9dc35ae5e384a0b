"""Writing to a serial port without being told of a time-out that is none.

pyserial looks at the clock after the system has taken the bytes: where this process was held up
meanwhile it says that nothing could be sent, though all was. So the system is asked first.
"""

import contextlib
import os

import serial


def descriptor(port: serial.Serial) -> int | None:
    """The file descriptor of a port, where the system has such."""
    if os.name != "posix":
        return None
    try:
        return int(port.fileno())
    except (OSError, AttributeError):  # UnsupportedOperation is one of OSError
        return None


def write_all(port: serial.Serial, data: bytes) -> None:
    """Write all; SerialTimeoutException where the port takes no more, OSError where it is gone."""
    opened = descriptor(port)
    if opened is not None:
        with contextlib.suppress(BlockingIOError):  # its buffer is full: wait a little
            data = data[os.write(opened, data) :]
    if data:
        port.write(data)
