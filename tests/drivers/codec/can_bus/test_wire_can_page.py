import re
from pathlib import Path

import pytest

import drivers
from can_eds import entries
from can_files import FILES
from can_session import session
from drivers.codec.can_bus.frame import CANOPEN
from drivers.protocol.definition import PROTOCOL

DOCS = Path(drivers.__file__).parent.parent / "docs" / "reference"
PAGE = (DOCS / "wire-can.md").read_text("utf-8")
STEPS = session()


def shown() -> dict[str, list[str]]:
    """Return the session of the page: frames by title; repeated titles are marked."""
    steps: dict[str, list[str]] = {}
    title = ""
    for line in PAGE[PAGE.index("## A session") :].splitlines():
        if line.startswith("    # "):
            title = line.removeprefix("    # ")
            title += " (again)" if title in steps else ""
            steps[title] = []
        elif line.startswith(("    >", "    <")):
            steps[title].append(line.strip())
    return steps


def test_session_equals_encoder_and_far_end() -> None:
    """Every frame of the page, host's and amplifier's, to the byte and in its order."""
    played: dict[str, list[str]] = {}
    for step in STEPS:
        played[step.title + (" (again)" if step.title in played else "")] = list(step.lines())
    assert len(played) >= 25
    assert shown() == played


def test_fields_equal_the_definition() -> None:
    """The table of frames gives first bit and length of every field of protocol.yaml."""
    rows = {
        (frame, field): (int(first), int(bits))
        for frame, field, first, bits in re.findall(
            r"^\| (\w+) \| (\w+) \| (\d+) \| (\d+) \|", PAGE, re.MULTILINE
        )
    }
    declared = {
        (frame, field): tuple(place)
        for frame, fields in CANOPEN["frames"].items()
        for field, place in fields.items()
    }
    assert rows == declared


def test_objects_equal_the_definition() -> None:
    """Every object stands in the table with its index and access."""
    rows = set(
        re.findall(r"^\| ([0-9A-F]{4}) \| [^|]+ \| ([\w ]+) \| \w+ \| (\w+) \|$", PAGE, re.M)
    )
    for entry in entries(4):
        name = re.sub(r" \d+$", "", entry.name)
        assert (f"{entry.index:04X}", name, entry.access) in rows


@pytest.mark.parametrize("table", ["emergencies", "aborts"])
def test_codes_equal_the_definition(table: str) -> None:
    """Emergency and abort codes stand in hexadecimal beside their names."""
    for name, code in CANOPEN[table].items():
        if table == "emergencies":
            expected = f"| {name} | {code['code']:04X} | {code['error_register']:02X} |"
        else:
            expected = f"| {name} | {PROTOCOL.naks[name]} | {code:08X} |"
        assert expected in PAGE


def test_every_fault_and_nak_has_a_code() -> None:
    """Emergencies and aborts are complete."""
    assert CANOPEN["emergencies"].keys() == PROTOCOL.faults.keys()
    assert CANOPEN["aborts"].keys() == PROTOCOL.naks.keys()


@pytest.mark.parametrize("name", FILES)
def test_eds_and_dbc_are_up_to_date(name: str) -> None:
    """EDS and DBC are what `python docs/generators/can_files.py docs/reference` writes."""
    assert (DOCS / name).read_text("utf-8") == FILES[name]()
