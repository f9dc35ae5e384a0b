"""Amplifier URLs of every wire, parsed and refused."""

import pytest

from drivers.errors import CommandError
from drivers.urls.can_bus import CanBusUrl, CanUrl
from drivers.urls.modbus import ModbusUrl
from drivers.urls.serial_line import SerialUrl
from drivers.wires.known import address_of

TCP, RTU = "modbus+tcp", "modbus+rtu"


def bus(interface: str, channel: str, *, server: tuple[str, int] = ("", 0)) -> CanBusUrl:
    """A bus with default options."""
    return CanBusUrl(interface, channel, *server, bitrate=500_000, baud=115_200)


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("serial:///dev/ttyUSB0", SerialUrl("/dev/ttyUSB0", 921_600, 1)),
        ("serial:///dev/ttyS1?baud=115200&address=7", SerialUrl("/dev/ttyS1", 115_200, 7)),
        ("serial:///COM3?baud=9600", SerialUrl("COM3", 9600, 1)),
        ("serial+tcp://box.local:4001", SerialUrl("socket://box.local:4001", 921_600, 1)),
        (f"{TCP}://10.0.0.7", ModbusUrl(False, host="10.0.0.7", port=502, unit=1)),
        (f"{TCP}://amp:1502/247", ModbusUrl(False, host="amp", port=1502, unit=247)),
        (f"{TCP}://[::1]:1502/2", ModbusUrl(False, host="::1", port=1502, unit=2)),
        (
            f"{RTU}:///dev/ttyS1?baud=19200&parity=none&stop=2#9",
            ModbusUrl(True, device="/dev/ttyS1", baud=19200, parity="N", stop=2, unit=9),
        ),
        (f"{RTU}:///dev/ttyS1", ModbusUrl(True, device="/dev/ttyS1", baud=115200, unit=1)),
        (f"{RTU}:///COM3", ModbusUrl(True, device="COM3", baud=115200, unit=1)),
        (f"{TCP}://gw/3?baud=9600", ModbusUrl(False, host="gw", port=502, baud=9600, unit=3)),
        (f"{RTU}://srv:4001#2", ModbusUrl(True, host="srv", port=4001, unit=2)),
        ("can+slcan:///dev/ttyACM0", CanUrl(bus("slcan", "/dev/ttyACM0"), 1)),
        ("can+slcan:///COM7", CanUrl(bus("slcan", "COM7"), 1)),
        (
            "can+slcan://10.0.0.7:4001#9",
            CanUrl(bus("slcan", "", server=("10.0.0.7", 4001)), 9),
        ),
        ("can+socketcan://can0#127", CanUrl(bus("socketcan", "can0"), 127)),
        (
            "can+socketcand://10.0.0.7:29536/can1#9",
            CanUrl(bus("socketcand", "can1", server=("10.0.0.7", 29536)), 9),
        ),
        (
            "can+python-can://virtual/x?bitrate=250000#2",
            CanUrl(CanBusUrl("virtual", "x", "", 0, 250_000, 115_200), 2),
        ),
    ],
)
def test_url_is_parsed(url: str, expected: SerialUrl | ModbusUrl | CanUrl) -> None:
    """Address and options, with their defaults."""
    assert type(expected).parse(url) == expected


@pytest.mark.parametrize(
    ("url", "part"),
    [
        ("serial://", "port"),
        ("serial+tcp://host", "host and port"),
        ("serial://host:4001", "must name a port"),
        ("can+python-can://", "interface"),
        ("can+python-can://socketcan/can0", "interface"),
        ("can+python-can://pcan", "bus"),
        ("can+slcan://host#1", "bus"),
        ("can+slcan://host:4001/x#1", "bus"),
        ("can+slcan://#1", "bus"),
        ("serial+tcp://host:99999", "serial URL"),
        ("serial:///dev/x?baud=fast", "baud .*'fast'"),
        ("serial:///dev/x?baud=0", "baud .*'0'"),
        ("serial:///dev/x?baud=", "baud .*''"),
        ("serial:///dev/x?address=248", "address .*1 to 247"),
        ("serial:///dev/x?speed=9600", "unknown option speed"),
        ("serial:///dev/x?baud=9600&baud=1200", "repeated"),
        (f"serial:///dev/x?baud={'9' * 5000}", "baud .*'999"),
        ("serial:///dev/x#7", r"\?address=7"),
        (f"{TCP}://", "host"),
        (f"{TCP}://h:99999/1", "Modbus URL"),
        (f"{TCP}://h/0", "unit .*1 to 247, got '0'"),
        (f"{TCP}://h/1?speed=5", "unknown option speed"),
        (f"{TCP}://h/1?baud=0", "baud .*'0'"),
        (f"{TCP}://h/one", "unit .*'one'"),
        (f"{RTU}://", "port"),
        (f"{RTU}://h#1", "host and port"),
        (f"{RTU}:///dev/x#248", "1 to 247"),
        (f"{RTU}:///dev/x?speed=3", "unknown option speed"),
        (f"{RTU}:///dev/x?baud=fast", "baud .*'fast'"),
        (f"{RTU}:///dev/x?parity=some", "parity .*'some'"),
        *(
            (f"can+{rest}", r"can\+")
            for rest in (
                *("nothing://can0#1", "socketcan://#1", "socketcan://can0/x#1", "slcan://#1"),
                *("slcan://host/dev/ttyACM0#1", "socketcand://host/can0#1"),
                *("socketcand://:29536/can0#1", "socketcand://host:29536#1"),
                *("socketcan://can0#0", "socketcan://can0#128", "socketcan://can0#one"),
                *("socketcan://can0?bitrate=5#1", "socketcan://can0?node=1#1"),
                *("socketcan://can0?fd=2000000#1", "socketcand://host:99999/can0#1"),
            )
        ),
    ],
)
def test_invalid_url_is_refused(url: str, part: str) -> None:
    """The error names the invalid part."""
    with pytest.raises(CommandError, match=part):
        address_of(url)
