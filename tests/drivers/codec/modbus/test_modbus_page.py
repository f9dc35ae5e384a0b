import re
from collections.abc import Callable
from pathlib import Path

import pytest

import drivers
from drivers.codec.modbus import exchanges
from drivers.codec.modbus.adu import RequestAdu, ResponseReader, build_adu
from drivers.codec.modbus.exchanges import Exchange, Read, Write
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Commit, Nak, Ping, Request, Stop
from drivers.statistics import WireCounters
from sim.far_ends.modbus.frames import RequestAdu as Asked
from sim.far_ends.modbus.frames import rtu_frame, tcp_frame
from sim.far_ends.modbus.registers import checksum
from sim.far_ends.modbus.unit import ModbusUnit
from vendor_pages import EXAMPLES, ScriptedDevice, plain

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
NUMBERED = [(name, number) for number, name in enumerate(EXAMPLES, start=1)]
BESIDE = ("Refusal", "FC16 Apply", "FC4 Apply", "FC43 Identification", "FC6 Ping")
BROADCASTS = {"Broadcast Commit": (22, Commit(513)), "Broadcast Stop": (23, Stop(0.005))}
every_wire = pytest.mark.parametrize("wire", ["RTU", "TCP"])
every_example = pytest.mark.parametrize(("name", "number"), NUMBERED, ids=EXAMPLES)


def pdu_of(frame: bytes, wire: str) -> bytes:
    """What stands between unit and CRC, or behind the header."""
    return frame[1:-2] if wire == "RTU" else frame[7:]


def exchange_of(name: str, number: int) -> Exchange:
    """What the host writes and reads; before GetCaps it does not know how many channels it has."""
    return exchanges.encode_request(
        EXAMPLES[name].request, tag=number, channels=16 if name in ("Hello", "GetCaps") else 4
    )


def adu(
    read: Read | None, write: Write | None, number: int, wire: str, unit: int = 1
) -> RequestAdu:
    """What the host sends; number: of the transaction, where there is one."""
    is_rtu = wire == "RTU"
    return build_adu(read, write, unit=unit, transaction=0 if is_rtu else number, is_rtu=is_rtu)


def answered(device: ScriptedDevice, name: str, wire: str) -> bytes:
    """What the far end answers to a request of the page, as a frame."""
    request = FRAMES[f"{name} request, {wire}"]
    pdu = ModbusUnit(device).reply(pdu_of(request, wire))
    assert pdu is not None
    if wire == "RTU":
        return rtu_frame(1, pdu)
    return tcp_frame(Asked(1, b"", int.from_bytes(request[:2], "big")), pdu)


def test_the_page_shows_every_message() -> None:
    """A request and a reply of every message over both wires, and nothing that is not checked."""
    pairs = [f"{name} {part}" for name in (*EXAMPLES, *BESIDE) for part in ("request", "reply")]
    broadcasts = [f"{name} request" for name in BROADCASTS]
    assert set(FRAMES) == {
        f"{name}, {wire}" for name in pairs + broadcasts for wire in ("RTU", "TCP")
    }
    assert {type(example.request) for example in EXAMPLES.values()} == set(Request.__args__)


@every_wire
@every_example
def test_the_request_is_what_the_host_sends(name: str, number: int, wire: str) -> None:
    """The host's own encoder, to the byte."""
    exchange = exchange_of(name, number)
    sent = adu(exchange.read, exchange.write, number, wire)
    assert sent.frame == FRAMES[f"{name} request, {wire}"]


@every_wire
@every_example
def test_the_host_understands_the_reply(name: str, number: int, wire: str) -> None:
    """The frame, coming byte by byte, becomes the message that the page speaks of."""
    exchange, example = exchange_of(name, number), EXAMPLES[name]
    sent = adu(exchange.read, exchange.write, number, wire)
    reader = ResponseReader(is_rtu=wire == "RTU", counters=WireCounters())
    data = FRAMES[f"{name} reply, {wire}"]
    (answer,) = [one for byte in data for one in reader.feed(bytes([byte]), sent)]
    if isinstance(example.reply, Nak):
        assert answer.exception == MAP["exceptions"][example.reply.code.name]
        return
    assert exchanges.is_of(answer.registers, tag=number if exchange.write else None)
    assert answer.registers[1] != 0
    assert exchanges.decode_reply(example.request, answer.registers) == example.reply


