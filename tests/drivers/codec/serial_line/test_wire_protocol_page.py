import re
from pathlib import Path

import pytest

import drivers
from drivers.codec.serial_line.exchanges import encode_event, encode_reply, encode_request
from drivers.codec.serial_line.frame import encode_frame
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.guard import Guard, GuardLimits
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Fault,
    FaultList,
    FaultRecord,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    LoadEnvelope,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)

PAGE = (Path(drivers.__file__).parent.parent / "docs" / "reference" / "wire-protocol.md").read_text(
    "utf-8"
)
EXAMPLES = dict(re.findall(r"^(\w[\w -]*): `((?:[0-9A-F]{2} )+00)`$", PAGE, re.MULTILINE))

CAPABILITIES = Capabilities(
    *(4, 20.0, 600.0, 0.01, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 16, 0.001, 0.1, True)
)
COMMANDS = (
    DriveCommand(channel=0, frequency=110.0, level=0.2, phase=0.0),
    DriveCommand(channel=3, frequency=250.5, level=1.0, phase=-90.0, keep_phase=True),
)
GUARD = Guard(GuardLimits(20.0, 600.0, 1.0), CAPABILITIES)
SET = GUARD.check(CommandSet(token=513, commands=COMMANDS, ramp=0.02, valid_for=0.5))
SHAPE = GUARD.check_envelope(Envelope(slot=5, step=0.005, knots=(Knot(0.1, 90), Knot(1, -0.01))))
GUARD.check_envelope(Envelope(slot=6, step=0.005, knots=(Knot(0.1, 0.0),)))
SHAPED_COMMANDS = (DriveCommand(0, 110.0, 0.2, onset=5, ending=6),)
SHAPED = GUARD.check(CommandSet(514, SHAPED_COMMANDS, ramp=0.0, valid_for=0.0))
OFF = Status(AmplifierState.SWITCH_ON_DISABLED, Fault.NONE, 0, False, 25.0, 0.0, (0.0,) * 4)
ARMED = Status(
    AmplifierState.OPERATION_ENABLED, Fault.NONE, 0, True, 25.0, 0.25, (0.0,) * 4, 1800.0
)
PLAYING = Status(
    AmplifierState.OPERATION_ENABLED,
    Fault.NONE,
    513,
    True,
    25.0,
    0.25,
    (0.2, 0.0, 0.0, 1.0),
    1800.0,
)
FADING = Status(
    AmplifierState.SWITCHED_ON, Fault.NONE, 513, True, 25.0, 0.0, (0.2, 0.0, 0.0, 1.0), 1800.0
)
STOPPED = Status(
    AmplifierState.QUICK_STOP_ACTIVE, Fault.NONE, 513, True, 25.0, 0.0, (0.2, 0.0, 0.0, 1.0), 1800.0
)
TRIPPED = Status(AmplifierState.FAULT, Fault.WATCHDOG, 513, False, 25.0, 0.0, (0.0,) * 4)

EXCHANGES: dict[str, tuple[Request, Reply]] = {
    "Hello": (Hello(), Identity("Acme", "Quad", "A-17", "1.2", 1)),
    "GetCaps": (GetCaps(), CAPABILITIES),
    "Arm": (Arm(watchdog=0.25), ARMED),
    "Disarm": (Disarm(ramp=0.05), FADING),
    "Stage": (Stage(SET), Achieved(513, COMMANDS)),
    "Commit": (Commit(token=513), Achieved(513, COMMANDS)),
    "Apply": (Apply(SET), Achieved(513, COMMANDS)),
    "Stop": (Stop(ramp=0.005), STOPPED),
    "GetStatus": (GetStatus(), TRIPPED),
    "GetFaults": (
        GetFaults(),
        FaultList((FaultRecord(Fault.WATCHDOG, None, 1.5), FaultRecord(Fault.ARC, 2, 65.536))),
    ),
    "Clear": (Clear(), OFF),
    "Ping": (Ping(), PLAYING),
    "LoadEnvelope": (LoadEnvelope(SHAPE), Loaded(slot=5, knots=2)),
    "Shaped Apply": (Apply(SHAPED), Achieved(514, SHAPED_COMMANDS)),
    "Refused Apply": (Apply(SET), Nak(NakCode.BAD_CHANNEL, 3)),
    "Refused Arm": (Arm(watchdog=0.25), Nak(NakCode.WRONG_STATE)),
}


def made(name: str) -> tuple[str, str]:
    """Request and reply of an example as the codec makes them: address 1, sequence 7."""
    request, reply = EXCHANGES[name]
    frame = encode_request(request, address=1, sequence=7)
    frames = (frame, encode_reply(reply, frame))
    question, answer = (encode_frame(one).hex(" ").upper() for one in frames)
    return question, answer


def test_every_message_has_an_example() -> None:
    """The page shows a request and a reply for every message, and nothing else."""
    names = {f"{name} {part}" for name in EXCHANGES for part in ("request", "reply")}
    assert set(EXAMPLES) == names | {"Event"}
    assert {type(request) for request, _ in EXCHANGES.values()} == set(Request.__args__)


@pytest.mark.parametrize("name", EXCHANGES)
def test_examples_are_what_the_codec_makes(name: str) -> None:
    """An amplifier built from the page understands this host, to the byte."""
    assert (EXAMPLES[f"{name} request"], EXAMPLES[f"{name} reply"]) == made(name)


def test_the_example_of_an_event_is_what_the_codec_makes() -> None:
    """The one frame that answers nothing: address 1, the fourth event."""
    event = AmplifierEvent(AmplifierState.FAULT_REACTION_ACTIVE, Fault.ARC, 2)
    frame = encode_event(event, address=1, sequence=4)
    assert EXAMPLES["Event"] == encode_frame(frame).hex(" ").upper()


@pytest.mark.parametrize(
    "numbers", [PROTOCOL.states, PROTOCOL.faults, PROTOCOL.naks, PROTOCOL.types]
)
def test_the_tables_have_the_numbers_of_the_definition(numbers: dict[str, int]) -> None:
    """Every code of protocol.yaml stands in a table of the page with its number."""
    rows = dict(re.findall(r"^\| (\w+) \| (\d+) \|", PAGE, re.MULTILINE))
    aliases = {"nak": "Nak"}
    for name, number in numbers.items():
        shown = name if name.isupper() else aliases.get(name, name.title().replace("_", ""))
        assert rows.get(shown) == str(number), shown


def test_the_ranges_are_those_of_the_definition() -> None:
    """The table of quantities gives wire type, step and range as in protocol.yaml."""
    rows = {
        name: (wire, step, low, high)
        for name, wire, step, low, high in re.findall(
            r"^\| (\w+) \| ([ui]\d+) \| ([^|]+?) \| (-?\d+) \| (-?\d+) \|", PAGE, re.MULTILINE
        )
    }
    for name, quantity in vars(PROTOCOL.quantities).items():
        unit = f" {quantity.unit}" if quantity.unit else ""
        expected = (
            quantity.wire,
            f"{quantity.step:g}{unit}",
            str(quantity.minimum),
            str(quantity.maximum),
        )
        assert rows[name] == expected
