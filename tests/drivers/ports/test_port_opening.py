"""Opening of serial ports."""

import os

import pytest
import serial

from drivers.ports import opening
from drivers.wires.known import address_of


class _Port:
    """The used part of a pyserial port, without data."""

    def __init__(self, port: str, **settings: object) -> None:
        self.port = port
        self.settings = settings
        self.is_low_latency = False
        self.in_waiting = 0
        self._read, self._write = os.pipe()

    def open(self) -> None:
        """Do nothing."""

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

    monkeypatch.setattr(opening.serial, "serial_for_url", make)
    address = address_of(f"modbus+rtu://{device}?baud=19200&parity=odd&stop=2#1")
    port = await address.open_port(lambda data: None, lambda what: None)
    (made,) = opened
    assert made.is_low_latency
    asked = {key: made.settings[key] for key in ("baudrate", "parity", "stopbits", "exclusive")}
    assert asked == {"baudrate": 19200, "parity": parity, "stopbits": 2, "exclusive": True}
    port.close()
    await port.wait_closed()