@every_wire
@every_example
def test_the_far_end_understands_and_answers(name: str, number: int, wire: str) -> None:
    """The far end, which shares no code with the host, reads the message and says the reply."""
    device = ScriptedDevice()
    device.follow(EXAMPLES[name])
    assert answered(device, name, wire) == FRAMES[f"{name} reply, {wire}"]
    assert device.asked[0] == plain(EXAMPLES[name].request)


@every_wire
def test_the_reason_of_a_refusal_can_be_read(wire: str) -> None:
    """The far end names it with the tag of the refused write, and the host takes it for its own."""
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
def test_without_function_23_it_takes_two(wire: str) -> None:
    """The same block by function 16, whose echo is checked, and its outcome by function 4."""
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
def test_broadcasts_are_heard(name: str, wire: str) -> None:
    """What the host sends to unit 0 is on the page, and every unit carries it out."""
    number, request = BROADCASTS[name]
    sent = adu(None, exchanges.encode_broadcast(request), number, wire, unit=0)
    assert sent.frame == FRAMES[f"{name} request, {wire}"]
    device = ScriptedDevice()
    ModbusUnit(device).handle_broadcast(pdu_of(sent.frame, wire))
    assert device.heard == [request]


@every_wire
def test_other_masters_are_served(wire: str) -> None:
    """The device identification names vendor, product, firmware and serial number; FC6 is enough.

    The objects are those of the standard: 0, 1 and 2, and 128 as the first of the vendor's own.
    """
    device = ScriptedDevice()
    device.follow(EXAMPLES["Hello"])
    reply = FRAMES[f"FC43 Identification reply, {wire}"]
    assert answered(device, "FC43 Identification", wire) == reply
    for number, text in ((0, b"Acme"), (1, b"Quad"), (2, b"1.2"), (0x80, b"A-17")):
        assert bytes([number, len(text)]) + text in reply
    device = ScriptedDevice()
    assert answered(device, "FC6 Ping", wire) == FRAMES[f"FC6 Ping reply, {wire}"]
    assert device.asked == [Ping()]


def addresses() -> dict[int, str]:
    """Every register that the definition names, by its address."""
    named = {MAP["heartbeat"]: "heartbeat", MAP["look"]: "look"}
    behind = {"set": "channels", "envelope": "knots", "status": "levels", "achieved": "channels"}
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


def test_every_register_stands_at_its_address() -> None:
    """The tables name the registers of the definition, all of them and no others."""
    rows = re.findall(r"^\| (\d+) \| (\w+) \|", PAGE, re.MULTILINE)
    assert {int(address): name for address, name in rows} == addresses()
    assert len(rows) == len(addresses())


def test_the_exceptions_are_those_of_the_definition() -> None:
    """Each refusal has its exception, and the controlwords and functions their numbers."""
    rows = dict(re.findall(r"^\| ([A-Z_]+) \| (\d+) \|$", PAGE, re.MULTILINE))
    assert {name: int(code) for name, code in rows.items()} == MAP["exceptions"]
    words = re.search(r"\| 2 \| controlword \| (.*?);", PAGE)
    assert words is not None
    assert dict(re.findall(r"(\w+) (\d+)", words[1])) == {
        name: str(word) for name, word in MAP["controlwords"].items()
    }


@pytest.mark.parametrize("check_of", [exchanges.crc_of, checksum])
def test_the_check_is_that_of_the_page(check_of: Callable[[list[int]], int]) -> None:
    """CRC-16 with polynomial 1021 from FFFF, by its published value over the digits 1 to 8."""
    assert check_of([0x3132, 0x3334, 0x3536, 0x3738]) == 0xA12B
