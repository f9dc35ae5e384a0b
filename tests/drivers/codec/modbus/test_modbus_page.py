import re
from pathlib import Path

import pytest

import drivers
from drivers.codec.modbus import exchanges
from drivers.codec.modbus.adu import RequestAdu, ResponseReader, build_adu
from drivers.codec.modbus.exchanges import Exchange, Read, Write
from drivers.command import CommandSet, DriveCommand
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Apply, Commit, Disarm, Nak, Request, SetAddress, Stop
from drivers.statistics import WireCounters
from sim.far_ends.modbus.frames import RequestAdu as Asked
from sim.far_ends.modbus.frames import rtu_frame, tcp_frame
from sim.far_ends.modbus.unit import ModbusUnit
from vendor_pages import EXAMPLES as ALL
from vendor_pages import GUARD, ScriptedDevice, plain

PAGE = (Path(drivers.__file__).parent.parent / "docs" / "reference" / "wire-modbus.md").read_text(
    "utf-8"
)
FRAMES = {
    name: bytes.fromhex(data)
    for name, data in re.findall(
        r"^([\w ]+ (?:request|reply), (?:RTU|TCP)): `([0-9A-F ]+)`$", PAGE, re.MULTILINE
    )
}
MAP = PROTOCOL.modbus
EXAMPLES = {name: one for name, one in ALL.items() if not isinstance(one.request, SetAddress)}
OF_SENSORS = ("GetSensors", "Measure", "GetReading", "GetBlock")  # at the end of the session
_BEFORE = [name for name in EXAMPLES if name not in OF_SENSORS]
NUMBERED = [
    (name, number)
    for number, name in (*enumerate(_BEFORE, start=1), *enumerate(OF_SENSORS, start=27))
]
BESIDE = ("Refusal", "FC16 Apply", "FC4 Apply", "FC16 Disarm")
BROADCASTS = {
    "Broadcast Commit": (22, Commit(513, 9)),
    "Broadcast Stop": (23, Stop(0.005)),
    "Broadcast SetAddress": (26, SetAddress(5, "A-17")),
}
every_wire = pytest.mark.parametrize("wire", ["RTU", "TCP"])
every_example = pytest.mark.parametrize(
    ("name", "number"), NUMBERED, ids=[name for name, _ in NUMBERED]
)


def pdu_of(frame: bytes, wire: str) -> bytes:
    """Return the PDU of a frame."""
    return frame[1:-2] if wire == "RTU" else frame[7:]


def exchange_of(name: str, number: int) -> Exchange:
    """Encode a request of the page; before GetCaps for 16 channels."""
    return exchanges.encode_request(
        EXAMPLES[name].request, tag=number, channels=16 if name in ("Hello", "GetCaps") else 4
    )


def adu(
    read: Read | None, write: Write | None, number: int, wire: str, unit: int = 1
) -> RequestAdu:
    """Build a request; number: of the transaction over TCP."""
    is_rtu = wire == "RTU"
    return build_adu(read, write, unit=unit, transaction=0 if is_rtu else number, is_rtu=is_rtu)


def answered(device: ScriptedDevice, name: str, wire: str) -> bytes:
    """Return the far end's response to a request of the page, as a frame."""
    request = FRAMES[f"{name} request, {wire}"]
    pdu = ModbusUnit(device).reply(pdu_of(request, wire))
    assert pdu is not None
    if wire == "RTU":
        return rtu_frame(1, pdu)
    return tcp_frame(Asked(1, b"", int.from_bytes(request[:2], "big")), pdu)


def test_page_shows_every_message() -> None:
    """A request and a reply over both wires; every frame is checked below."""
    pairs = [f"{name} {part}" for name in (*EXAMPLES, *BESIDE) for part in ("request", "reply")]
    broadcasts = [f"{name} request" for name in BROADCASTS]
    assert set(FRAMES) == {
        f"{name}, {wire}" for name in pairs + broadcasts for wire in ("RTU", "TCP")
    }
    assert {type(example.request) for example in EXAMPLES.values()} == {*Request.__args__} - {
        SetAddress
    }


@every_wire
@every_example
def test_host_encodes_the_request(name: str, number: int, wire: str) -> None:
    """To the byte."""
    exchange = exchange_of(name, number)
    sent = adu(exchange.read, exchange.write, number, wire)
    assert sent.frame == FRAMES[f"{name} request, {wire}"]


@every_wire
@every_example
def test_host_decodes_the_reply(name: str, number: int, wire: str) -> None:
    """Byte by byte."""
    exchange, example = exchange_of(name, number), EXAMPLES[name]
    sent = adu(exchange.read, exchange.write, number, wire)
    reader = ResponseReader(is_rtu=wire == "RTU", counters=WireCounters())
    data = FRAMES[f"{name} reply, {wire}"]
    (answer,) = [one for byte in data for one in reader.feed(bytes([byte]), sent)]
    if isinstance(example.reply, Nak):
        assert answer.exception == MAP["exceptions"][example.reply.code.name]
        return
    assert exchanges.is_of(answer.registers, tag=number if exchange.write else None)
    assert exchanges.decode_reply(example.request, answer.registers) == example.reply


@every_wire
@every_example
def test_far_end_decodes_and_replies(name: str, number: int, wire: str) -> None:
    """It shares no code with the host."""
    device = ScriptedDevice()
    device.follow(EXAMPLES[name])
    assert answered(device, name, wire) == FRAMES[f"{name} reply, {wire}"]
    # What is read behind a selection is asked for once more, by the block that is read.
    assert device.asked[-1 if name == "GetReading" else 0] == plain(EXAMPLES[name].request)


