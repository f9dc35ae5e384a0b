"""Opening of what carries bytes: serial ports and USB adapters of this machine, and TCP ports.

A serial port never blocks the event loop. A frame that it does not take at once follows as soon as
it takes it, unless a newer frame replaces the rest of it: what the line delivers late must not
delay a stop.
"""

import contextlib
import errno
import os
import select
from collections.abc import Callable
from typing import final

import serial

from drivers.errors import LinkError, system_message
from drivers.ports.device_port import DevicePort
from drivers.ports.port import PORT_OPENER, Port
from drivers.ports.tcp import open_connection
from drivers.urls import Place
from registry.threads import in_thread

_READ_MAX = 4096

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
    import termios  # not on Windows

    try:
        port = await in_thread(
            lambda: _open_device(place), name=f"era-open {name}", undo=lambda port: port.close()
        )
    except (OSError, ValueError, termios.error) as error:  # of pyserial
        raise LinkError(
            f"serial port {name} cannot be opened: {remedy_of(error)} (the system says: "
            f"{system_message(error)})"
        ) from error
    return SerialPort(port, name, on_data, on_loss)


def _open_device(place: Place) -> serial.Serial:
    import termios

    # A pseudo-terminal has no parity and may refuse all settings if one is given.
    is_pseudo = os.path.realpath(place.device).startswith("/dev/pts/")
    port = serial.Serial(
        place.device,
        baudrate=place.baud,
        parity=serial.PARITY_NONE if is_pseudo else place.parity,
        stopbits=place.stop,
        exclusive=True,
    )
    try:
        # USB adapters delay bytes by 16 ms unless low latency is set; most support it.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            port.set_low_latency_mode(True)
        # DTR stays up when it is closed: a board that it restarts does so at one opening alone.
        settings = termios.tcgetattr(port.fileno())
        settings[2] &= ~termios.HUPCL
        termios.tcsetattr(port.fileno(), termios.TCSANOW, settings)
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


@final
class SerialPort(DevicePort):
    """A port of pyserial, read and written by the event loop."""

    kind = "serial line"

    def __init__(
        self,
        port: serial.Serial,
        name: str,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._unsent = b""
        super().__init__(name, port.fileno(), on_data, on_loss, port.close)

    @property
    def is_blocked(self) -> bool:
        """Whether the port has not taken all bytes yet."""
        return bool(self._unsent)

    def write(self, data: bytes) -> None:
        """Send bytes, as soon as the port takes them; raises LinkError."""
        self._unsent = data
        self._send()
        if self._unsent and self.descriptor is not None:
            self.loop.add_writer(self.descriptor, self._send_rest)

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the port."""
        self._unsent = b""
        if self.descriptor is not None:
            self.loop.remove_writer(self.descriptor)
        super().close()

    def read_watched(self) -> bytes:
        """Return what has come; OSError for the end, which an empty read of a terminal is not."""
        if self.descriptor is None:
            return b""
        try:
            data = os.read(self.descriptor, _READ_MAX)
        except BlockingIOError:
            return b""
        if not data:
            state = select.poll()
            state.register(self.descriptor, 0)  # a hang-up is reported all the same
            if state.poll(0):
                raise OSError("end of file")
        return data

    def _send(self) -> None:
        """Write what the descriptor takes; raises LinkError."""
        if self.descriptor is None:
            raise self.lose(OSError("it is closed"))
        try:
            self._unsent = self._unsent[os.write(self.descriptor, self._unsent) :]
        except BlockingIOError:
            return
        except OSError as error:
            raise self.lose(error) from error

    def _send_rest(self) -> None:
        """Send the rest, for which there is room; nothing, where a newer frame has gone whole."""
        with contextlib.suppress(LinkError):  # reported as a loss
            self._send()
        if not self._unsent and self.descriptor is not None:
            self.loop.remove_writer(self.descriptor)
