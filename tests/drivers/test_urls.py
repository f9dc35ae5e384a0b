"""Amplifier URLs of every wire, parsed and refused."""

import pytest

from drivers.errors import CommandError
from drivers.wires.known import address_of

TCP, RTU = "modbus+tcp", "modbus+rtu"
EVEN = {"parity": "E", "stop": 1}


@pytest.mark.parametrize(
    ("url", "line", "number", "settings"),
    [
        ("serial:///dev/ttyUSB0", "/dev/ttyUSB0", 1, {"baud": 921_600}),
        ("serial:///dev/ttyS1?baud=115200&address=7", "/dev/ttyS1", 7, {"baud": 115_200}),
        ("serial+tcp://box.local:4001", "box.local:4001", 1, {"baud": 0}),
        ("serial+tcp://box:4001?baud=19200&address=3", "box:4001", 3, {"baud": 19_200}),
        (f"{TCP}://10.0.0.7", "10.0.0.7:502", 1, {"baud": 0}),
        (f"{TCP}://amp:1502/247", "amp:1502", 247, {"baud": 0}),
        (f"{TCP}://[::1]:1502/2", "::1:1502", 2, {"baud": 0}),
        (
            f"{RTU}:///dev/ttyS1?baud=19200&parity=none&stop=2#9",
            *("/dev/ttyS1", 9, {"baud": 19_200, "parity": "N", "stop": 2}),
        ),
        (f"{RTU}:///dev/ttyS1", "/dev/ttyS1", 1, {"baud": 115_200, **EVEN}),
        ("serial:///dev/by-id/a_#1-if00?baud=9600", "/dev/by-id/a_#1-if00", 1, {"baud": 9600}),
        (f"{RTU}:///dev/by-id/a_#1-if00?stop=2#9", "/dev/by-id/a_#1-if00", 9, {"stop": 2}),
        (f"{TCP}://gw/3?baud=9600", "gw:502", 3, {"baud": 9600, **EVEN}),
        (f"{RTU}://srv:4001#2", "srv:4001", 2, {"baud": 0}),
        ("can+slcan:///dev/ttyACM0", "can+slcan:///dev/ttyACM0", 1, {"bitrate": 500_000}),
        ("can+slcan://10.0.0.7:4001#9", "can+slcan://10.0.0.7:4001", 9, {}),
        ("can+socketcan://can0#127", "can+socketcan://can0", 127, {"bitrate": 500_000}),
        ("can+socketcand://10.0.0.7:29536/can1#9", "can+socketcand://10.0.0.7:29536/can1", 9, {}),
        (
            "can+python-can://virtual/x?bitrate=250000#2",
            *("can+python-can://virtual/x", 2, {"bitrate": 250_000}),
        ),
    ],
)
def test_url_is_parsed(url: str, line: str, number: int, settings: dict[str, object]) -> None:
    """Line, address and options, with their defaults."""
    address = address_of(url)
    assert (address.line, address.number) == (line, number)
    assert settings.items() <= address.settings.items()


@pytest.mark.parametrize(
    ("url", "part"),
    [
        ("serial://", "port"),
        ("serial+tcp://host", "port must be given, got 'host'"),
        ("serial+tcp://:4001", "host must be given, got ':4001'"),
        ("serial+tcp://host:4001/2", r"address must be given as \?address=2, got /2"),
        ("serial://host:4001", "port .*got 'host:4001'"),
        ("can+python-can://", "interface"),
        ("can+python-can://socketcan/can0", "interface .*'socketcan'"),
        ("can+python-can://pcan", "bus"),
        ("can+socketcan://can0/1", "node must be given as #1, got /1"),
        ("can+socketcand://host:29536/can0/1", "node must be given as #1, got /1"),
        ("can+slcan://host#1", "port must be given, got 'host'"),
        ("can+slcan://host:4001/2", "node must be given as #2, got /2"),
        ("can+slcan://#1", "port"),
        ("serial+tcp://host:99999", "0-65535"),
        ("serial:///dev/x?baud=fast", "baud .*'fast'"),
        ("serial:///dev/x?baud=0", "baud .*'0'"),
        ("serial:///dev/x?baud=", "baud .*''"),
        ("serial:///dev/x?address=248", "address .*1 to 247"),
        ("serial:///dev/x?speed=9600", "option speed is unknown"),
        ("serial:///dev/x?line=usb", "line must be one of"),
        ("serial:///dev/x?baud=9600&baud=1200", "repeat"),
        (f"serial:///dev/x?baud={'9' * 5000}", "baud .*'999"),
        ("serial:///dev/x#7", r"\?address=7"),
        (f"{TCP}://", "host"),
        (f"{TCP}://h:99999/1", "0-65535"),
        (f"{TCP}://h/0", "unit .*1 to 247, got '0'"),
        (f"{TCP}://h/1?speed=5", "option speed is unknown"),
        (f"{TCP}://h/1?baud=0", "baud .*'0'"),
        (f"{TCP}://h/one", "unit .*'one'"),
        (f"{RTU}://", "port"),
        (f"{RTU}://h#1", "port must be given, got 'h'"),
        (f"{RTU}://h:4001/5", "unit must be given as #5, got /5"),
        (f"{TCP}://h#5", "unit must be given as /5"),
        ("sim://rig.yaml#main", r"amplifier must be given as \?amplifier=main"),
        (f"{RTU}:///dev/x#248", "1 to 247"),
        (f"{RTU}:///dev/x?speed=3", "option speed is unknown"),
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
