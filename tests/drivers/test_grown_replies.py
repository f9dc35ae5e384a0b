"""Amplifiers older and newer than who reads them, by one word of Status, on every wire."""

import pytest

import hand_written as hand
from amplifier_eds import eds_text
from drivers.by_hand.reaching import status_rows
from drivers.errors import CommandError
from drivers.playing import Layer, Tone
from drivers.protocol.definition import MESSAGES, QUANTITIES, STATUS
from drivers.protocol.records import Number, Record, Refusal, WireQuantity
from firmware_records import records_header
from hand_written import HALF, Talk
from protocol_tables import records
from real_wires import LATER, WORD
from real_wires import age as age
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.can_amplifiers import ObjectServer, SdoAbort
from virtual_lines import KINDS, MemoryLine, group_of, in_virtual_time, judged

STATED = {"older": {"later_voltage": None}, "same": {"later_voltage": WORD}, "newer": {}}
"""Of what is added, by the age of the amplifier."""


@pytest.mark.parametrize("wire", KINDS)
@in_virtual_time
async def test_host_drives_an_amplifier_of_another_edition(wire: str, age: str) -> None:
    """It plays and stops; what is not stated is None, what is not known is ignored."""
    end = MemoryLine(wire, "a")
    group = await group_of(end)
    await group.apply({"a": [Layer(0, (Tone(0, 100.0, 0.5),), 0.001)]})
    await group.beat()
    status = await end.hosts["a"].read_status()
    assert end.levels("a") == [0.5, 0.0]
    assert {each: status[each] for each in status if each not in _FIRST} == STATED[age]
    assert status_rows(status | {"clock": 0x40000000})["clock_s"] == 5.0  # a quarter of 20 s
    shown = {"older": None, "same": 0.0, "newer": "no key"}[age]
    assert status_rows(status).get("later_voltage_v", "no key") == shown
    assert (await group.stop())["a"].is_confirmed


_FIRST = frozenset(STATUS.names)
_UNSTATED = [0] * sum(each.words for each in STATUS.added)
"""What the table has added, of an amplifier that states only what is later than the table."""
_OLDER = 11 + 4 + 8 + len(_UNSTATED)
"""Words of 4 channels and 8 layers."""
_CHECKS = ("capabilities", "starts_disarmed", "areas", "present_areas", "objects", "lengths")


@pytest.mark.parametrize("kind", KINDS)
def test_conformance_takes_another_edition(kind: str, age: str) -> None:
    """Words behind those that are known, or fewer, break no rule."""
    results = judged(kind, _CHECKS)
    assert {each.result for each in results} == {"passed"}


def test_witness_takes_another_edition(age: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A conversation written by hand breaks no rule, with a word more of the amplifier or not."""
    status = hand.status
    words = [] if age == "older" else [*_UNSTATED, WORD]
    monkeypatch.setattr(hand, "status", lambda *given, **more: [*status(*given, **more), *words])
    assert Talk().armed().fed(2).playing().says(**HALF).found == []


def test_objects_are_as_many_as_the_amplifier_states(age: str) -> None:
    """Those of 4 channels and 8 layers, and the one that is added under the next subindex."""
    objects = ObjectServer(Amplifier("a", channels=4), 1)
    if age == "older":
        assert objects.read(0x2002, 0, 0.0) == bytes([_OLDER]), (
            "each row of READINGS has its value in sim/amplifier/readings.py"
        )
        with pytest.raises(SdoAbort):
            objects.read(0x2002, _OLDER + 1, 0.0)
    else:
        assert objects.read(0x2002, 0, 0.0) == bytes([_OLDER + 1])
        assert int.from_bytes(objects.read(0x2002, _OLDER + 1, 0.0), "little") == WORD


@pytest.mark.parametrize("age", ["same"], indirect=True)
def test_pages_and_files_have_what_is_added(age: str) -> None:
    """At the end of its row, of the sheet, and of what the firmware sends."""
    assert " · later_voltage (added) |" in records()
    assert f"[2002sub{_OLDER + 1:X}]\nParameterName=later_voltage\n" in eds_text()
    readings, _, put = records_header().partition("put_status(")
    assert "readings.later_voltage);\n}" in put
    assert "uint16_t later_voltage; // 0.01 V; 1 is -12 V, " in readings
    assert "#define WORD_OF_LATER_VOLTAGE(value) ((value) * 100 + 1201)\n" in readings


@pytest.mark.parametrize(
    ("word", "volts"), [(0, None), (1, -12.0), (1201, 0.0), (1202, 0.01), (7201, 60.0)]
)
def test_reading_that_is_added_may_be_zero_or_less(word: int, volts: float | None) -> None:
    """Steps count from the lowest value, which is 1; both ends agree."""
    assert LATER.in_unit(Record(LATER).unpack([word], is_strict=True)) == volts
    assert volts is None or LATER.quantity.to_wire(volts) == word
    with pytest.raises(CommandError, match="-12 to 60 V"):
        LATER.quantity.to_wire(-12.01)


def test_added_numbers_may_be_missing_and_zero_is_not_stated() -> None:
    """Two are added, the first of two words; nothing behind them is looked at."""
    code = Number("code", QUANTITIES["code"])
    long = Number("long", WireQuantity("long", "u32", 1, "", 1, 1 << 31), is_added=True)
    record = Record(code, long, LATER)
    for words, stated in {
        (7,): (None, None),
        (7, 1): (65536, None),
        (7, 0, 5): (5, None),
        (7, 0, 0, 2400): (None, 2400),
        (7, 1, 2, 2400, 9): (65538, 2400),
    }.items():
        values = dict(zip(("code", "long", LATER.name), (7, *stated), strict=True))
        assert record.unpack(words, is_strict=False) == values
        assert record.pack(values) == [*words[:4]]
    with pytest.raises(Refusal):
        record.unpack([7, 0x8001, 0], is_strict=False)
    with pytest.raises(ValueError, match=r"begin at 1.*got 0.*the zero 1,"):
        Number("flags", QUANTITIES["flags"], is_added=True)


def test_places_of_words_are_those_of_the_page() -> None:
    """Of protocol.md: eleven words before the levels, three before the stream of a set."""
    assert (STATUS.places["token"], STATUS.places["layers"], STATUS.words) == (9, 10, 11)
    part = MESSAGES["Set"].request
    assert (part.places["now"], part.words) == (2, 3)
    caps = MESSAGES["GetCaps"].reply
    assert (caps.places["envelope_step_max"], caps.words) == (17, 19)
