"""The page for vendors: its frames are golden bytes for both directions of the codec."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

import drivers
from drivers.codec.serial_line.exchanges import (
    decode_event,
    decode_reply,
    decode_request,
    encode_event,
    encode_reply,
    encode_request,
    is_event,
)
from drivers.codec.serial_line.frame import Frame, FrameReader, encode_frame
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    AmplifierEvent,
    AmplifierState,
    Arm,
    Fault,
    Feature,
    GetCaps,
    GetStatus,
    Nak,
    NakCode,
    Reply,
    Request,
)
from vendor_pages import CAPABILITIES, EXAMPLES, TRIPPED, plain

PAGE = (Path(drivers.__file__).parent.parent / "docs" / "reference" / "wire-protocol.md").read_text(
    "utf-8"
)
FRAMES = {
    name: bytes.fromhex(data)
    for name, data in re.findall(r"^(\w[\w -]*): `((?:[0-9A-F]{2} )+00)`$", PAGE, re.MULTILINE)
}
EXCHANGES: dict[str, tuple[Request, Reply]] = {
    **{name: (example.request, example.reply) for name, example in EXAMPLES.items()},
    "GetCaps": (GetCaps(), replace(CAPABILITIES, features=CAPABILITIES.features | Feature.EVENTS)),
    "GetStatus": (GetStatus(), replace(TRIPPED, temperature=25.0)),
    "Refused Arm": (Arm(watchdog=0.25, session=9), Nak(NakCode.WRONG_STATE)),
}


def frame_of(name: str) -> Frame:
    """Decode a frame of the page."""
    (frame,) = FrameReader().feed(FRAMES[name])
    return frame


def test_page_shows_every_message() -> None:
    """A request and a reply each, and an event."""
    names = {f"{name} {part}" for name in EXCHANGES for part in ("request", "reply")}
    assert set(FRAMES) == names | {"Event"}
    assert {type(request) for request, _ in EXCHANGES.values()} == set(Request.__args__)


@pytest.mark.parametrize("name", EXCHANGES)
def test_codec_makes_and_reads_the_frames_of_the_page(name: str) -> None:
    """Address 1, sequence 7; decoded sets and envelopes are plain."""
    request, reply = EXCHANGES[name]
    asked = encode_request(request, address=1, sequence=7)
    assert encode_frame(asked) == FRAMES[f"{name} request"]
    assert encode_frame(encode_reply(reply, asked)) == FRAMES[f"{name} reply"]
    decoded = decode_request(frame_of(f"{name} request"))
    assert decoded == plain(request)
    content = getattr(decoded, "command_set", None) or getattr(decoded, "envelope", None)
    assert not type(content).__name__.startswith("Safe")
    assert decode_reply(frame_of(f"{name} reply"), asked) == reply


def test_codec_makes_and_reads_the_event_of_the_page() -> None:
    """The fourth event of address 1; no request has its type."""
    event = AmplifierEvent(AmplifierState.FAULT_REACTION_ACTIVE, Fault.ARC, 2)
    frame = encode_event(event, address=1, sequence=4)
    assert encode_frame(frame) == FRAMES["Event"]
    assert is_event(frame_of("Event"))
    assert decode_event(frame_of("Event")) == event


@pytest.mark.parametrize(
    "numbers", [PROTOCOL.states, PROTOCOL.faults, PROTOCOL.naks, PROTOCOL.types]
)
def test_tables_of_the_page_have_the_numbers_of_the_definition(numbers: dict[str, int]) -> None:
    """Every code of protocol.yaml."""
    rows = dict(re.findall(r"^\| (\w+) \| (\d+) \|", PAGE, re.MULTILINE))
    for name, number in numbers.items():
        shown = name if name.isupper() else name.title().replace("_", "")
        assert rows.get(shown) == str(number), shown


def test_ranges_of_the_page_are_those_of_the_definition() -> None:
    """Wire type, step and range of every quantity."""
    rows = {
        name: cells
        for name, *cells in re.findall(
            r"^\| (\w+) \| ([ui]\d+) \| ([^|]+?) \| (-?\d+) \| (-?\d+) \|", PAGE, re.MULTILINE
        )
    }
    for name, quantity in vars(PROTOCOL.quantities).items():
        step = f"{quantity.step:g} {quantity.unit}".rstrip()
        assert rows[name] == [quantity.wire, step, str(quantity.minimum), str(quantity.maximum)]
