"""Which wire each amplifier gets: by options, by its own URL, and what cannot be understood."""

import pytest

from model.errors import InputError
from sim.far_ends.wire_assignment import WireAssignment, assign_wires
from sim.far_ends.wires import Wire

PLAIN = Wire("serial")
URLS = {
    "a": "serial:///dev/ttyUSB0?baud=115200&address=3",
    "b": "serial:///dev/ttyUSB0?address=4",
    "c": "modbus+tcp://192.168.1.7:5020/9",
    "d": "modbus+rtu:///dev/ttyS1?baud=19200#2",
    "e": "can+socketcand://localhost:29536/can0#5",
    "f": "can+slcan:///dev/ttyACM0?bitrate=500000#7",
}


def test_the_urls_of_a_rig_ask_for_their_wires() -> None:
    """Kind, port and address as the URL has them; a line that two URLs name is one line."""
    assigned = assign_wires(URLS, common=None, options=[], plain=PLAIN)
    assert [
        (choice.wire.kind, choice.wire.port, choice.number) for choice in assigned.values()
    ] == [
        ("serial", 0, 3),
        ("serial", 0, 4),
        ("modbus-tcp", 5020, 9),
        ("modbus-rtu", 0, 2),
        ("socketcand", 29536, 5),
        ("slcan", 0, 7),
    ]
    assert assigned["a"].wire == assigned["b"].wire
    assert assigned["a"].wire.shared


def test_an_option_for_one_goes_before_that_for_all_before_the_url() -> None:
    """And the answer has the rig's order, whatever order the options have."""
    modbus = Wire("modbus-tcp", port=1502)
    assigned = assign_wires(URLS, common=modbus, options=["c=slcan", "a=socketcand:7"], plain=PLAIN)
    assert list(assigned) == list(URLS)
    assert assigned["a"] == WireAssignment(Wire("socketcand", port=7))
    assert assigned["b"] == WireAssignment(modbus)
    assert assigned["c"] == WireAssignment(Wire("slcan"))


@pytest.mark.parametrize(
    ("own", "words"),
    [
        (["main"], "is not NAME=WIRE"),
        (["mian=serial"], "names no amplifier of the rig; it has main"),
        (["main=serial", "main=slcan"], "is chosen twice"),
        (["main=serail"], "'serail' is no wire; choose one of serial, modbus-tcp:PORT"),
        (["main=serial:3"], "'serial:3' is no wire"),
        (["main=modbus-tcp:65536"], "'modbus-tcp:65536' is no wire"),
        (["main=modbus-tcp:x"], "'modbus-tcp:x' is no wire"),
    ],
)
def test_what_is_no_choice_is_refused(options: list[str], words: str) -> None:
    """Each with the option as it was typed, and what may stand in its place."""
    with pytest.raises(InputError, match="--wire") as problem:
        assign_wires({"main": "sim://"}, common=None, options=options, plain=PLAIN)
    assert words in str(problem.value)


@pytest.mark.parametrize(
    "url", ["sim://", "can+socketcan://can0#1", "modbus+tcp://10.0.0.1/1", "modbus+tcp://h:99999/1"]
)
def test_a_url_that_names_no_wire_to_simulate_is_named(url: str) -> None:
    """A kernel's CAN, no wire at all, a port that is missing or none: the amplifier is named."""
    with pytest.raises(InputError, match="amplifier main: ") as problem:
        assign_wires({"main": url}, common=None, options=[], plain=PLAIN)
    assert url in str(problem.value)
