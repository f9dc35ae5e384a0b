"""Opening of what carries bytes: serial ports and USB adapters of this machine, and TCP ports."""

import contextlib
import errno
import os
from collections.abc import Callable

import serial

from drivers.errors import LinkError, system_message
from drivers.hardware import PORT_OPENER, Port
from drivers.ports.serial_port import READ_TIMEOUT, SerialPort
from drivers.ports.tcp import open_connection
from drivers.threads import in_thread
from drivers.urls import Place

_FAILURES: tuple[type[Exception], ...] = (OSError, ValueError)  # of pyserial, at opening
with contextlib.suppress(ImportError):  # Windows has no terminals
    import termios

    _FAILURES += (termios.error,)

_NO_PERMISSION = (
    "no permission; add the user to the group that owns the port "
    "(often dialout: sudo usermod -aG dialout $USER) and log in again"
)
_UNKNOWN = "check its name, the plug, its speed and its parity"
_IN_USE = "in use by another program; close that one"
_REMEDIES = {
    errno.ENOENT: "no such port; plug in the adapter and check its name in /dev",
    errno.EACCES: _NO_PERMISSION,
    errno.EPERM: _NO_PERMISSION,
    errno.EAGAIN: _IN_USE,
    errno.EBUSY: _IN_USE,
}


async def open_port(
    place: Place, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> Port:
    """Open a device, exclusively if the system can, or connect; raises LinkError.

    on_data: called with received bytes; on_loss: called once with the cause of a loss.
    """
    if place.host:
        return await open_connection(place.host, place.port, on_data, on_loss)
    name = place.device
    opener = PORT_OPENER.get()
    if opener is not None:
        return await opener(name, on_data, on_loss)
    try:
        port = await in_thread(
            lambda: _open_device(place), name=f"era-open {name}", undo=lambda port: port.close()
        )
    except _FAILURES as error:
        raise LinkError(
            f"serial port {name} cannot be opened: {remedy_of(error)} (the system says: "
            f"{system_message(error)})"
        ) from error
    return SerialPort(port, name, on_data, on_loss)


def _open_device(place: Place) -> serial.Serial:
    # A pseudo-terminal has no parity and may refuse all settings if one is given.
    is_pseudo = os.path.realpath(place.device).startswith("/dev/pts/")
    port = serial.Serial(
        place.device,
        baudrate=place.baud,
        parity=serial.PARITY_NONE if is_pseudo else place.parity,
        stopbits=place.stop,
        timeout=READ_TIMEOUT,
        exclusive=True,
    )
    try:
        # USB adapters delay bytes by 16 ms unless low latency is set; most support it.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            port.set_low_latency_mode(True)
        port.reset_input_buffer()
    except BaseException:
        port.close()  # else it stays this program's, which could not open it again
        raise
    return port


def remedy_of(error: BaseException | None) -> str:
    """Return the remedy for an opening error by the error code of it or its cause."""
    while error is not None:
        code = getattr(error, "errno", None)
        if code is not None:
            return _REMEDIES.get(code, _UNKNOWN)
        error = error.__cause__ or error.__context__
    return _UNKNOWN