@every_wire
def test_reason_of_a_refusal_is_read(wire: str) -> None:
    """With the tag of the refused write, which the host compares."""
    device, name = ScriptedDevice(), "Refused Apply"
    number = dict(NUMBERED)[name]
    device.follow(EXAMPLES[name])
    unit = ModbusUnit(device)
    unit.reply(pdu_of(FRAMES[f"{name} request, {wire}"], wire))
    sent = adu(exchanges.refusal_read(), None, number, wire)
    assert sent.frame == FRAMES[f"Refusal request, {wire}"]
    pdu = unit.reply(pdu_of(sent.frame, wire))
    assert pdu == pdu_of(FRAMES[f"Refusal reply, {wire}"], wire)
    reader = ResponseReader(is_rtu=wire == "RTU", counters=WireCounters())
    (answer,) = reader.feed(FRAMES[f"Refusal reply, {wire}"], sent)
    assert exchanges.decode_refusal(answer.registers, tag=number) == EXAMPLES[name].reply
    assert exchanges.decode_refusal(answer.registers, tag=number - 1) is None


@every_wire
def test_functions_16_and_4_replace_23(wire: str) -> None:
    """The same block, and its result."""
    exchange, example = exchange_of("Apply", 20), EXAMPLES["Apply"]
    device = ScriptedDevice()
    device.follow(example)
    unit = ModbusUnit(device)
    steps = {"FC16 Apply": (None, exchange.write), "FC4 Apply": (exchange.read, None)}
    for number, (name, (read, write)) in enumerate(steps.items(), start=20):
        sent = adu(read, write, number, wire)
        assert sent.frame == FRAMES[f"{name} request, {wire}"]
        pdu = unit.reply(pdu_of(sent.frame, wire))
        assert pdu == pdu_of(FRAMES[f"{name} reply, {wire}"], wire)
        reader = ResponseReader(is_rtu=wire == "RTU", counters=WireCounters())
        (answer,) = reader.feed(FRAMES[f"{name} reply, {wire}"], sent)
    assert exchanges.is_of(answer.registers, tag=20)
    assert exchanges.decode_reply(example.request, answer.registers) == example.reply


@every_wire
@pytest.mark.parametrize("name", BROADCASTS)
def test_broadcast_is_carried_out(name: str, wire: str) -> None:
    """By every unit."""
    number, request = BROADCASTS[name]
    sent = adu(None, exchanges.encode_broadcast(request), number, wire, unit=0)
    assert sent.frame == FRAMES[f"{name} request, {wire}"]
    device = ScriptedDevice()
    ModbusUnit(device).handle_broadcast(pdu_of(sent.frame, wire))
    assert device.heard == [request]


@every_wire
def test_other_masters_are_served(wire: str) -> None:
    """One register disarms, along the ramp that the block has at first."""
    device = ScriptedDevice()
    assert answered(device, "FC16 Disarm", wire) == FRAMES[f"FC16 Disarm reply, {wire}"]
    assert device.asked == [Disarm(0.005)]


@pytest.mark.parametrize("flag", ["keep_phase", "skip_ending"])
def test_flags_reach_the_far_end(flag: str) -> None:
    """Each alone; the slots are in the session."""
    command = DriveCommand(0, 110.0, 0.2, **{flag: True})
    request = Apply(GUARD.check(CommandSet(515, (command,), ramp=0.0, valid_for=0.0)))
    exchange = exchanges.encode_request(request, tag=1, channels=4)
    device = ScriptedDevice()
    ModbusUnit(device).reply(pdu_of(adu(exchange.read, exchange.write, 1, "RTU").frame, "RTU"))
    assert device.asked[0] == plain(request)


def addresses() -> dict[int, str]:
    """Return the registers of the definition by address."""
    named = {MAP["look"]: "look"}
    behind = {"set": "channels", "envelope": "knots", "status": "levels", "achieved": "channels"}
    behind |= {"capabilities": "limits", "measured": "measurements", "address": "serial_number"}
    behind |= {"measure": "frequencies", "sensors": "descriptions", "reading": "tones"}
    behind["samples"] = "counts"
    for name, block in [*MAP["holding"].items(), *MAP["input"].items()]:
        registers = [*MAP["head"], *block["registers"]]
        if name in behind:
            registers.append(behind[name])
        if name == "faults":
            registers.append("records")
        named.update(enumerate(registers, start=block["address"]))
        begin = block["address"] + len(registers)
        for text in block.get("texts", ()):
            named[begin] = text
            begin += MAP["text_registers"]
    return named


def test_registers_equal_the_definition() -> None:
    """All of them and no others."""
    rows = re.findall(r"^\| (\d+) \| (\w+) \|", PAGE, re.MULTILINE)
    assert {int(address): name for address, name in rows} == addresses()
    assert len(rows) == len(addresses())


def test_exceptions_equal_the_definition() -> None:
    """And the controlwords."""
    rows = dict(re.findall(r"^\| ([A-Z_]+) \| (\d+) \|$", PAGE, re.MULTILINE))
    assert {name: int(code) for name, code in rows.items()} == MAP["exceptions"]
    words = re.search(r"\| 2 \| controlword \| (.*?);", PAGE)
    assert words is not None
    assert dict(re.findall(r"(\w+) (\d+)", words[1])) == {
        name: str(word) for name, word in MAP["controlwords"].items()
    }
