"""Wires assigned by options and by URLs."""

import pytest

from model.errors import InputError
from sim.far_ends.wires import Wire, assign_wires

DEFAULTS = Wire("serial")
URLS = {
    "a": "serial:///dev/ttyUSB0?baud=115200&address=3",
    "b": "serial:///dev/ttyUSB0?address=4",
    "c": "modbus+tcp://192.168.1.7:5020/9",
    "d": "modbus+rtu:///dev/ttyS1?baud=19200#2",
    "e": "can+socketcand://localhost:29536/can0#5",
    "f": "can+slcan:///dev/ttyACM0?bitrate=500000#7",
}


def test_assign_wires_follows_the_urls() -> None:
    """Kind, port and address are those of the URL; equal lines are shared."""
    assigned = assign_wires(URLS, common=None, options=[], defaults=DEFAULTS)
    assert [(wire.kind, wire.port, wire.address) for wire in assigned.values()] == [
        ("serial", 0, 3),
        ("serial", 0, 4),
        ("modbus-tcp", 5020, 9),
        ("modbus-rtu", 0, 2),
        ("socketcand", 29536, 5),
        ("slcan", 0, 7),
    ]
    assert assigned["a"] == assigned["b"]
    assert assigned["a"].shared


def test_assign_wires_prefers_own_option_to_common_to_url() -> None:
    """The result is in the order of the rig."""
    modbus = Wire("modbus-tcp", port=1502)
    assigned = assign_wires(
        URLS, common=modbus, options=["c=slcan", "a=socketcand:7"], defaults=DEFAULTS
    )
    assert list(assigned) == list(URLS)
    assert assigned["a"] == Wire("socketcand", port=7)
    assert assigned["b"] == modbus
    assert assigned["c"] == Wire("slcan")


@pytest.mark.parametrize(
    "options",
    [
        ["main"],
        ["mian=serial"],
        ["main=serial", "main=slcan"],
        ["main=serail"],
        ["main=serial:3"],
        ["main=modbus-tcp:65536"],
        ["main=modbus-tcp:x"],
    ],
)
def test_assign_wires_refuses_an_invalid_option(options: list[str]) -> None:
    """The error names the option as given."""
    with pytest.raises(InputError, match=f"--wire {options[-1]}"):
        assign_wires({"main": "sim://"}, common=None, options=options, defaults=DEFAULTS)


@pytest.mark.parametrize(
    "url", ["sim://", "can+socketcan://can0#1", "modbus+tcp://10.0.0.1/1", "modbus+tcp://h:99999/1"]
)
def test_assign_wires_refuses_a_url_without_a_wire(url: str) -> None:
    """The error names the amplifier and its URL."""
    with pytest.raises(InputError, match="amplifier main: ") as problem:
        assign_wires({"main": url}, common=None, options=[], defaults=DEFAULTS)
    assert url in str(problem.value)
