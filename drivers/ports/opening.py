"""Opening of serial ports, USB adapters and serial servers, named as in pyserial."""

import contextlib
import os
from collections.abc import Callable

import serial

from drivers.errors import LinkError, system_message
from drivers.hardware import HARDWARE_PROVIDER, Port
from drivers.ports.tcp import bound_delay
from drivers.ports.watched import (
    READ_TIMEOUT,
    WatchedPort,
    close_port,
    connection_of,
    remedy_of,
)
from drivers.threads import in_thread

_FAILURES: tuple[type[Exception], ...] = (OSError, ValueError)  # of pyserial, at opening
with contextlib.suppress(ImportError):  # Windows has no terminals
    import termios

    _FAILURES += (termios.error,)


async def open_port(
    name: str,
    *,
    baud: int,
    parity: str = serial.PARITY_NONE,
    stop: int = 1,
    on_data: Callable[[bytes], None],
    on_loss: Callable[[str], None],
) -> Port:
    """Open a port, exclusively if the system can; raises LinkError.

    parity, stop bits: as named by pyserial. on_data: called with received bytes; on_loss: called
    once with the cause of a loss.
    """
    hardware = HARDWARE_PROVIDER.get()
    if hardware is not None:
        return await hardware.open_port(name, on_data=on_data, on_loss=on_loss)
    try:
        port = await in_thread(
            lambda: _open_port(name, baud, parity, stop), name=f"era-open {name}", undo=close_port
        )
    except _FAILURES as error:
        raise LinkError(_why_not_open(name, error)) from error
    return WatchedPort(port, name, on_data, on_loss)


def _open_port(name: str, baud: int, parity: str, stop: int) -> serial.Serial:
    # A pseudo-terminal has no parity and may refuse all settings if one is given.
    is_pseudo = os.path.realpath(name).startswith("/dev/pts/")
    port = serial.serial_for_url(
        name,
        do_not_open=True,
        baudrate=baud,
        parity=serial.PARITY_NONE if is_pseudo else parity,
        stopbits=stop,
        timeout=READ_TIMEOUT,
        exclusive=True,
    )
    port.open()
    try:
        # USB adapters delay bytes by 16 ms unless low latency is set; most support it.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            port.set_low_latency_mode(True)
        connection = connection_of(port)
        if connection is not None:
            bound_delay(connection)
        port.reset_input_buffer()
    except BaseException:
        close_port(port)  # else it stays this program's, which could not open it again
        raise
    return port


def _why_not_open(port: str, error: Exception) -> str:
    remedy = remedy_of(error)
    if remedy is None and port.startswith("socket://"):
        remedy = "no server there; check the address, and that the serial server runs"
    elif remedy is None:
        remedy = "check its name, the plug, its speed and its parity"
    said = system_message(error)
    return f"serial port {port} cannot be opened: {remedy} (the system says: {said})"
