"""Opening of serial ports."""

import errno
import os

import pytest
import serial

from drivers.errors import LinkError
from drivers.hardware import Port
from drivers.ports import opening
from drivers.urls import Place
from drivers.wires.known import address_of


class _Port:
    """The used part of a pyserial port, without data."""

    def __init__(self, port: str, **settings: object) -> None:
        self.port = port
        self.settings = settings
        self.is_low_latency = False
        self.in_waiting = 0
        self._read, self._write = os.pipe()

    def set_low_latency_mode(self, low_latency: bool) -> None:
        self.is_low_latency = low_latency

    def reset_input_buffer(self) -> None:
        """Do nothing."""

    def fileno(self) -> int:
        return self._read

    def close(self) -> None:
        os.close(self._read)
        os.close(self._write)


@pytest.mark.parametrize(
    ("device", "parity"), [("/dev/ttyUSB9", serial.PARITY_ODD), ("/dev/pts/9", serial.PARITY_NONE)]
)
async def test_open_port_sets_low_latency_and_parity(
    monkeypatch: pytest.MonkeyPatch, device: str, parity: str
) -> None:
    """A pseudo-terminal has no parity."""
    opened: list[_Port] = []

    def make(port: str, **settings: object) -> _Port:
        opened.append(_Port(port, **settings))
        return opened[0]

    monkeypatch.setattr(opening.serial, "Serial", make)
    address = address_of(f"modbus+rtu://{device}?baud=19200&parity=odd&stop=2#1")
    port = await address.open_port(lambda data: None, lambda what: None)
    (made,) = opened
    assert made.is_low_latency
    asked = {key: made.settings[key] for key in ("baudrate", "parity", "stopbits", "exclusive")}
    assert asked == {"baudrate": 19200, "parity": parity, "stopbits": 2, "exclusive": True}
    port.close()
    await port.wait_closed()


async def test_port_that_fails_amid_its_opening_is_released(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is opened exclusively: else this program could not open it again."""
    far, near = os.openpty()
    name = os.ttyname(near)

    async def open_it() -> Port:
        return await opening.open_port(
            Place(name, baud=9600), lambda data: None, lambda cause: None
        )

    def fail(port: serial.Serial) -> None:
        raise OSError(errno.EIO, "gone")

    with monkeypatch.context() as patch:
        patch.setattr(serial.Serial, "reset_input_buffer", fail)
        with pytest.raises(LinkError, match="gone"):
            await open_it()
    port = await open_it()
    port.close()
    await port.wait_closed()
    os.close(near)
    os.close(far)
