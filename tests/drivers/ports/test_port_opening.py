"""Opening of serial ports."""

import errno
import os
from unittest.mock import Mock

import pytest
import serial

from drivers.errors import LinkError
from drivers.hardware import Port
from drivers.ports import opening
from drivers.urls import Place


@pytest.mark.parametrize(
    ("device", "parity"), [("/dev/ttyUSB9", serial.PARITY_ODD), ("/dev/pts/9", serial.PARITY_NONE)]
)
def test_device_is_opened_alone_with_low_latency_and_its_settings(
    monkeypatch: pytest.MonkeyPatch, device: str, parity: str
) -> None:
    """A pseudo-terminal has no parity."""
    made = Mock()
    monkeypatch.setattr(opening.serial, "Serial", made)
    opening._open_device(Place(device, baud=19_200, parity="O", stop=2))
    made.return_value.set_low_latency_mode.assert_called_once_with(True)
    settings = {key: made.call_args.kwargs[key] for key in ("baudrate", "parity", "stopbits")}
    assert settings == {"baudrate": 19_200, "parity": parity, "stopbits": 2}
    assert made.call_args.kwargs["exclusive"]


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
